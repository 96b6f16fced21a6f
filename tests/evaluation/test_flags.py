"""Limbs whose left and right are exchanged for some frames."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.evaluation.flags import exchanged

T = 12
LEGS = [
    [JOINT_INDEX[f"{side}_{n}"] for n in ("knee", "ankle", "foot")] for side in ("left", "right")
]


def _standing() -> np.ndarray:
    joints = np.zeros((T, 55, 3))
    joints[:, LEGS[0], 0], joints[:, LEGS[1], 0] = 0.15, -0.15
    joints[:, LEGS[0] + LEGS[1], 1] = np.tile([0.5, 0.1, 0.0], 2)
    return joints


@pytest.mark.parametrize("frames", [[4], [0, 1], [10, 11], [3, 4, 5, 8]])
def test_frames_of_exchanged_legs(frames: list[int]) -> None:
    joints = _standing()
    for t in frames:
        joints[t, LEGS[0] + LEGS[1]] = joints[t, LEGS[1] + LEGS[0]]
    found = exchanged(joints)
    np.testing.assert_array_equal(np.flatnonzero(found["legs"]), frames)
    assert not found["arms"].any()


def test_steps_and_crossing_legs_are_left_alone() -> None:
    joints = _standing()
    across = np.linspace(0.15, -0.15, T)[:, None]  # passes the other leg, which stays
    joints[:, LEGS[0], 0] = across
    joints[:, LEGS[0], 2] = 0.2
    assert not exchanged(joints)["legs"].any()
    fast = _standing()
    fast[6:, LEGS[0], 2] = 0.5  # a kick: no other leg was there
    assert not exchanged(fast)["legs"].any()


def test_a_single_frame_has_nothing_to_compare() -> None:
    assert not exchanged(_standing()[:1])["legs"].any()
