"""The frames stage on recordings made for the purpose, and on the real one."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from intercap_core import artefacts
from intercap_core.config import FramesSettings
from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.calibration.extrinsics import Extrinsics, write_rig_file
from intercap_core.formats.recordings.frames import Frames
from intercap_core.schemas import FRAMES
from intercap_core.stages import frames as stage
from tests.helpers.kinect_files import (
    PERIOD_US,
    depth_at,
    entry_of,
    jpeg_at,
    make_camera,
    notes_of,
    pose_of,
    record,
    run,
)


@pytest.fixture
def capture(tmp_path) -> SequenceEntry:
    """Three cameras, six ticks; k2 loses tick 3, k3 stops after tick 4."""
    folder = tmp_path / "recordings"
    folder.mkdir()
    record(folder, 0, range(6))
    record(folder, 1, [0, 1, 2, 4, 5])
    record(folder, 2, range(5))
    return entry_of(folder, cameras=3)


def test_every_image_is_in_its_set_unchanged(capture):
    with Frames.open(run(capture)) as frames:
        assert (frames.num_sets, frames.fps, frames.master) == (6, 15.0, "k1")
        assert np.allclose(frames.time_s, np.arange(6) * PERIOD_US * 1e-6)
        expected = np.ones((6, 3), bool)
        expected[3, 1] = expected[5, 2] = False
        assert np.array_equal(frames.available, expected)
        assert np.array_equal(frames.depth_available, expected)
        for t in range(6):
            for c in range(3):
                if not expected[t, c]:
                    assert frames.depth(t, c) is None and frames.colour(t, c) is None
                    continue
                assert np.array_equal(frames.depth(t, c), depth_at(c, t))
                assert frames.colour_jpeg(t, c) == jpeg_at(c, t)
                assert frames.colour(t, c).shape == (720, 1280, 3)
        assert np.allclose(frames.skew_s[:, 2][:5], 320e-6, atol=1e-9)
        assert np.isnan(frames.skew_s[3, 1])


def test_cameras_poses_and_gravity(capture):
    output = run(capture)
    with Frames.open(output) as frames:
        rig = frames.rig
    assert rig.names == ("k1", "k2", "k3") and len(rig) == 3
    for index, camera in enumerate(rig):
        made = make_camera(index)
        assert np.allclose(camera.colour.parameters, made.colour.parameters, atol=1e-9)
        assert np.allclose(camera.depth.parameters, made.depth.parameters, atol=1e-9)
        assert np.allclose(camera.colour_from_depth, made.colour_from_depth, atol=1e-12)
        assert np.allclose(camera.master_from_colour, pose_of(index), atol=1e-12)
    with Frames.open(output) as frames:
        down = cv2.Rodrigues(np.array([0.1, 0, 0]))[0] @ [0, 1, 0]
        assert np.allclose(frames.gravity, down[None], atol=1e-6)


def test_degraded_cameras_are_noted(capture):
    notes = notes_of(run(capture))
    assert notes["k1"] == ""
    assert "no image in 1 frame sets" in notes["k2"]
    assert "ends 1 frame sets early" in notes["k3"]


def test_dropped_sets_have_no_image(capture):
    with Frames.open(run(capture, drop=(1, 4))) as frames:
        assert not frames.available[[1, 4]].any() and frames.available[[0, 2, 3, 5]].any(1).all()
        assert frames.num_sets == 6


def test_same_recordings_same_bytes(capture):
    first = run(capture).read_bytes()
    assert run(capture).read_bytes() == first


def test_an_unusable_camera_is_kept_and_flagged(capture):
    (capture.recordings / "k2.mkv").unlink()
    (capture.recordings / "k3.mkv").write_text("not a recording")
    record(capture.recordings, 3, range(6))
    output = run(capture)
    with Frames.open(output) as frames:
        assert frames.present.tolist() == [True, False, False, False]
        assert frames.rig.names == ("k1", "k2", "k3", "k4")
        assert frames.rig[1].depth is None
        assert not frames.available[:, 1:].any()
    notes = notes_of(output)
    assert "no recording of k2" in notes["k2"]
    assert "k3.mkv: is not a Matroska file" in notes["k3"]
    assert "no pose in rig.json" in notes["k4"]
    assert str(capture.recordings) not in notes["k3"]  # an artefact holds no path of a machine


def test_without_the_masters_recording_its_frame_stays(capture):
    (capture.recordings / "k1.mkv").unlink()
    with Frames.open(run(capture)) as frames:
        assert frames.master == "k1" and frames.num_sets == 6
        assert np.allclose(frames.rig[1].master_from_colour, pose_of(1))
        assert not frames.available[:, 0].any()


def test_a_cut_recording_is_read_as_far_as_possible(capture):
    path = capture.recordings / "k2.mkv"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    output = run(capture)
    assert "cut off: " in notes_of(output)["k2"]
    with Frames.open(output) as frames, artefacts.read(output, FRAMES) as artefact:
        assert artefact["truncated"].tolist() == [False, True, True]
        assert 1 <= frames.available[:, 1].sum() < 5
        assert np.array_equal(frames.depth(0, 1), depth_at(1, 0))


@pytest.mark.parametrize("cameras", [(2,), (0, 1, 2)], ids=["one camera", "all cameras"])
def test_cameras_without_depth_give_colour(capture, cameras):
    for camera in cameras:
        record(capture.recordings, camera, range(6), depth=False)
    output = run(capture)
    notes = notes_of(output)
    assert [c for c in range(3) if "has no depth" in notes[f"k{c + 1}"]] == list(cameras)
    with Frames.open(output) as frames:
        assert np.flatnonzero(~frames.depth_available.any(0)).tolist() == list(cameras)
        assert frames.rig[2].depth is None and frames.depth(0, 2) is None
        assert frames.colour_jpeg(0, 2) == jpeg_at(2, 0)


def test_cameras_and_depth_can_be_left_out(capture):
    output = frames_of(capture, cameras=("k1", "k3"), depth=False)
    with Frames.open(output) as frames:
        assert frames.rig.names == ("k1", "k2", "k3")
        assert frames.present.tolist() == [True, False, True]
        assert not frames.available[:, 1].any() and not frames.depth_available.any()
        assert [camera.depth for camera in frames.rig] == [None] * 3
        assert frames.colour_jpeg(0, 2) == jpeg_at(2, 0)
    assert notes_of(output)["k2"] == "left out (frames.cameras)"
    assert "its depth is left out (frames.depth)" in notes_of(output)["k1"]


def frames_of(capture, **settings):
    output = capture.calibration.parent / "frames.h5"
    stage.run(sequence=capture, output=output, settings=FramesSettings(**settings))
    return output


def nothing_readable(capture):
    for path in capture.recordings.glob("*.mkv"):
        path.write_bytes(b"")
    run(capture)


def broken_calibration(capture):
    capture.calibration.write_text("{")
    run(capture)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (lambda c: frames_of(c, cameras=("k1", "K2")),
         "frames.cameras names 'K2', the cameras of sequence 's1' are k1, k2, k3"),
        (lambda c: run(c, drop=(6,)), "drop_frames holds 6, the recording has frame sets 0 to 5"),
        (nothing_readable, "'s1': no camera in .* can be used .*k2: k2.mkv: is empty"),
        (lambda c: run(c.model_copy(update={"recordings": c.recordings / "none"})),
         "no such folder"),
        (broken_calibration, "not valid JSON"),
        (lambda c: frames_of(c, max_skew_ms=40), "max_skew_ms is 40"),
    ],
)  # fmt: skip
def test_user_errors_leave_no_file(capture, fault, words):
    with pytest.raises(UserError, match=words):
        fault(capture)
    assert not list(capture.calibration.parent.rglob("*frames.h5*"))


def test_real_recording_goes_through_the_stage(tmp_path, real_recording):
    (tmp_path / "k1.mkv").symlink_to(real_recording)
    write_rig_file(tmp_path / "rig.json", Extrinsics("k1", {"k1": np.eye(4)}))
    entry = SequenceEntry(
        sequence="real", subject="a", object="b", recordings=tmp_path,
        calibration=tmp_path / "rig.json",
    )  # fmt: skip
    stage.run(sequence=entry, output=tmp_path / "frames.h5", settings=FramesSettings())
    with Frames.open(tmp_path / "frames.h5") as frames:
        assert frames.num_sets == 1 and frames.available.all()
        assert frames.depth(0, 0).shape == (576, 640)
        assert frames.colour(0, 0).shape == (720, 1280, 3)
        assert frames.gravity[0, 1] > 0.8
