"""One measured capture and its export, for the files of this folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from intercap_core import artefacts
from intercap_core.schemas import SCENE
from tests.helpers import exported
from tests.helpers import fitted_capture as fitted

ALL = ("intercap", "amass", "bop", "coco", "glb", "contact", "meshes")


@pytest.fixture(scope="session")
def capture(tmp_path_factory: pytest.TempPathFactory) -> fitted.Capture:
    return exported.measured_capture(tmp_path_factory.mktemp("capture"))


@pytest.fixture(scope="session")
def everything(capture: fitted.Capture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The capture in every format."""
    return exported.run(capture, tmp_path_factory.mktemp("all") / "out", formats=ALL)


@pytest.fixture(scope="session")
def lively(capture: fitted.Capture, tmp_path_factory: pytest.TempPathFactory) -> fitted.Capture:
    """The capture with a body and an object that turn, and a face that moves."""
    return exported.lively(capture, tmp_path_factory.mktemp("lively"))


@pytest.fixture(scope="session")
def zup_from_master(capture: fitted.Capture) -> np.ndarray:
    with artefacts.read(capture.paths["scene"], SCENE) as scene:
        return scene["zup_from_master"]
