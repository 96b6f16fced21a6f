"""Body files for the tests: the open body widened to a full SMPL-X file, and its parts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from intercap_core.body.joints import JOINT_NAMES
from intercap_core.body.loading import OPEN_BODY
from intercap_core.body.maps import maps_path
from intercap_core.body.model import BodyModel


def open_arrays() -> dict[str, np.ndarray]:
    with np.load(OPEN_BODY) as file:
        return {name: file[name] for name in file.files}


def save_body(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    """Write the file with the open body's maps beside it."""
    np.savez(path, **arrays)
    maps_path(path).write_text(maps_path(OPEN_BODY).read_text())
    return path


@pytest.fixture(scope="session")
def full_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """300 + 100 shape columns and random pose blend shapes, as in a licensed file."""
    arrays = open_arrays()
    table = arrays["shapedirs"].astype(np.float32)
    wide = np.zeros((*table.shape[:2], 400), np.float32)
    wide[:, :, :10], wide[:, :, 300:310] = table[:, :, :10], table[:, :, 10:]
    rng = np.random.default_rng(3)
    posedirs = rng.normal(0, 2e-3, (len(table), 3, 486)).astype(np.float32)
    names = {name: i for i, name in enumerate(JOINT_NAMES)}  # a pickled dictionary, as published
    arrays |= {"shapedirs": wide, "posedirs": posedirs, "joint2num": np.array(names)}
    return save_body(tmp_path_factory.mktemp("body") / "SMPLX_NEUTRAL.npz", arrays)


@pytest.fixture(scope="session")
def body() -> BodyModel:
    return BodyModel.load()


@pytest.fixture(scope="session")
def body64() -> BodyModel:
    return BodyModel.load(dtype=torch.float64)


def random_vector(batch: int, size: int, seed: int, dtype: torch.dtype) -> torch.Tensor:
    """Poses of about 0.4 rad a joint, shapes of about one standard deviation."""
    generator = torch.Generator().manual_seed(seed)
    vector = torch.randn(batch, size, generator=generator, dtype=dtype)
    vector[:, :165] *= 0.4
    return vector
