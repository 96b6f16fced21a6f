"""Annotated poses: their evidence by hand, and tracks that are lost around them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.transforms import rigid
from intercap_core.object_track.evidence import TURN_SCALE
from intercap_core.object_track.fit import FittedPose
from intercap_core.object_track.given_poses import (
    GivenEvidence,
    GivenPose,
    flag_edges,
    seconds_since,
)
from intercap_core.object_track.motion import GROWTH_LOST_M_S
from intercap_core.object_track.tracker import Track, describe_contradiction
from intercap_core.object_track.turns import UNSURE_M
from intercap_core.object_track.view_report import ViewReport
from intercap_core.object_track.whole import FrameResult, FrameStatus, flag_frames
from intercap_core.stages import object_track
from tests.helpers.object_capture import ObjectCapture
from tests.object_track.scenes import (
    FIVE_DEGREES,
    Still,
    annotate,
    disturb,
    errors_of,
    frames_with,
    images_of,
    track_of,
)


def at(x: float = 0.0, degrees: float = 0.0) -> np.ndarray:
    """A pose (4, 4), 2 m ahead."""
    turn = Rotation.from_euler("y", degrees, degrees=True)
    return rigid(turn.as_matrix(), np.array([x, 0, 2]))


def test_poses_agree_within_stated_deviations(suitcase):
    given = annotate(0, at())
    centre = suitcase.centre_of_mass
    turned = at(degrees=10)
    turned[:3, 3] += centre - turned[:3, :3] @ centre  # about the centre
    assert given.distance(suitcase, at(0.02)) == pytest.approx((0, 0.02), abs=1e-5)
    assert given.distance(suitcase, turned) == pytest.approx((np.radians(10), 0), abs=1e-5)
    # three standard deviations and 2 cm
    assert given.holds(suitcase, at(0.045)) and not given.holds(suitcase, at(0.055))
    assert GivenPose(0, at(), 0.02, FIVE_DEGREES).holds(suitcase, at(0.075))


def test_seconds_since_the_nearest_annotated_frame():
    unseen = np.array([1, 1, 0, 1, 1, 1, 1, 0, 1], bool)
    since = seconds_since([3, 6], unseen, np.arange(9.0))
    np.testing.assert_array_equal(since, [np.inf, np.inf, np.inf, 0, 1, 1, 0, np.inf, np.inf])
    np.testing.assert_array_equal(seconds_since([2], unseen, np.arange(9.0))[:4], [2, 1, 0, 1])
    assert np.isinf(seconds_since([], unseen, np.arange(9.0))).all()


def test_evidence_has_stated_deviations_that_grow_with_time(suitcase):
    poses = np.tile(at(), (4, 1, 1))
    unseen = np.array([False, True, True, False])
    found = GivenEvidence.of(suitcase, [annotate(1, at(0.03))], poses, unseen, np.arange(4.0))
    np.testing.assert_array_equal(found.carried, unseen)
    assert not found.information[[0, 3]].any()
    to_centre = np.concatenate([np.cross(np.eye(3), suitcase.centre_of_mass).T, np.eye(3)], axis=1)
    scale = np.outer(TURN_SCALE, TURN_SCALE)  # of the solver's covariance of turns
    covariance = np.linalg.inv(found.information[1]) * scale
    centre = to_centre @ covariance @ to_centre.T
    np.testing.assert_allclose(centre, np.eye(3) * 0.01**2, atol=1e-9)
    np.testing.assert_allclose(covariance[:3, :3], np.eye(3) * FIVE_DEGREES**2, atol=1e-9)
    later = to_centre @ (np.linalg.inv(found.information[2]) * scale) @ to_centre.T
    np.testing.assert_allclose(np.diag(later), (0.01 + GROWTH_LOST_M_S) ** 2, rtol=1e-6)
    # the gradient leads back to the annotated pose
    step = np.linalg.solve(found.information[1], -found.at(poses).gradient[1])
    np.testing.assert_allclose(step, [0, 0, 0, 0.03, 0, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("x", "seen", "excluded"), [(0.0, True, []), (0.3, True, [2, 3]), (0.0, False, [0, 1, 2, 3, 4])]
)
def test_unseen_or_contradicted_rests_are_excluded(suitcase, x, seen, excluded):
    poses, segment = np.tile(at(), (6, 1, 1)), np.array([0, 0, 0, 0, 0, -1])
    carried = np.array([not seen, not seen, True, True, not seen, False])
    given = GivenEvidence(poses, np.zeros((6, 6, 6)), carried, (annotate(2, at(x)),))
    found = given.exclude_from_rests(suitcase, poses, segment)
    assert np.flatnonzero(found).tolist() == excluded


def frame(pose: np.ndarray, status: FrameStatus, sigma_m: float = 0.001) -> FrameResult:
    covariance = np.diag(np.repeat([1e-6, sigma_m**2], 3))
    return FrameResult(FittedPose(pose, covariance, ()), status)


@pytest.mark.parametrize(
    ("status", "sigmas", "expected", "ambiguous"),
    [
        (FrameStatus.SEEN, 0.5, FrameStatus.SEEN, False),
        (FrameStatus.SEEN, 2, FrameStatus.LOST, False),
        (FrameStatus.CARRIED, 0.5, FrameStatus.CARRIED, False),
        (FrameStatus.CARRIED, 2, FrameStatus.CARRIED, True),
        (FrameStatus.CARRIED, 10, FrameStatus.LOST, False),
        (FrameStatus.GONE, 10, FrameStatus.GONE, False),
    ],
)
def test_uncertain_carried_frames_are_ambiguous_first(
    suitcase, status, sigmas, expected, ambiguous
):
    (found,) = flag_frames(suitcase, [frame(at(), status, sigmas * UNSURE_M)])
    assert (found.status, found.ambiguous) == (expected, ambiguous)


def test_single_views_next_to_unseen_frames_are_flagged():
    report = ViewReport(0, 0.9, 500)
    ratios = [(9, 9), (9, 0), (0, 0), (9, 9), (0, 9), (9, 0), (9, -2), (0, 0), (5, -1)]
    fits = [
        FittedPose(at(), np.eye(6), tuple(replace(report, log_ratio=float(nats)) for nats in both))
        for both in ratios
    ]
    unseen = np.isin(np.arange(9), [2, 7])
    times = np.arange(9) / 10
    for frames, seconds, expected in (
        ([5], times, [1, 6, 8]),
        ([1, 6], times, [8]),
        ([], times, []),
        ([5], 10 * times, []),
    ):
        found = flag_edges(fits, unseen, frames, seconds)
        assert np.flatnonzero(found).tolist() == expected


def test_contradictions_of_annotated_poses_are_described(suitcase):
    given, seen = annotate(0, at()), FrameStatus.SEEN
    assert describe_contradiction(suitcase, given, frame(at(0.02), seen)) == ""
    text = describe_contradiction(suitcase, given, frame(at(0.3), seen))
    assert "frame 0 (stated to 10 mm and 5 degrees)" in text and "300 mm and 0 degrees" in text
    text = describe_contradiction(suitcase, given, frame(at(), FrameStatus.LOST))
    assert "show the object nowhere" in text


class Swinging(ObjectCapture):
    """Swings aside by 30 cm and back in frames 3 to 13."""

    def pose_at(self, t: float) -> np.ndarray:
        pose = super().pose_at(t)
        aside = 0.3 * np.sin(np.pi * np.clip((t - 3) / 10, 0, 1)) ** 2
        pose[:3, 3] += aside * self.master_from_room[:3, 0]
        return pose


HIDDEN = range(4, 13)


@pytest.fixture(scope="module")
def swinging(suitcase) -> Swinging:
    return Swinging.make(suitcase, 16, speed=0.02, turn_deg=2, cameras=3)


@pytest.fixture(scope="module")
def hidden(swinging):
    """Images that show nothing in the frames of ``HIDDEN``."""
    return images_of(swinging, HIDDEN)


@pytest.fixture(scope="module")
def alone(swinging, hidden) -> Track:
    return track_of(swinging, images=hidden)


def test_lost_frames_follow_annotated_poses(suitcase, swinging, hidden, alone):
    assert set(frames_with(alone, "lost")) >= set(range(6, 11))
    assert not frames_with(alone, "carried")
    annotated = (6, 8, 10)
    given = [annotate(t, disturb(swinging.poses[t], t)) for t in annotated]
    found = track_of(swinging, *given, images=hidden)
    error, _ = errors_of(suitcase, found, swinging.poses)
    before, _ = errors_of(suitcase, alone, swinging.poses)
    assert not frames_with(found, "lost") and not found.doubts
    assert frames_with(found, "carried") == list(HIDDEN)
    assert frames_with(found, "ambiguous") == [t for t in HIDDEN if t not in annotated]
    inside = slice(HIDDEN.start, HIDDEN.stop)
    assert before[inside].max() > 0.2 and error[inside].max() < 0.04
    assert error[list(annotated)].max() < 0.012
    stated = np.array([np.trace(f.fit.covariance[3:, 3:]) ** 0.5 for f in found.frames])
    assert (error[inside] < 3 * stated[inside]).all()
    assert stated[6] < stated[5] and stated[6] < stated[7]


def test_it_is_carried_for_a_while_after_the_last_seen_frame(suitcase):
    capture = Still.make(suitcase, 8, cameras=3)
    given = annotate(5, disturb(capture.poses[5], 1))
    found = track_of(capture, given, images=images_of(capture, range(2, 8)))
    assert {4, 5, 6} <= set(frames_with(found, "carried"))
    assert errors_of(suitcase, found, capture.poses)[0][4:7].max() < 0.03


def test_annotated_poses_of_seen_frames_change_nothing(capture, images):
    given = [annotate(t, disturb(capture.poses[t], t)) for t in (1, 3)]
    alone, found = track_of(capture, images=images), track_of(capture, *given, images=images)
    assert not frames_with(found, "carried") and not found.doubts
    assert object_track._seed_source(found) == "annotated" and found.seed_frame == 1
    poses = np.array([frame.fit.pose for frame in alone.frames])
    assert errors_of(capture.mesh, found, poses)[0].max() < 0.001
