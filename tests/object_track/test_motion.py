"""Predicted motion, fits of moving objects, and which hypotheses are kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.geometry.camera.transforms import apply_step, rigid, step_between
from intercap_core.object_track.decoder import Decoded
from intercap_core.object_track.fit import FittedPose, seen_by
from intercap_core.object_track.hypotheses import MAX_HYPOTHESES, Hypotheses
from intercap_core.object_track.motion import (
    estimate_hand_motions,
    predict_prior,
    shift_twist,
    unwrap_symmetry,
)
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.whole import FrameResult, FrameStatus, WholeTrack
from tests.helpers.object_capture import FPS, ObjectCapture
from tests.object_track.scenes import Still, images_of, mesh_of, observer_of, views_of

ELBOW, WRIST = 3, 4
FRAMES = 6
OFFSETS = np.array([0.0, 0.03, 0.02, -0.02])  # of the exposures, seconds


def joints_of(elbow: np.ndarray, wrist: np.ndarray) -> np.ndarray:
    """Joints (2, 135, 3) in which only the right forearm is known; elbow and wrist (2, 3)."""
    joints = np.full((2, 135, 3), np.nan)
    joints[:, ELBOW], joints[:, WRIST] = elbow, wrist
    return joints


def test_a_held_object_moves_with_wrist_and_forearm():
    turn = Rotation.from_rotvec([0.0, 0.0, 0.6]).as_matrix()
    shift = np.array([0.1, -0.05, 0.02])
    elbow, wrist = np.array([0.0, 0.0, 0.0]), np.array([0.25, 0.0, 0.0])
    after = np.stack([elbow + shift, turn @ wrist + shift])
    joints = joints_of(np.stack([elbow, after[0]]), np.stack([wrist, after[1]]))
    pose = rigid(np.eye(3), np.array([0.33, 0.02, 0.0]))
    (hand, _) = estimate_hand_motions(joints)
    assert hand is not None and hand.reaches(pose[:3, 3], 0.05)
    np.testing.assert_allclose(hand.carry(pose), rigid(turn, shift) @ pose, atol=1e-12)


def test_a_hand_turns_with_a_visible_palm():
    """The forearm stays, the palm turns by 50 degrees about it."""
    turn = Rotation.from_rotvec(np.radians(50) * np.array([1.0, 0.0, 0.0])).as_matrix()
    elbow, wrist = np.array([0.0, 0.0, 0.0]), np.array([0.25, 0.0, 0.0])
    knuckles = np.array([[0.34, 0.03, 0.01], [0.33, -0.04, 0.0]])
    joints = joints_of(np.stack([elbow, elbow]), np.stack([wrist, wrist]))
    seen = [KEYPOINT_NAMES.index(f"right_{finger}1") for finger in ("index", "pinky")]
    joints[0, seen], joints[1, seen] = knuckles, (knuckles - wrist) @ turn.T + wrist
    right, left = estimate_hand_motions(joints)
    assert left is None and right is not None
    np.testing.assert_allclose(right.turn, turn, atol=1e-12)
    unknown, line = joints.copy(), joints.copy()
    unknown[1, seen[1]] = np.nan
    line[1, seen] = joints[1, WRIST] + [[0.08, 0, 0], [0.09, 0, 0]]
    for palmless in (unknown, line):  # the turn is that of the forearm
        (right, _) = estimate_hand_motions(palmless)
        assert right is not None
        np.testing.assert_allclose(right.turn, np.eye(3), atol=1e-12)


def test_an_object_out_of_reach_is_not_carried():
    forearm = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]), np.array([[0.25, 0, 0], [0.5, 0, 0]])
    joints = joints_of(*forearm)
    (hand, _) = estimate_hand_motions(joints)
    assert hand is not None
    assert hand.reaches(np.array([[0.7, 0, 0], [0.35, 0, 0]]), 0.05).tolist() == [False, True]
    joints[1, WRIST] = np.nan  # unknown in the next frame
    assert estimate_hand_motions(joints) == [None, None]


def test_the_prior_widens_with_time():
    pose = np.eye(4)
    now, later = (predict_prior(pose, pose, pose, 1 / 30, unseen) for unseen in (0.0, 0.5))
    assert later.sigma_m > 10 * now.sigma_m and later.sigma_rad > 10 * now.sigma_rad
    slow, fast = (predict_prior(pose, pose, pose, step) for step in (1 / 30, 1 / 15))
    assert fast.sigma_m == 2 * slow.sigma_m


def test_a_twist_is_the_same_motion_at_any_point():
    rng = np.random.default_rng(1)
    pose, other = rigid(np.array([np.eye(3)] * 2), rng.normal(size=(2, 3)))
    twist = 0.001 * rng.normal(size=6)
    of_other = shift_twist(twist, pose[:3, 3], other[:3, 3])
    together = apply_step(pose, twist) @ np.linalg.inv(pose) @ other
    np.testing.assert_allclose(apply_step(other, of_other), together, atol=1e-5)
    np.testing.assert_allclose(shift_twist(of_other, other[:3, 3], pose[:3, 3]), twist, atol=1e-15)


@pytest.fixture(scope="module")
def swung(suitcase) -> ObjectCapture:
    capture = ObjectCapture.make(suitcase, FRAMES, speed=0.1, turn_deg=10.0)
    capture.time_offset = OFFSETS
    return capture


@pytest.fixture(scope="module")
def observer(swung) -> Observer:
    return observer_of(swung)


def hypotheses_of(observer: Observer) -> Hypotheses:
    return Hypotheses(observer)


def decided_first(counts: list[int]) -> Decoded:
    """The first hypothesis of every frame is chosen; all are equally probable."""
    shares = [np.append(np.full(n, 1 / n), 0.0) for n in counts]
    return Decoded(np.zeros(len(counts), int), shares, np.zeros(len(counts)), 0.0)


def true_twist(capture: ObjectCapture, t: float) -> np.ndarray:
    return FPS * 20 * step_between(capture.pose_at(t - 0.025), capture.pose_at(t + 0.025))


def test_the_true_pose_is_likely_with_its_motion_only(swung, observer):
    pose, twist = swung.poses[2], true_twist(swung, 2)
    still, moving = observer.assess(2, pose), observer.assess(2, pose, twist=twist)
    assert moving.log_ratio > still.log_ratio + 10
    assert observer.assess(2, pose, twist=np.zeros(6)).log_ratio == still.log_ratio
    for own, late in zip(seen_by(pose, observer.views(2), twist), OFFSETS, strict=True):
        np.testing.assert_allclose(own, swung.pose_at(2 + FPS * late), atol=2e-3)


def test_moving_objects_are_fitted_again_with_their_motion(swung, observer):
    hypotheses = hypotheses_of(observer)
    for t, pose in enumerate(swung.poses):
        hypotheses.fits[t] = [observer.fit(t, pose, None)]
    before = [fits[0] for fits in hypotheses.fits]
    assert 2 in hypotheses.refit_moving(decided_first([1] * FRAMES))
    after = [fits[0] for fits in hypotheses.fits]

    def error(fits: list[FittedPose]) -> float:
        away = np.array([fit.pose for fit in fits]) - swung.poses
        return float(np.median(np.linalg.norm(away[:, :3, 3], axis=1)))

    assert error(after) < 0.4 * error(before)
    assert after[2].log_ratio > before[2].log_ratio + 5
    np.testing.assert_allclose(after[2].twist, true_twist(swung, 2), rtol=0.2, atol=0.15)


def test_equivalent_poses_are_one_motion():
    """A skateboard turns steadily; from frame 3 on it is found in an equivalent pose."""
    board = ObjectCapture.make(mesh_of("skateboard"), FRAMES, speed=0.05, turn_deg=9.0)
    board.time_offset = OFFSETS
    symmetry = board.mesh.symmetry
    assert not symmetry.trivial
    poses = board.poses.copy()
    poses[3:] = poses[3:] @ symmetry.discrete[1]
    known = np.array([True, True, True, False, True, True])
    found = unwrap_symmetry(symmetry, poses, known)
    np.testing.assert_allclose(found[known], board.poses[known], atol=1e-9)
    observer = observer_of(board)
    hypotheses = hypotheses_of(observer)
    for t, pose in enumerate(poses):
        hypotheses.fits[t] = [observer.fit(t, pose, None)]
    hypotheses.refit_moving(decided_first([1] * FRAMES))
    for t in (2, 3):
        turn = hypotheses.fits[t][0].twist[:3]
        np.testing.assert_allclose(turn, true_twist(board, t)[:3], atol=0.5)


def test_hypotheses_that_become_equal_are_merged(swung, observer):
    hypotheses = hypotheses_of(observer)
    aside = np.eye(4)
    aside[:3, :3] = Rotation.from_euler("z", 14, degrees=True).as_matrix()
    for t, pose in enumerate(swung.poses):
        hypotheses.fits[t] = observer.assess_all(t, np.array([pose, pose @ aside]))
    hypotheses.refit_moving(decided_first([2] * FRAMES))
    assert all(len(fits) == 1 for fits in hypotheses.fits[1:-1])


def test_of_too_many_hypotheses_isolated_turns_are_kept(swung, observer):
    """Twelve turns 30 degrees apart, and a likelier one between two of them."""
    hypotheses = hypotheses_of(observer_of(swung, [observer.views(0)], up=None, times=np.zeros(1)))
    nothing = replace(observer.assess(0, swung.poses[0]).views[0], log_ratio=0.0)

    def turned(degrees: float, nats: float) -> FittedPose:
        pose = swung.poses[0].copy()
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("z", degrees, degrees=True).as_matrix()
        return FittedPose(pose, np.eye(6), (replace(nothing, log_ratio=nats),))

    for number in range(MAX_HYPOTHESES):
        hypotheses.add(0, turned(30.0 * number, 20.0 - number))
    hypotheses.add(0, turned(315.0, 30.0))
    left = [fit.log_ratio for fit in hypotheses.fits[0]]
    assert len(left) == MAX_HYPOTHESES and 30.0 in left
    # of 300 and 330 degrees, which are close to it, the less likely one is dropped
    assert 20.0 - 11 not in left and 20.0 - 10 in left and 20.0 - 6 in left
    hypotheses.add(0, turned(75.0, -4.0))
    assert -4.0 not in [fit.log_ratio for fit in hypotheses.fits[0]]


@pytest.mark.parametrize("contradicted", [False, True])
def test_a_moment_out_of_sight_is_bridged_unless_contradicted(suitcase, contradicted):
    capture = Still.make(suitcase, FRAMES, cameras=3)
    images = images_of(capture, () if contradicted else (2,))
    if contradicted:
        capture.hidden = {2}  # the images show that the object is not there
        images[2] = views_of(capture, 2)
    observer = observer_of(capture, images)
    fits = [observer.fit(t, capture.poses[t], None) for t in range(FRAMES)]
    frames = [FrameResult(fit) for fit in fits]
    frames[2] = FrameResult(fits[2], FrameStatus.LOST)
    status = [frame.status for frame in WholeTrack(observer).refine(frames)]
    assert status.pop(2) == (FrameStatus.LOST if contradicted else FrameStatus.BRIDGED)
    assert set(status) == {FrameStatus.SEEN}
