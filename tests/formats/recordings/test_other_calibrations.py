"""Recordings whose calibration another tool wrote, and what a row states of its world."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from intercap_core.config import FramesSettings
from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.recordings.frames import Frames
from intercap_core.formats.recordings.layouts import open_layout
from intercap_core.geometry.camera.transforms import invert, rigid
from intercap_core.stages import frames
from tests.helpers import other_calibrations as written
from tests.helpers.kinect_files import row

SIZE = (64, 48)
MATRIX = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
# x right, y away from the camera, z up in the world; the camera 1.2 m above the floor
LEVEL = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
VIEWS = {
    name: written.View(SIZE, MATRIX, np.zeros(8), rigid(LEVEL, -LEVEL @ [x, -3, 1.2]))
    for name, x in (("a", 0.0), ("b", 0.5))
}


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    for number, name in enumerate(VIEWS):
        folder = tmp_path / "recordings" / name
        folder.mkdir(parents=True)
        for image in range(3):
            picture = np.full((SIZE[1], SIZE[0], 3), (40 * number, 50 * image, 90), np.uint8)
            cv2.imwrite(str(folder / f"{image}.jpg"), picture)
        (folder / "timestamps.csv").write_text("0.0\n0.1\n0.2\n")
    return tmp_path


def entry(folder: Path, calibration: Path, **columns: object) -> SequenceEntry:
    return row(folder / "recordings", calibration, **({"layout": "plain"} | columns))


def read(folder: Path, sequence: SequenceEntry) -> Frames:
    frames.run(sequence=sequence, output=folder / "frames.h5", settings=FramesSettings())
    return Frames.open(folder / "frames.h5")


def test_easymocap_without_sizes_uses_those_of_the_images(recording):
    with read(recording, entry(recording, written.write_easymocap(recording, VIEWS))) as source:
        assert source.rig.names == ("a", "b") and source.present.all() and source.num_sets == 3
        assert (source.rig[1].colour.width, source.rig[1].colour.height) == SIZE
        apart = source.rig[1].master_from_colour[:3, 3]
        np.testing.assert_allclose(apart, [0.5, 0, 0], atol=1e-6)
        assert np.isnan(source.stated_up).all() and np.isnan(source.stated_floor).all()


@pytest.mark.parametrize("axis", ["-x", "y", "z"])
def test_up_and_floor_are_in_the_frame_of_the_master(recording, axis):
    path = written.write_colmap(recording, VIEWS, metres=0.25, binary=True)
    sequence = entry(
        recording, path, calibration_scale=0.25, calibration_up=axis, calibration_floor=0.3
    )
    up = np.eye(3)["xyz".index(axis[-1])] * (-1 if axis[0] == "-" else 1)
    with read(recording, sequence) as source:
        np.testing.assert_allclose(source.stated_up, LEVEL @ up, atol=1e-9)
        world = invert(VIEWS["a"].camera_from_world) @ [*source.stated_floor, 1]
        np.testing.assert_allclose(world[:3], 0.3 * up, atol=1e-9)


def test_of_kinects_only_the_poses_are_read(tmp_path):
    (tmp_path / "recordings").mkdir()
    for name in VIEWS:
        (tmp_path / "recordings" / f"{name}.mkv").touch()
    path = written.write_pose2sim(tmp_path, VIEWS)
    layout = open_layout(entry(tmp_path, path, layout="k4a"))
    np.testing.assert_allclose(
        layout.extrinsics.master_from_colour["b"][:3, 3], [0.5, 0, 0], atol=1e-12
    )
    (tmp_path / "recordings" / "b.mkv").rename(tmp_path / "recordings" / "c.mkv")
    assert open_layout(entry(tmp_path, path, layout="k4a")).names == ["a", "c"]  # check tells


@pytest.mark.parametrize("layout", ["intercap", "behave", "k4a", "plain"])
def test_a_scale_for_a_form_in_metres_is_refused(tmp_path, layout):
    (tmp_path / "recordings").mkdir()
    (tmp_path / "rig.json").write_text("{}")
    sequence = entry(tmp_path, tmp_path / "rig.json", layout=layout, calibration_scale=0.001)
    with pytest.raises(UserError, match="is in metres, yet column calibration_scale"):
        open_layout(sequence)


def test_impossible_columns_are_refused(tmp_path):
    for columns, words in (
        ({"calibration_floor": 0.0}, "without calibration_up"),
        ({"calibration_up": "up"}, "calibration_up"),
        ({"calibration_scale": 0.0}, "greater than 0"),
        ({"calibration_up": "z", "calibration_floor": 900.0}, "calibration_floor"),
    ):
        with pytest.raises(ValidationError, match=words):
            entry(tmp_path, tmp_path, **columns)
