"""Files as LEMO's release has them, with random numbers: the weights are the user's to fetch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from intercap_core.body.lemo import MotionEncoder
from intercap_core.config import JointSettings

CHANNELS = (1, 32, 64, 64, 64, 64)
THIN = (1, 4, 4, 4, 4, 4)
COORDINATES = 243  # of 81 markers
SPREAD = 0.6  # standard deviation of each, in the release's statistics


def random_encoder(*, bias: float = 0.1) -> MotionEncoder:
    """An encoder in double precision; with few channels it takes little time."""
    weights = [values.double() for values in random_state(bias=bias, channels=THIN).values()]
    blocks = [tuple(weights[k : k + 4]) for k in range(0, len(weights), 4)]
    return MotionEncoder(tuple(blocks), torch.full((COORDINATES,), SPREAD, dtype=torch.float64))


def random_state(
    *, bias: float = 0.1, channels: tuple[int, ...] = CHANNELS
) -> dict[str, torch.Tensor]:
    """An encoder's state: ten convolutions of 3 x 3, biases up to ``bias``."""
    generator = torch.Generator().manual_seed(0)
    state = {}
    for block in range(5):
        sizes = channels[block], channels[block + 1]
        for layer, inner in zip((0, 2), sizes, strict=True):
            name = f"enc_blc{block + 1}.main.{layer}"
            shape = (sizes[1], inner, 3, 3)
            state[f"{name}.weight"] = torch.randn(shape, generator=generator) / (9 * inner) ** 0.5
            state[f"{name}.bias"] = bias * torch.randn(sizes[1], generator=generator)
    return state


def write_release(folder: Path) -> tuple[Path, Path]:
    """Write weights and statistics below ``folder``; returns their paths."""
    files = JointSettings(lemo=folder).lemo_files
    assert files is not None
    weights, statistics = files
    for path in (weights, statistics):
        path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(random_state(), weights)
    mean = np.zeros((1, 1, COORDINATES))
    np.savez_compressed(statistics, Xmean=mean, Xstd=np.full(COORDINATES, SPREAD))
    return files
