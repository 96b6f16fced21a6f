"""Hands in undetermined frames, from the frames around them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.parameters import HAND_COLUMNS
from intercap_core.joint.state import State
from intercap_core.joint.undetermined_hands import interpolate_hands

FRAMES, FPS = 40, 15.0
WRIST = slice(3 * JOINT_INDEX["right_wrist"], 3 * JOINT_INDEX["right_wrist"] + 3)
BAD = slice(12, 20)
NOBODY = np.zeros((FRAMES, 2), bool)


def _rotations(rate: tuple[float, float, float]) -> Rotation:
    """Rotations about a fixed axis; ``rate`` in radians per second."""
    return Rotation.from_rotvec(np.outer(np.arange(FRAMES) / FPS, rate))


def _state(wrist: Rotation, objects: Rotation) -> State:
    """A body whose only rotation is that of the right wrist, and an object."""
    body = np.zeros((FRAMES, 168))
    body[:, WRIST] = wrist.as_rotvec()
    return State(
        body, np.zeros(10), np.zeros((FRAMES, 10)), objects.as_matrix(), np.zeros((FRAMES, 3))
    )


def _spoilt(state: State) -> tuple[State, np.ndarray]:
    """The same with other poses of the right hand in ``BAD``, and the mask of these."""
    rng, body = np.random.default_rng(1), state.body.copy()
    body[BAD, WRIST] = rng.normal(0, 1, (8, 3))
    body[BAD, HAND_COLUMNS[1]] = rng.normal(0, 1, (8, 45))
    undetermined = NOBODY.copy()
    undetermined[BAD, 1] = True
    return State(
        body, state.betas, state.expression, state.rotation, state.translation
    ), undetermined


def _angle(state: State, true: State) -> np.ndarray:
    ours, theirs = (Rotation.from_rotvec(s.body[:, WRIST]) for s in (state, true))
    return (ours * theirs.inv()).magnitude()


def test_a_hand_turns_with_the_object_that_it_holds() -> None:
    """Oscillation: between the determined frames the object turns away and comes back."""
    swing = Rotation.from_rotvec(np.outer(np.sin(np.arange(FRAMES) / 2.5), [0, 0, 1.0]))
    grasp = Rotation.from_rotvec([0.3, -0.2, 0.5])
    true = _state(swing * grasp, swing)
    found = interpolate_hands(*_spoilt(true), FPS)
    assert _angle(found, true).max() < 1e-6
    assert not found.body[BAD, HAND_COLUMNS[1]].any()


def test_a_free_hand_does_not_follow_the_object() -> None:
    true = _state(_rotations((0.0, 0.2, 0.0)), _rotations((2.0, 0.0, 0.0)))
    assert _angle(interpolate_hands(*_spoilt(true), FPS), true).max() < 1e-6


def test_without_an_object_the_hand_is_interpolated() -> None:
    true = _state(_rotations((0.0, 0.2, 0.0)), _rotations((0, 0, 0))).without_object()
    assert _angle(interpolate_hands(*_spoilt(true), FPS), true).max() < 1e-6


def test_single_wrong_orientations_are_found() -> None:
    true = _state(_rotations((0.0, 1.0, 0.0)), _rotations((0, 0, 0)))
    body = true.body.copy()
    body[[9, 25], WRIST] += (1.2, 0, 0)
    wrong = State(body, true.betas, true.expression, true.rotation, true.translation)
    assert _angle(interpolate_hands(wrong, NOBODY, FPS), true).max() < 1e-6


@pytest.mark.parametrize("rate", [0.5, 2.0])
def test_determined_hands_keep_their_poses(rate: float) -> None:
    true = _state(_rotations((rate, 0, 0)), _rotations((0, 0, 0)))
    np.testing.assert_array_equal(interpolate_hands(true, NOBODY, FPS).body, true.body)


def test_a_hand_that_is_never_determined_is_unchanged() -> None:
    true = _state(_rotations((0.5, 0, 0)), _rotations((0, 0, 0)))
    never = np.ones((FRAMES, 2), bool)
    np.testing.assert_array_equal(interpolate_hands(true, never, FPS).body, true.body)
