"""Recordings that reproduce public bug reports."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from intercap_core.formats.detections.read import Detections
from intercap_core.formats.recordings.frames import Frames
from intercap_core.formats.recordings.layouts import open_layout
from intercap_core.pipeline.step import run_step
from intercap_core.project import Project
from intercap_core.scene.depth_scale import describe_depth_scale
from intercap_core.scene.subject_views import find_subject_views
from tests.cases import SEQUENCE, check, open_case


def frames_of(project: Project) -> Path:
    return run_step("frames", project, SEQUENCE, output=project.path.parent / "frames.h5")


def difference(image: np.ndarray | None, other: np.ndarray) -> float:
    assert image is not None
    return float(np.abs(image.astype(int) - other).mean())


def test_recordings_with_a_suffix_in_capitals_are_found(tmp_path):
    project = open_case("b01", tmp_path)
    layout = open_layout(project.sequences[SEQUENCE])
    assert layout.names == ["k1", "k2"]
    with layout.open("k1") as recording:
        assert recording.source.name == "k1.MKV" and recording.camera.depth is not None


def test_orientation_is_left_aside_with_a_calibration_of_colmap(tmp_path):
    project = open_case("b02_exif3", tmp_path)
    found = check(project)
    assert not found.faults
    assert any("k2" in note and "orientation 3" in note for note in found.notes)
    path = project.path.parent / "recordings" / "k2" / "00001.jpg"
    stored = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    with Frames.open(frames_of(project)) as frames:
        assert np.array_equal(frames.colour(1, 1), stored)


def test_the_size_of_an_upright_video_is_that_as_shown(tmp_path):
    project = open_case("b03", tmp_path)
    found = check(project)
    assert not found.faults and {images.size for images in found.images.values()} == {(240, 320)}


def test_depth_as_tiff_is_read(tmp_path):
    project = open_case("b11", tmp_path)
    assert "depth of 3" in check(project).summary
    path = project.path.parent / "recordings" / "k2" / "depth" / "00002.tiff"
    with Frames.open(frames_of(project)) as frames:
        assert np.array_equal(frames.depth(2, 1), cv2.imread(str(path), cv2.IMREAD_UNCHANGED))


def test_a_file_with_an_invalid_camera_name_is_named(tmp_path):
    notes = check(open_case("b13_one", tmp_path)).notes
    assert any("cam 3.mp4" in note and "letters, digits" in note for note in notes)


def test_padding_after_a_jpeg_is_ignored(tmp_path):
    project = open_case("b26_ff", tmp_path)
    found = check(project)
    assert not found.faults and not [note for note in found.notes if "damaged" in note]
    path = project.path.parent / "recordings" / "k1" / "00002.jpg"
    with Frames.open(frames_of(project)) as frames:
        assert frames.colour_available.all()
        assert np.array_equal(frames.colour(2, 0), cv2.imread(str(path)))


def test_colour_as_tiff_is_read(tmp_path):
    project = open_case("b28_tif", tmp_path)
    recording = project.path.parent / "recordings" / "k1"
    true = cv2.imread(str(recording / "00001.tif"))
    with open_layout(project.sequences[SEQUENCE]).open("k1") as opened:
        images = [image.content for image in opened.images()]
        assert "3 colour images are TIFF" in opened.notes[0]
    assert difference(cv2.imdecode(np.frombuffer(images[1], np.uint8), 1), true) < 3
    assert any("images are 64x48" in fault for fault in check(project).faults)


@pytest.mark.parametrize("unit", [None, 0.0002])
def test_a_unit_of_depth_that_is_not_the_millimetre(tmp_path, unit):
    project = open_case("b10_5000", tmp_path)
    if unit is not None:
        calibration = project.path.parent / "calibration.yaml"
        calibration.write_text(f"depth_unit: {unit}\n{calibration.read_text()}")
    path = frames_of(project)
    output = project.path.parent / "detections.h5"
    people = Detections.load(
        run_step("detections", project, SEQUENCE, inputs={"frames": path}, output=output)
    )
    with Frames.open(path) as frames:
        subject = find_subject_views(people, frames.rig, frames.time_s)
        image_of = np.tile(np.arange(frames.num_sets)[:, None], (1, 3))
        notes = describe_depth_scale(frames, frames.rig, subject.joints, image_of)
        recorded = cv2.imread(
            str(project.path.parent / "recordings" / "k1" / "depth" / "00000.png"), -1
        )
        expected = recorded if unit is None else np.rint(recorded / 5)
        assert np.array_equal(frames.depth(0, 0), expected)
    # The depth of the stick figure misses most keypoints: the wall is at twice the distance.
    assert all("is 5 or 10 times" in note for note in notes) if unit is None else not any(notes)
