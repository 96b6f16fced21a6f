"""Recordings that reproduce public bug reports."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from intercap_core.errors import UserError
from intercap_core.formats.detections.read import Detections
from intercap_core.formats.recordings.frames import Frames
from intercap_core.formats.recordings.image_files import ImagePair, read_depth
from intercap_core.formats.recordings.layouts import open_layout
from intercap_core.formats.recordings.timestamps import Timestamps, pair_images
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
    (fault,) = found.faults
    assert "no keypoints of k1, k2, k3" in fault
    assert {images.size for images in found.images.values()} == {(240, 320)}


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


@pytest.mark.parametrize("opengl", [False, True])
def test_poses_with_the_axes_of_opengl_are_noted(tmp_path, opengl):
    """Of https://github.com/zju3dv/EasyMocap/issues/133."""
    project = open_case("b14", tmp_path)
    path = project.path.parent / "calibration.yaml"
    calibration = yaml.safe_load(path.read_text())
    flip = np.diag([1, -1, -1] if opengl else [1, 1, 1])
    for camera in calibration["cameras"].values():
        camera |= {key: (flip @ camera[key]).tolist() for key in "RT"}
    path.write_text(yaml.safe_dump(calibration))
    assert any("3 of 3 cameras face away" in note for note in check(project).notes) == opengl


@pytest.mark.parametrize("unit", [0.001, 0.0002])
def test_the_largest_number_is_no_depth(tmp_path, unit):
    """Of https://github.com/luxonis/depthai-docs-website/pull/156."""
    depth = np.array([[0, 1000, 65_534], [65_535, 5000, 65_535]], np.uint16)
    cv2.imwrite(str(tmp_path / "d.png"), depth)
    expected = np.where(depth == 65_535, 0, np.rint(depth * (unit / 0.001)))
    np.testing.assert_array_equal(read_depth(tmp_path / "d.png", (3, 2), unit), expected)


def pairs(
    names: list[str], depth: list[str], fps: float | None = 30.0, times: Timestamps | None = None
) -> list[ImagePair]:
    files, depth_files = [Path(name) for name in names], [Path(name) for name in depth]
    return pair_images(
        files, depth_files, fps=fps, offset_s=0, times=times, source=Path("k1")
    ).pairs


def test_names_that_are_times_in_seconds_as_in_tum_rgbd(tmp_path):
    """Of https://github.com/lifelong-robotic-vision/OpenLORIS-Scene/issues/10."""
    names = ["1560000083.949189.png", "1560000083.982551.png", "1560000084.015913.png"]
    shots = pairs(names, ["1560000083.950000.png", "1560000084.017000.png"], fps=None)
    colour = {shot.time_us: shot.colour.name for shot in shots if shot.colour}
    assert list(colour.items()) == [
        (1560000083949189 + 33362 * n, name) for n, name in enumerate(names)
    ]
    depth = [shot.time_us for shot in shots if shot.depth]
    assert depth == [1560000083950000, 1560000084017000]
    for stated in ({name: 2.0 + n / 30 for n, name in enumerate(names)}, {0: 2, 1: 2.03, 2: 2.07}):
        shots = pairs(names, ["1560000083.950000.png", "1560000084.017000.png"], times=stated)
        own = [shot.time_us for shot in shots if shot.depth]
        np.testing.assert_allclose(own, [2_000_811, 2_067_811], atol=4_000)
    video = pairs([], ["1.033.png", "2.000.png"], times={0: 1.0, 1: 1.03, 2: 1.97})
    assert [shot.time_us for shot in video] == [1_033_000, 2_000_000]
    assert [shot.time_us for shot in pairs(["k1.0000.png", "k1.0002.png"], [])] == [0, 66_667]
    assert [shot.time_us for shot in pairs(["0000.1.png", "0001.1.png"], [])] == [0, 33_333]
    with pytest.raises(UserError, match="no time between images at 5 a second"):
        pairs(names, [], fps=5)
    with pytest.raises(UserError, match="number both alike"):
        pairs(names, ["0000.png"])


@pytest.mark.parametrize(
    ("names", "fps", "unit"),
    [
        (["033", "066", "100", "133"], 30, "milliseconds"),
        (["1000", "1040", "1080"], 25, "milliseconds"),
        (["0", "33", "66", "99"], 30, "milliseconds"),
        (["k1_1616161616000", "k1_1616161616033", "k1_1616161616067"], 30, "milliseconds"),
        (["0_33333", "1_66667", "2_100000"], 30, "microseconds"),
        (["color_0-1633342743123.45", "color_1-1633342744156.78"], 30, "milliseconds"),
        (["2", "4", "6"], 30, ""),
        (["000", "030", "060"], 30, ""),
        (["3", "17", "29", "44"], 30, ""),
    ],
)
def test_numbers_that_are_times_are_refused(names, fps, unit):
    """Of https://github.com/realsenseai/librealsense/issues/9820."""
    if not unit:
        assert len(pairs([f"{name}.png" for name in names], [], fps)) == len(names)
        return
    with pytest.raises(UserError, match=f"likely {unit}"):
        pairs([f"{name}.png" for name in names], [], fps)


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
