"""`intercap calibrate` on bags of ROS, with and without the lenses of the cameras."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from intercap_core.commands.calibrate import calibrate
from intercap_core.evaluation.scene_errors import displacement
from intercap_core.formats.calibration.files import read_calibration
from tests.calibrate.plain_project import SIZE, PlainProject, small_ring, write_walk
from tests.helpers.ros_files import PERIOD_NS, START_NS, BagFile, Form

TRUTH, UP = small_ring()


def write_bags(project: PlainProject, form: Form, *, lenses: bool) -> None:
    """Replace the folder of images of each camera by a bag."""
    for camera in TRUTH:
        images = project.recordings / camera.name
        path = images.with_suffix(".bag") if form == "bag" else images.with_name(f"{camera.name}_")
        with BagFile(path, form) as bag:
            if lenses:
                bag.lens("/color/camera_info", SIZE, camera.colour.matrix, "camera",
                         d=camera.colour.distortion[:5])  # fmt: skip
            for t, file in enumerate(sorted(images.iterdir())):
                at = START_NS + 2 * t * PERIOD_NS
                topic = "/color/image_raw/compressed"
                bag.compressed(topic, at, "camera", file.read_bytes(), "rgb8; jpeg")
        for file in images.iterdir():
            file.unlink()
        images.rmdir()
        if form != "bag":
            path.rename(images)


@pytest.mark.parametrize(("form", "lenses"), [("bag", True), ("mcap", False)])
def test_poses_follow_from_a_walk_in_bags(tmp_path: Path, form: Form, lenses: bool) -> None:
    project = write_walk(tmp_path, TRUTH, UP).write(layout="ros")
    write_bags(project, form, lenses=lenses)
    apart = np.linalg.norm(TRUTH.master_from_colour[1, :3, 3])
    path, _ = calibrate(
        project.load(), "walk", output=None, lenses=None if lenses else tmp_path / "lenses.json",
        board=None, recordings=[], distance=f"k1:k2:{apart:.4f}", master=None, replace=False,
    )  # fmt: skip
    found = read_calibration(path, lenses=False)
    poses = np.stack([found.extrinsics.master_from_colour[name] for name in TRUTH.names])
    assert displacement(poses, TRUTH.master_from_colour, 0).max() < 0.02
    assert ("camera_matrix" in json.dumps(json.loads(path.read_text()))) is not lenses
