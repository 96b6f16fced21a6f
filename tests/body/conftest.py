"""Body files for the tests: the open body widened to a full SMPL-X file, and its parts."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from intercap_core.body.joints import JOINT_NAMES
from intercap_core.body.loading import OPEN_BODY
from intercap_core.body.maps import maps_path
from intercap_core.body.model import BodyModel


@cache
def _read_open_body() -> dict[str, np.ndarray]:
    with np.load(OPEN_BODY) as file:
        return {name: file[name] for name in file.files}


def open_arrays() -> dict[str, np.ndarray]:
    """Arrays of the open body's file; tests must not change them in place."""
    return dict(_read_open_body())


@pytest.fixture(scope="session")
def full_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file as the licensed ones: 300 + 100 directions, pose blend shapes, a pickled dictionary.

    The first ten directions of shape and expression are those of the open body, the others random.
    """
    arrays, rng = open_arrays(), np.random.default_rng(3)
    table = arrays["shapedirs"].astype(np.float32)
    count, half = len(table), table.shape[2] // 2
    wide = 3e-4 * rng.standard_normal((count, 3, 400), dtype=np.float32)
    wide[:, :, :half], wide[:, :, 300 : 300 + half] = table[:, :, :half], table[:, :, half:]
    arrays |= {
        "shapedirs": wide,
        "posedirs": 1e-3 * rng.standard_normal((count, 3, 486), dtype=np.float32),
        **{f"hands_mean{s}": 0.3 * rng.standard_normal(45, dtype=np.float32) for s in "lr"},
        "joint2num": np.array({name: i for i, name in enumerate(JOINT_NAMES)}),
    }
    path = tmp_path_factory.mktemp("body") / "SMPLX_NEUTRAL.npz"
    np.savez(path, **arrays)
    maps_path(path).write_text(maps_path(OPEN_BODY).read_text())
    return path


def random_vector(batch: int, size: int, seed: int, dtype: torch.dtype) -> torch.Tensor:
    """Poses of about 0.4 rad per joint, shapes of about one standard deviation."""
    generator = torch.Generator().manual_seed(seed)
    vector = torch.randn(batch, size, generator=generator, dtype=dtype)
    vector[:, :165] *= 0.4
    return vector


def hand_pose(model: BodyModel, coefficients: torch.Tensor, side: int) -> torch.Tensor:
    """Axis-angle (B,45) of coefficients (B,n) of the first n components; side 0 is left."""
    count = coefficients.shape[-1]
    return model.hand_mean[side] + coefficients @ model.hand_components[side, :count]
