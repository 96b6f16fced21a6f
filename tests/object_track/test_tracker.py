"""Tracks of captures whose truth is known, and the stage that writes them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core import artefacts
from intercap_core.annotation import ObjectPose
from intercap_core.config import ObjectTrackSettings
from intercap_core.errors import UserError
from intercap_core.geometry.camera.transforms import step_between
from intercap_core.object_track.decoder import HIDDEN, Decoded
from intercap_core.object_track.fit import FittedPose
from intercap_core.object_track.hypotheses import Hypotheses
from intercap_core.object_track.proposals import Proposals
from intercap_core.object_track.tracker import Track, Tracker
from intercap_core.object_track.whole import FrameResult
from intercap_core.schemas import OBJECT_TRACK
from intercap_core.stages import object_track
from tests.geometry.rigid.conftest import catalogue
from tests.helpers.object_capture import ObjectCapture
from tests.object_track.scenes import (
    annotate,
    errors_of,
    frames_with,
    images_of,
    mesh_of,
    observer_of,
    track_of,
)

SETTINGS = ObjectTrackSettings()


def test_it_is_tracked_through_misses_and_an_absence(suitcase):
    """Views miss the object in two frames; it is gone for two more and comes back."""
    capture = ObjectCapture.make(suitcase, 10, speed=0.04, turn_deg=4)
    capture.missed = {(t, c) for t in (2, 3) for c in (0, 1)}
    capture.hidden = {6, 7}
    track = track_of(capture)
    assert frames_with(track, "lost") == [6, 7] and frames_with(track, "recovered") == [8]
    shift, turn = (np.delete(e, [6, 7]) for e in errors_of(suitcase, track, capture.poses))
    assert shift.max() < 0.003 and turn.max() < 1
    place = [np.trace(frame.fit.covariance[3:, 3:]) for frame in track.frames]
    assert place[7] > 10 * place[5]


def test_frames_are_searched_if_the_object_is_hidden_in_all(suitcase, capture, images):
    """The first frames that were searched may have shown nothing of it."""
    observer = observer_of(capture, images)
    observer.places.claim(suitcase.centre_at(capture.poses[0]))
    hypotheses = Hypotheses(observer)
    count = len(images)
    nothing = Decoded(np.full(count, HIDDEN), [np.ones(1)] * count, np.zeros(count), 0.0)
    assert Proposals(observer, hypotheses).search_uncertain(nothing)
    shift, turn = min(
        np.abs(step_between(fit.pose, pose)).reshape(2, 3).max(1)[::-1].tolist()
        for fits, pose in zip(hypotheses.fits, capture.poses, strict=True)
        for fit in fits
    )
    assert shift < 0.003 and turn < np.radians(1)


def test_known_exposure_offsets_reduce_the_errors(suitcase):
    """At 1.5 m/s and 3 rad/s, eight milliseconds are 12 mm and 1.4 degrees."""
    capture = ObjectCapture.make(suitcase, 5, speed=0.1, turn_deg=11.5)
    capture.time_offset = np.array([0.0, 0.008, 0.008, -0.003])
    errors = []
    for timed in (True, False):
        given = annotate(2, capture.poses[2])
        track = track_of(capture, given, images=images_of(capture, timed=timed))
        # the median: a step of ten centimetres and eleven degrees may lose the track's end
        errors.append(np.median(errors_of(suitcase, track, capture.poses), axis=1))
    assert (errors[0] < 0.4 * errors[1]).all() and (errors[0] < (0.0015, 0.3)).all()


class TurnedUnseen(ObjectCapture):
    """Turned by a third of a turn while it is hidden."""

    def pose_at(self, t: float) -> np.ndarray:
        pose = super().pose_at(0.0)
        if t >= 4:
            pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("z", 110, degrees=True).as_matrix()
        return pose


def test_an_object_that_reappears_turned_is_found(suitcase):
    capture = TurnedUnseen.make(suitcase, 7, cameras=3)
    capture.hidden = {2, 3}
    track = track_of(capture, annotate(0, capture.poses[0]))
    assert set(frames_with(track, "lost")) == capture.hidden
    shift, turn = (np.delete(e, [2, 3]) for e in errors_of(suitcase, track, capture.poses))
    assert shift.max() < 0.005 and turn.max() < 1.5


class Lifted(ObjectCapture):
    """At rest for the first six frames, then moving at 60 cm a second."""

    def pose_at(self, t: float) -> np.ndarray:
        return super().pose_at(max(0.0, t - 5))


@pytest.mark.parametrize("name", ["bottle", "football", "cup"])
def test_rests_and_unobserved_axes(name):
    mesh = mesh_of(name)
    capture = Lifted.make(mesh, 10, cameras=3, label=name, speed=0.04, turn_deg=4.0)
    start = capture.poses[0].copy()
    start[:3, 3] += 0.005
    track = track_of(capture, annotate(0, start))
    poses = np.array([frame.fit.pose for frame in track.frames])
    resting = np.array([frame.resting for frame in track.frames])
    assert resting[:5].all() and not resting[7:].any()
    assert (poses[:5] == poses[0]).all()
    assert errors_of(mesh, track, capture.poses)[0].max() < 0.006
    for frame in track.frames:
        turns, free = frame.fit.covariance[:3, :3], frame.free_axis
        if name == "cup":
            assert (free == 0).all()
            continue
        assert np.linalg.norm(free) == pytest.approx(1)
        assert free @ turns @ free > 3.0  # any turn about it is equally likely
        if name == "bottle":
            assert np.allclose(free, frame.fit.pose[:3, 2], atol=1e-6)
            across = np.cross(free, [1.0, 0.3, 0.2])
            across /= np.linalg.norm(across)
            assert across @ turns @ across < 0.05
    # the unobserved spin does not jump
    steps = mesh.symmetry.none().rotation_error_deg(poses[1:, :3, :3], poses[:-1, :3, :3])
    assert steps.max() < 12


@pytest.fixture(scope="module")
def written(capture, tmp_path_factory):
    return capture.write(tmp_path_factory.mktemp("object_track"))


@pytest.fixture
def run(written, tmp_path):
    """Run the stage on the recording; returns its artefact."""

    def run_stage(name: str = "suitcase", output: str = "track.h5", **options):
        entry = catalogue()[name]
        object_track.run(
            **written, output=tmp_path / output, object_=entry, settings=SETTINGS, **options
        )
        return tmp_path / output

    return run_stage


def test_the_stage_writes_the_track(run, capture):
    with artefacts.read(run(), OBJECT_TRACK) as track:
        assert track.attributes["seed_source"] == "search"
        shift = np.linalg.norm(track["translation"] - capture.poses[:, :3, 3], axis=1)
        assert np.median(shift) < 0.002 and shift.max() < 0.004
        assert not track["lost"].any()
        assert (track["candidate"] >= 0).mean() > 0.9
        assert np.nanmedian(track["overlap"]) > 0.85
        assert np.nanmedian(track["depth_residual"]) < 0.004


def test_an_annotation_of_a_missing_frame_is_an_error(run, tmp_path):
    pose = ObjectPose(frame=99, rotation_vector=(0, 0, 0), translation=(0, 0, 2))
    with pytest.raises(UserError, match="frame 99"):
        run("cup", "x.h5", poses=[pose])
    assert not (tmp_path / "x.h5").exists()


def test_images_overrule_a_contradicted_annotation(run, capture, caplog):
    place = capture.poses[1, :3, 3] + capture.master_from_room[:3, :3] @ (0.1, -0.9, 0.3)
    turn = Rotation.from_matrix(capture.poses[1, :3, :3]).as_rotvec()
    with artefacts.read(
        run(poses=[ObjectPose(frame=1, rotation_vector=turn, translation=place)]), OBJECT_TRACK
    ) as track:
        assert track.attributes["seed_source"] == "annotated against the images"
        doubt = track.attributes["doubts"]
        assert "annotated pose of frame 1 (stated to 10 mm" in doubt and "correct it" in doubt
        assert not track["carried"].any() and not track["lost"].any()
        shift = np.linalg.norm(track["translation"] - capture.poses[:, :3, 3], axis=1)
        assert shift.max() < 0.005
    assert "annotated pose of frame 1" in caplog.text


def assert_absent(output, reason: str) -> None:
    with artefacts.read(output, OBJECT_TRACK) as track:
        assert track.attributes["seed_source"] == "none" and track.attributes["seed_frame"] == -1
        doubts = track.attributes["doubts"]
        assert reason in doubts and "annotate" in doubts
        assert track["lost"].all() and (track["candidate"] == -1).all()
        assert np.isnan(track["rotation"]).all() and np.isnan(track["translation"]).all()


def test_an_object_that_no_image_shows_is_absent(run, caplog):
    """A cup is tracked in a recording of a suitcase."""
    assert_absent(run("cup"), "it was found in no frame")
    assert "object 'cup': it was found in no frame" in caplog.text


def test_a_track_without_enough_evidence_is_absent(run, capture, caplog, monkeypatch):
    frames = [FrameResult(FittedPose(pose, np.eye(6), ())) for pose in capture.poses]
    weak = Track(frames, 0, False, 11.0)
    monkeypatch.setattr(Tracker, "run", lambda self, annotated: weak)
    assert weak.shows_nothing and not replace(weak, evidence=13.0).shows_nothing
    assert not replace(weak, annotated=True).shows_nothing
    assert_absent(run(), "is rejected")
    assert "do not support it" in caplog.text
