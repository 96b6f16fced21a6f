"""Smoothed poses of hands, from the frames around a frame and the object that the hand holds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.parameters import HAND_COLUMNS
from intercap_core.joint.hand_track import smooth_hands
from intercap_core.joint.state import State

FRAMES, FPS = 40, 15.0
WRIST = slice(3 * JOINT_INDEX["right_wrist"], 3 * JOINT_INDEX["right_wrist"] + 3)
BAD = slice(12, 20)
STILL = Rotation.identity(FRAMES)


def _rotations(rate: tuple[float, float, float]) -> Rotation:
    """Rotations about a fixed axis; ``rate`` in radians per second."""
    return Rotation.from_rotvec(np.outer(np.arange(FRAMES) / FPS, rate))


def _state(wrist: Rotation, objects: Rotation) -> State:
    """A body whose only rotation is that of the right wrist, and an object at the origin."""
    body = np.zeros((FRAMES, 168))
    body[:, WRIST] = wrist.as_rotvec()
    return State(
        body, np.zeros(10), np.zeros((FRAMES, 10)), objects.as_matrix(), np.zeros((FRAMES, 3))
    )


def _joints(wrist: np.ndarray) -> np.ndarray:
    """Joints (T, 55, 3) with the right wrist at ``wrist`` (T, 3), and the elbow 0.25 m above."""
    joints = np.zeros((FRAMES, 55, 3))
    joints[:, JOINT_INDEX["right_wrist"]] = wrist
    joints[:, JOINT_INDEX["right_elbow"]] = wrist + np.array([0, 0, 0.25])
    joints[:, JOINT_INDEX["left_elbow"], 2] = 0.25
    return joints


def _spoilt(true: State, stated: float) -> tuple[State, np.ndarray]:
    """The state with random poses of the right hand in ``BAD`` whose deviation is ``stated``."""
    rng, body, sigma = np.random.default_rng(1), true.body.copy(), np.full((FRAMES, 2), 0.005)
    body[BAD, WRIST] = rng.normal(0, 1, (8, 3))
    body[BAD, HAND_COLUMNS[1]] = rng.normal(0, 1, (8, 45))
    sigma[BAD, 1] = stated
    return State(body, true.betas, true.expression, true.rotation, true.translation), sigma


def _angle(state: State, true: State) -> np.ndarray:
    ours, theirs = (Rotation.from_rotvec(s.body[:, WRIST]) for s in (state, true))
    return (ours * theirs.inv()).magnitude()


@pytest.mark.parametrize("stated", [0.04, 0.005], ids=["undetermined", "confident"])
def test_a_hand_turns_with_the_object_that_it_holds(stated: float) -> None:
    """Between the determined frames the object turns away and comes back."""
    swing = Rotation.from_rotvec(np.outer(np.sin(np.arange(FRAMES) / 2.5), [0, 0, 1.0]))
    true = _state(swing * Rotation.from_rotvec([0.3, -0.2, 0.5]), swing)
    joints = _joints(swing.apply([0.3, 0, 0]))
    found, _ = smooth_hands(*_with_joints(true, joints, stated))
    assert _angle(found, true).max() < 0.1
    assert np.abs(found.body[BAD, HAND_COLUMNS[1]]).max() < 0.1


def _with_joints(
    true: State, joints: np.ndarray, stated: float
) -> tuple[State, np.ndarray, np.ndarray, float]:
    state, sigma = _spoilt(true, stated)
    return state, joints, sigma, FPS


def test_a_free_hand_does_not_follow_the_object() -> None:
    true = _state(_rotations((0.0, 0.2, 0.0)), _rotations((2.0, 0.0, 0.0)))
    wrist = np.zeros((FRAMES, 3)) + np.array([0.3, 0.2, 0])
    found, _ = smooth_hands(*_with_joints(true, _joints(wrist), 0.04))
    assert _angle(found, true).max() < 0.15


def test_without_an_object_the_hand_follows_the_frames_around() -> None:
    true = _state(_rotations((0.0, 0.2, 0.0)), STILL).without_object()
    found, _ = smooth_hands(*_with_joints(true, _joints(np.zeros((FRAMES, 3))), 0.04))
    assert _angle(found, true).max() < 0.15


def test_determined_hands_keep_a_fast_motion() -> None:
    """3 rad/s, without an object."""
    true = _state(_rotations((0, 3.0, 0)), STILL).without_object()
    sigma = np.full((FRAMES, 2), 0.005)
    found, _ = smooth_hands(true, _joints(np.zeros((FRAMES, 3))), sigma, FPS)
    np.testing.assert_array_equal(found.body, true.body)


def test_the_deviation_grows_where_no_frame_determines_the_hand() -> None:
    true = _state(STILL, STILL).without_object()
    state, joints, sigma, fps = _with_joints(true, _joints(np.zeros((FRAMES, 3))), 0.5)
    _, deviation = smooth_hands(state, joints, sigma, fps)
    middle = deviation[(BAD.start + BAD.stop) // 2, 1]
    assert middle > 2 * deviation[30, 1]
    assert deviation[:, 0].max() < middle
