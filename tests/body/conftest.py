"""Body files for the tests: the open body widened to a full SMPL-X file, and its parts."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from intercap_core.body.joints import JOINT_NAMES
from intercap_core.body.loading import OPEN_BODY
from intercap_core.body.maps import maps_path

# A pickled dictionary, as published
_JOINT_NUMBERS = np.array({name: i for i, name in enumerate(JOINT_NAMES)})


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
    half = table.shape[2] // 2
    wide[:, :, :half], wide[:, :, 300 : 300 + half] = table[:, :, :half], table[:, :, half:]
    rng = np.random.default_rng(3)
    posedirs = rng.normal(0, 2e-3, (len(table), 3, 486)).astype(np.float32)
    arrays |= {"shapedirs": wide, "posedirs": posedirs, "joint2num": _JOINT_NUMBERS}
    return save_body(tmp_path_factory.mktemp("body") / "SMPLX_NEUTRAL.npz", arrays)


@pytest.fixture(scope="session", params=["neutral", "female", "male"])
def gendered_file(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Path]:
    """Full files as the three licensed ones are: each its own template, weights of the joints (none
    negative), 300 + 100 directions none of which is zero, pose blend shapes, hands."""
    gender: str = request.param
    rng = np.random.default_rng(["neutral", "female", "male"].index(gender))
    arrays = open_arrays()
    count = len(arrays["v_template"])

    def random(*shape: int, size: float) -> np.ndarray:
        return size * rng.standard_normal(shape, dtype=np.float32)

    template = arrays["v_template"] * rng.uniform(0.9, 1.1, 3) + random(count, 3, size=1e-3)
    regressor = np.abs(arrays["J_regressor"]) * rng.uniform(0.5, 1.5, count)
    arrays |= {
        "v_template": template,
        "shapedirs": random(count, 3, 400, size=3e-4),
        "posedirs": random(count, 3, 486, size=1e-3),
        "J_regressor": regressor / regressor.sum(1, keepdims=True),
        **{f"hands_mean{s}": random(45, size=0.3) for s in "lr"},
        "joint2num": _JOINT_NUMBERS,
    }
    folder = tmp_path_factory.mktemp(gender)
    yield save_body(folder / f"SMPLX_{gender.upper()}.npz", arrays)
    shutil.rmtree(folder)


def random_vector(batch: int, size: int, seed: int, dtype: torch.dtype) -> torch.Tensor:
    """Poses of about 0.4 rad a joint, shapes of about one standard deviation."""
    generator = torch.Generator().manual_seed(seed)
    vector = torch.randn(batch, size, generator=generator, dtype=dtype)
    vector[:, :165] *= 0.4
    return vector
