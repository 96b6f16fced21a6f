"""Poses of hands that the sequential fit does not determine, from the frames that it does.

A detector often misses a hand that holds an object, or takes something else for it. Such a hand is
undetermined in this frame, or its orientation differs from that of the neighbouring frames. Its
orientation is interpolated between the determined frames, in the object's or in the master frame,
in which it changes less: a hand that holds an object turns with it. Fingers are interpolated.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from intercap_core.body.joints import JOINT_INDEX, PARENTS
from intercap_core.body.parameters import HAND_COLUMNS
from intercap_core.joint.state import State

_ARMS = tuple(
    (JOINT_INDEX[f"{side}_elbow"], JOINT_INDEX[f"{side}_wrist"]) for side in ("left", "right")
)


def interpolate_hands(state: State, undetermined: np.ndarray, fps: float) -> State:
    """Interpolate hands in frames that are ``undetermined`` (T, 2), and in outliers.

    A hand with fewer than two other frames is unchanged.
    """
    body, frames = state.body.copy(), np.arange(len(state))
    world = _world_rotations(body)
    for side, (elbow, wrist) in enumerate(_ARMS):
        own = world[:, wrist]
        good = ~undetermined[:, side] & ~_orientation_outliers(own, fps)
        if good.all() or good.sum() < 2:
            continue
        for column in range(HAND_COLUMNS[side].start, HAND_COLUMNS[side].stop):
            body[~good, column] = np.interp(frames[~good], frames[good], body[good, column])
        turned, change = _interpolated(own, good)
        if np.isfinite(state.rotation).all():
            in_object, change_in_object = _interpolated(
                np.swapaxes(state.rotation, 1, 2) @ own, good
            )
            held = change_in_object < change
            turned[held] = state.rotation[~good][held] @ in_object[held]
        local = np.swapaxes(world[~good, elbow], 1, 2) @ turned
        body[~good, 3 * wrist : 3 * wrist + 3] = Rotation.from_matrix(local).as_rotvec()
    return replace(state, body=body)


def _interpolated(rotation: np.ndarray, good: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (N, 3, 3) of the N frames that are not ``good`` (T,), and their uncertainty.

    The second value (N,) is the angle between the two good frames around each, radians. Before the
    first and after the last good frame the rotation is constant, and the angle 0.
    """
    frames = np.flatnonzero(good)
    wanted = np.flatnonzero(~good)
    path = Slerp(frames, Rotation.from_matrix(rotation[frames]))
    after = np.searchsorted(frames, wanted)
    ends = [
        Rotation.from_matrix(rotation[frames[np.clip(k, 0, len(frames) - 1)]])
        for k in (after - 1, after)
    ]
    change = (ends[1] * ends[0].inv()).magnitude()
    return path(np.clip(wanted, frames[0], frames[-1])).as_matrix(), change


def _orientation_outliers(rotation: np.ndarray, fps: float) -> np.ndarray:
    """Mask (T,) of rotations (T, 3, 3) more than 0.5 rad from the middle of their window.

    The middle is the rotation of the window, 0.2 s to each side, with the least sum of angles to
    the others. Hands turn by less within 0.2 s in everyday tasks (tuned).
    """
    half, last = max(1, round(0.2 * fps)), len(rotation) - 1
    around = np.clip(np.arange(len(rotation))[:, None] + np.arange(-half, half + 1), 0, last)
    some = rotation[around]  # (T, W, 3, 3)
    traces = np.einsum("tiab,tjab->tij", some, some)
    angle = np.arccos(np.clip((traces - 1) / 2, -1, 1))
    middle = angle.sum(2).argmin(1)
    return angle[np.arange(len(rotation)), half, middle] > 0.5


def _world_rotations(body: np.ndarray) -> np.ndarray:
    """Rotations (T, 22, 3, 3) of pelvis, trunk and limbs in the master frame, of poses (T, 168)."""
    count = 22
    local = Rotation.from_rotvec(body[:, : 3 * count].reshape(-1, 3)).as_matrix()
    world = local.reshape(-1, count, 3, 3).copy()
    for k in range(1, count):
        world[:, k] = world[:, PARENTS[k]] @ world[:, k]
    return world
