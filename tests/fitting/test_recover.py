"""Frames that leave the motion of their neighbours."""

from __future__ import annotations

import numpy as np

from intercap_core.fitting.recover import jumps

TIMES = np.arange(40) / 15


def _swinging() -> np.ndarray:
    """(40,2,3): a hand that walks at 1.5 m/s and swings at up to 2 m/s, and a pelvis that walks."""
    joints = np.zeros((len(TIMES), 2, 3))
    joints[:, :, 0] = 1.5 * TIMES[:, None]
    joints[:, 0, 1] = 0.3 * np.sin(2 * np.pi * TIMES)
    return joints


def test_people_do_not_jump():
    assert not jumps(_swinging(), TIMES).any()


def test_an_arm_elsewhere_for_three_frames_jumps():
    joints = _swinging()
    joints[20:23, 0, 2] += 0.4
    found = jumps(joints, TIMES)
    assert (found[20:23, 0] > 0.35).all()
    found[20:23, 0] = 0
    assert not found.any()


def test_gaps_and_ends_say_nothing():
    joints = _swinging()
    joints[[0, -1], 0, 2] += 1.0
    joints[20, 0, 2] += 1.0
    alone = np.r_[TIMES[:20], TIMES[20] + 1, TIMES[21:] + 2]
    found = jumps(joints, alone)
    assert not found[[0, 20, -1]].any()
