"""One measured capture and its exports, shared by all workers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from intercap_core import artefacts
from intercap_core.schemas import JOINT, SCENE
from tests.helpers import exported
from tests.helpers import fitted_capture as fitted
from tests.helpers.shared_folder import shared_folder

ALL = ("intercap", "amass", "bop", "coco", "glb", "contact", "meshes")


@pytest.fixture(scope="session")
def capture(captures: dict[str, fitted.Capture]) -> fitted.Capture:
    return captures[exported.NAME]


@pytest.fixture(scope="session")
def everything(capture: fitted.Capture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The capture in every format, z-up."""

    def make(folder: Path) -> None:
        exported.run(capture, folder / "out", formats=ALL)

    return shared_folder(tmp_path_factory, "everything", make) / "out"


@pytest.fixture(scope="session")
def lively(capture: fitted.Capture, tmp_path_factory: pytest.TempPathFactory) -> fitted.Capture:
    """The capture with a body and an object that turn, and a face that moves."""

    def make(folder: Path) -> None:
        exported.lively(capture, folder)

    folder = shared_folder(tmp_path_factory, "lively", make)
    return replace(capture, paths=capture.paths | {"joint": folder / "joint.h5"})


@pytest.fixture(scope="session")
def bodies(lively: fitted.Capture) -> np.ndarray:
    """Vertices (T, V, 3) of the lively joint artefact, master frame."""
    with artefacts.read(lively.paths["joint"], JOINT) as joint:
        assert np.abs(joint["expression"]).min() > 0
        vertices, joints = exported.posed(lively.model, joint)
        assert joints == pytest.approx(joint["joints"], abs=1e-6)
        return vertices


@pytest.fixture(scope="session")
def upright(lively: fitted.Capture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The lively capture in the formats of bodies, z-up; meshes of every other frame as ply."""
    formats = ("intercap", "amass", "glb", "meshes")

    def make(folder: Path) -> None:
        exported.run(lively, folder / "out", formats=formats, mesh_every=2)

    return shared_folder(tmp_path_factory, "upright", make) / "out"


@pytest.fixture(scope="session")
def in_camera(lively: fitted.Capture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The lively capture in the camera's frame; meshes of every other frame as obj."""

    def make(folder: Path) -> None:
        exported.run(
            lively, folder / "out", formats=[name for name in ALL if name != "contact"],
            frame="camera", mesh_format="obj", mesh_every=2,
        )  # fmt: skip

    return shared_folder(tmp_path_factory, "in_camera", make) / "out"


@pytest.fixture(scope="session")
def zup_from_master(capture: fitted.Capture) -> np.ndarray:
    with artefacts.read(capture.paths["scene"], SCENE) as scene:
        return scene["zup_from_master"]
