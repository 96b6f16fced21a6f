"""Smoothed hand poses over time, at which the joint fit starts.

A detector often misses a hand that holds an object, or takes something else for it. So the pose of
a hand in one frame is an outlier or undetermined, and the frames around it determine it. The pose
relative to a carrier is a Gauss-Markov process (random walk): relative to the object while the
wrist keeps its place on it, otherwise relative to the forearm. Both carriers predict each step, and
are weighed by the variance of their prediction. The poses of the body fit are its measurements,
with their stated deviations and heavy tails (Cauchy), solved by iterated weighted least squares.
Rotations are averaged as matrices (Moakher 2002, chordal mean). The smoothed pose replaces that of
the body fit only in frames in which the latter is undetermined or an outlier.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import solveh_banded
from scipy.spatial.transform import Rotation

from intercap_core.body.joints import BODY_JOINTS, JOINT_INDEX, PARENTS
from intercap_core.body.parameters import HAND_COLUMNS
from intercap_core.body_fit.quality import LARGEST_HAND_SIGMA_M
from intercap_core.joint.state import State

HAND_M = 0.1  # mean distance of finger joints and fingertips from the wrist (anatomy)
# Random walk of a hand that no object carries, rad in one second: 0.5 rad in 0.2 s, of everyday
# tasks (tuned).
_FREE_WALK = 1.1
HAND_POSE_S = 0.5  # errors of detected hands, and poses of hands, last this long; tuned
# Creep of grips and soles: a random walk, m in one second. Tuned on the studio: without stick grips
# slip by 27 mm/s, with it by 8; without plant soles slip by 34 mm/s, with it by 2
# (bench/RESULTS.md, commit 86d72be).
CREEP = 0.003
_ROUNDS = 10  # of iterated weights


def smooth_hands(
    state: State, joints: np.ndarray, sigma: np.ndarray, fps: float
) -> tuple[State, np.ndarray]:
    """Replace undetermined poses of both hands, and outliers, by smoothed ones.

    Args:
        state: the sequential fits.
        joints: (T, 55, 3) joints of its bodies, metres.
        sigma: (T, 2) stated deviation of the joints of each hand, metres.
        fps: frames per second.

    Returns the state, and the deviation (T, 2) of its hands, metres.
    """
    body, deviation = state.body.copy(), sigma.copy()
    if len(state) < 2:
        return state, deviation
    world = _world_rotations(body)
    lasting = max(1.0, min(HAND_POSE_S * fps, len(state)))
    for side, name in enumerate(("left", "right")):
        elbow, wrist = (JOINT_INDEX[f"{name}_{joint}"] for joint in ("elbow", "wrist"))
        steps, variance = _steps(state, joints[:, elbow], joints[:, wrist], fps)
        carrier = _accumulate(steps)
        seen = np.swapaxes(carrier, 1, 2) @ world[:, wrist]
        fingers = body[:, HAND_COLUMNS[side]]
        measured = lasting * (sigma[:, side] / HAND_M) ** 2
        smooth, fingers, variance = _smooth(seen, fingers, measured, variance)
        replaced = _square_angle(smooth, seen) > measured
        replaced |= sigma[:, side] > LARGEST_HAND_SIGMA_M
        turned = np.swapaxes(world[:, elbow], 1, 2) @ carrier @ smooth
        pose = Rotation.from_matrix(turned).as_rotvec()
        body[replaced, 3 * wrist : 3 * wrist + 3] = pose[replaced]
        body[replaced, HAND_COLUMNS[side]] = fingers[replaced]
        deviation[replaced, side] = HAND_M * np.sqrt(variance[replaced])
    return replace(state, body=body), deviation


def _steps(
    state: State, elbow: np.ndarray, wrist: np.ndarray, fps: float
) -> tuple[np.ndarray, np.ndarray]:
    """Predicted rotations (T - 1, 3, 3) of a hand from frame to frame, and variances (T - 1,).

    The forearm predicts the smallest rotation of its direction. The object predicts its own
    rotation; the wrist's displacement over the object is its error, as an angle.
    """
    arm = wrist - elbow
    arm = arm / np.linalg.norm(arm, axis=1, keepdims=True)
    axis = np.cross(arm[:-1], arm[1:])
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.arctan2(sine[:, 0], (arm[:-1] * arm[1:]).sum(1))
    by_arm = Rotation.from_rotvec(axis * (angle / np.maximum(sine[:, 0], 1e-9))[:, None])
    variance = np.full(len(angle), _FREE_WALK**2 / fps)
    if not np.isfinite(state.rotation).all():
        return by_arm.as_matrix(), variance
    turned = state.rotation[1:] @ np.swapaxes(state.rotation[:-1], 1, 2)
    place = np.einsum("tji,tj->ti", state.rotation, wrist - state.translation)
    slip = window_displacement(place[:, None], fps)[:, 0] / HAND_M
    of_object = (CREEP / HAND_M) ** 2 / fps + np.square(slip)
    share = variance / (variance + of_object)
    apart = (Rotation.from_matrix(turned) * by_arm.inv()).as_rotvec()
    steps = Rotation.from_rotvec(share[:, None] * apart) * by_arm
    return steps.as_matrix(), share * of_object + share * (1 - share) * np.square(apart).sum(1)


def window_displacement(points: np.ndarray, fps: float) -> np.ndarray:
    """Displacement (T - 1, N) of points (T, N, 3), without jitter.

    It leads from the mean place of the last 0.2 s to that of the next 0.2 s.
    """
    half = window_frames(fps)
    total = np.concatenate([np.zeros_like(points[:1]), points.cumsum(axis=0)])
    step = np.arange(max(len(points) - 1, 0))
    first, last = np.maximum(step + 1 - half, 0), np.minimum(step + 1 + half, len(points))
    before = (total[step + 1] - total[first]) / (step + 1 - first)[:, None, None]
    after = (total[last] - total[step + 1]) / (last - step - 1)[:, None, None]
    return np.linalg.norm(after - before, axis=2)


def window_frames(fps: float) -> int:
    """Frames of 0.2 s, at least 1."""
    return max(1, round(0.2 * fps))


def _accumulate(steps: np.ndarray) -> np.ndarray:
    """Products (T, 3, 3) of the steps (T - 1, 3, 3) up to each frame."""
    result = np.tile(np.eye(3), (len(steps) + 1, 1, 1))
    for k, step in enumerate(steps):
        result[k + 1] = step @ result[k]
    return result


def _smooth(
    rotation: np.ndarray, fingers: np.ndarray, variance: np.ndarray, walk: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Smoothed rotations (T, 3, 3) and fingers (T, 45), and variances (T,) of the rotations.

    Args:
        rotation: (T, 3, 3) measured, relative to the carrier.
        fingers: (T, 45) measured.
        variance: (T,) of the measured rotations, square radians.
        walk: (T - 1,) variance of each step, square radians.
    """
    flat, weight = rotation.reshape(-1, 9), 1 / variance
    inverse = 1 / walk
    bands = np.zeros((2, len(rotation)))
    bands[0, 1:] = -inverse
    for number in range(_ROUNDS):
        bands[1] = weight
        bands[1, :-1] += inverse
        bands[1, 1:] += inverse
        mean = solveh_banded(bands, weight[:, None] * np.concatenate([flat, fingers], axis=1))
        u, _, v = np.linalg.svd(mean[:, :9].reshape(-1, 3, 3))
        u[:, :, 2] *= np.linalg.det(u @ v)[:, None]
        smooth = u @ v
        square = _square_angle(smooth, rotation)
        if number < _ROUNDS // 2:  # absolute errors first: they have one minimum
            weight = 1 / np.sqrt(variance * (variance + square))
        else:
            weight = 1 / (variance + square)
    return smooth, mean[:, 9:], _variances(bands[1], bands[0, 1:])


def _square_angle(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Squared angles (T,) between rotations (T, 3, 3)."""
    trace = np.einsum("tij,tij->t", first, second)
    return np.asarray(np.square(np.arccos(np.clip((trace - 1) / 2, -1, 1))))


def _variances(diagonal: np.ndarray, off_diagonal: np.ndarray) -> np.ndarray:
    """Diagonal (T,) of the inverse of a symmetric tridiagonal matrix; ``off_diagonal`` (T - 1,)."""
    forward, backward = diagonal.copy(), diagonal.copy()
    for k, value in enumerate(np.square(off_diagonal)):
        forward[k + 1] -= value / forward[k]
    for k in range(len(off_diagonal) - 1, -1, -1):
        backward[k] -= off_diagonal[k] ** 2 / backward[k + 1]
    return np.asarray(1 / (forward + backward - diagonal))


def _world_rotations(body: np.ndarray) -> np.ndarray:
    """Rotations (T, 22, 3, 3) of pelvis, trunk and limbs in the master frame, of poses (T, 168)."""
    count = BODY_JOINTS.stop
    local = Rotation.from_rotvec(body[:, : 3 * count].reshape(-1, 3)).as_matrix()
    world = local.reshape(-1, count, 3, 3).copy()
    for k in range(1, count):
        world[:, k] = world[:, PARENTS[k]] @ world[:, k]
    return world
