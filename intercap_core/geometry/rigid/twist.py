"""Small motions of a rigid object: six numbers, a turn about its origin and a shift."""

from __future__ import annotations

import numpy as np

from intercap_core.geometry.rigid.constants import MAX_SPEED_M_S, MAX_TURN_RAD_S
from intercap_core.geometry.rigid.pose import Pose, rotation_log
from intercap_core.geometry.solve.velocity import limited_rate


def twists(poses: np.ndarray, known: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Turn (rad/s, from the left) and shift of the origin (m/s) in a second: (T, 6).

    ``poses`` (T, 4, 4) master_from_object, believed where ``known`` (T,); ``times`` (T,) seconds.
    Zero where nothing is known; limited, so that a single jump hardly affects its neighbours.
    """
    if len(poses) < 2:
        return np.zeros((len(poses), 6))
    turns = rotation_log(poses[1:, :3, :3] @ poses[:-1, :3, :3].transpose(0, 2, 1))
    turn = limited_rate(turns, times, max_speed=MAX_TURN_RAD_S, known=known)
    shifts = np.diff(poses[:, :3, 3], axis=0)
    shift = limited_rate(shifts, times, max_speed=MAX_SPEED_M_S, known=known)
    return np.concatenate([turn, shift], axis=1)


def moved(pose: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Poses (..., 4, 4) after ``step`` (..., 6): a turn about the origin, from the left, and a
    shift, radians and metres."""
    return Pose.of(pose).moved(step).matrix


def step_between(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Steps (..., 6) that take poses ``start`` to ``end`` (..., 4, 4): :func:`moved` undone."""
    return Pose.of(end).step_from(Pose.of(start))
