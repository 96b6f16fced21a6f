"""The skeleton, read by the library bvhio: joints are where the joint result has them."""

from __future__ import annotations

import json
from pathlib import Path

import bvhio
import numpy as np
import pytest

from intercap_core import artefacts
from intercap_core.body.joints import JOINT_NAMES
from intercap_core.geometry.camera.transforms import apply
from intercap_core.schemas import JOINT
from tests.helpers import exported
from tests.helpers import fitted_capture as fitted

YUP_FROM_ZUP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


@pytest.fixture(scope="module")
def folder(lively: fitted.Capture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("bvh") / "out"
    # y up and z-up frames are the format's own, whatever the settings say
    return exported.run(lively, out, formats=["bvh"], frame="camera") / "bvh"


def test_joints_agree_with_the_joint_result_within_a_tenth_of_a_millimetre(
    folder: Path, lively: fitted.Capture, zup_from_master: np.ndarray
) -> None:
    root = bvhio.readAsHierarchy(str(folder / f"{exported.NAME}.bvh"))
    with artefacts.read(lively.paths["joint"], JOINT) as joint:
        zup = apply(zup_from_master, joint["joints"].astype(float))
    expected = 100 * zup @ YUP_FROM_ZUP.T
    joints = {joint.Name: joint for joint, _, _ in root.layout()}
    assert set(JOINT_NAMES) <= set(joints)
    for t, positions in enumerate(expected):
        root.loadPose(t)
        read = np.array([list(joints[name].PositionWorld) for name in JOINT_NAMES])
        assert np.linalg.norm(read - positions, axis=1).max() < 0.01, t


def test_bones_have_the_lengths_of_the_fitted_shape(folder: Path, lively: fitted.Capture) -> None:
    file = bvhio.readAsBvh(str(folder / f"{exported.NAME}.bvh"))
    assert file.FrameCount == len(lively.vertices)
    assert file.FrameTime == pytest.approx(1 / fitted.FPS, abs=1e-6)
    with artefacts.read(lively.paths["joint"], JOINT) as joint:
        joints = joint["joints"]
    ankle, foot = (JOINT_NAMES.index(name) for name in ("left_ankle", "left_foot"))
    length = 100 * np.linalg.norm(joints[0, foot] - joints[0, ankle])
    offsets = {joint.Name: joint.Offset for joint, _, _ in file.Root.layout()}
    assert np.linalg.norm(list(offsets["left_foot"])) == pytest.approx(length, abs=1e-3)


def test_units_axes_and_flags_are_stated_next_to_it(folder: Path) -> None:
    about = json.loads((folder / "about.json").read_text())
    assert about["up_axis"] == "y" and about["units"].startswith("centimetres, degrees")
    assert len(about["by_frame"]["contact_probability"]) == 4
    text = (folder.parent / "README.txt").read_text()
    assert "\nbvh/*.bvh" in text and "centimetres" in text
