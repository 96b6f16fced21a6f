"""Where the object is expected next: in a hand that holds it."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.object_track.motion import carried, expected, hand_motions

ELBOW, WRIST = 3, 4


def joints_of(elbow: np.ndarray, wrist: np.ndarray) -> np.ndarray:
    """Joints (2, 135, 3) in which only the right forearm is known; elbow and wrist (2, 3)."""
    joints = np.full((2, 135, 3), np.nan)
    joints[:, ELBOW], joints[:, WRIST] = elbow, wrist
    return joints


def test_it_moves_with_the_wrist_and_turns_with_the_forearm() -> None:
    turn = Rotation.from_rotvec([0.0, 0.0, 0.6]).as_matrix()
    shift = np.array([0.1, -0.05, 0.02])
    elbow, wrist = np.array([0.0, 0.0, 0.0]), np.array([0.25, 0.0, 0.0])
    after = np.stack([elbow + shift, turn @ wrist + shift])
    joints = joints_of(np.stack([elbow, after[0]]), np.stack([wrist, after[1]]))
    pose = np.eye(4)
    pose[:3, 3] = [0.33, 0.02, 0.0]
    found = carried(joints, pose, pose[:3, 3], 0.05)
    assert len(found) == 1
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = turn, shift
    np.testing.assert_allclose(found[0], rigid @ pose, atol=1e-12)


def test_it_turns_with_the_palm_where_that_is_seen() -> None:
    """The forearm stays, the palm turns by 50 degrees about it: a turn that no forearm shows."""
    turn = Rotation.from_rotvec(np.radians(50) * np.array([1.0, 0.0, 0.0])).as_matrix()
    elbow, wrist = np.array([0.0, 0.0, 0.0]), np.array([0.25, 0.0, 0.0])
    knuckles = np.array([[0.34, 0.03, 0.01], [0.33, -0.04, 0.0]])
    joints = joints_of(np.stack([elbow, elbow]), np.stack([wrist, wrist]))
    seen = [KEYPOINT_NAMES.index(f"right_{finger}1") for finger in ("index", "pinky")]
    joints[0, seen], joints[1, seen] = knuckles, (knuckles - wrist) @ turn.T + wrist
    right, left = hand_motions(joints)
    assert left is None and right is not None
    np.testing.assert_allclose(right.turn, turn, atol=1e-12)
    joints[1, seen[1]] = np.nan  # then it is the forearm's turn
    (right, _) = hand_motions(joints)
    assert right is not None
    np.testing.assert_allclose(right.turn, np.eye(3), atol=1e-12)
    joints[1, seen] = joints[1, WRIST] + [[0.08, 0, 0], [0.09, 0, 0]]  # and where a palm is a line
    (right, _) = hand_motions(joints)
    assert right is not None
    np.testing.assert_allclose(right.turn, np.eye(3), atol=1e-12)


def test_what_no_hand_reaches_is_not_carried() -> None:
    forearm = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]), np.array([[0.25, 0, 0], [0.5, 0, 0]])
    joints = joints_of(*forearm)
    far = np.eye(4)
    far[0, 3] = 0.7
    assert len(carried(joints, far, far[:3, 3], 0.05)) == 0
    assert len(carried(np.full((2, 135, 3), np.nan), far, far[:3, 3], 0.05)) == 0
    near = np.eye(4)
    near[0, 3] = 0.35
    joints[1, WRIST] = np.nan  # lost in the next frame
    assert len(carried(joints, near, near[:3, 3], 0.05)) == 0


def test_the_longer_unseen_the_less_is_expected() -> None:
    pose = np.eye(4)
    now, later = (expected(pose, pose, pose, 1 / 30, unseen) for unseen in (0.0, 0.5))
    assert later.sigma_m > 10 * now.sigma_m and later.sigma_rad > 10 * now.sigma_rad
    slow, fast = (expected(pose, pose, pose, step) for step in (1 / 30, 1 / 15))
    assert fast.sigma_m == 2 * slow.sigma_m
