"""Frames without a believable fit are filled in between their neighbours."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.body.parameters import NUM_POSE
from intercap_core.body_fit.constants import (
    FEWEST_BRIDGES,
    LARGEST_BRIDGED_SIGMA_M,
    STANDING_SPEED,
    VELOCITY_WEIGHT,
    VELOCITY_WEIGHT_UNTIL_S,
    VELOCITY_WINDOW_S,
    WALKING_SPEED,
)


def bridge(vectors: np.ndarray, known: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Fill rows of parameter vectors (T,P) that are not ``known`` (T,), by time (T,), seconds.

    Between known neighbours everything goes on a cubic curve with the velocities that it has at its
    ends (Hermite), rotations in the tangent space of the first neighbour, the shortest way; before
    the first and after the last known frame the body stands still. At least one frame is known.
    """
    result = vectors.copy()
    at = np.flatnonzero(known)
    result[: at[0]], result[at[-1] :] = vectors[at[0]], vectors[at[-1]]
    for start, end in pairwise(at.tolist()):
        if end == start + 1:
            continue
        gap = np.arange(start + 1, end)
        before, after = _beyond(start, end, known, times)
        knots = [start, end, before, after]
        weights = _hermite(times[gap], times[knots])
        rest = slice(NUM_POSE, vectors.shape[1])
        result[gap, rest] = weights @ vectors[knots, rest]
        turns = Rotation.from_rotvec(vectors[knots][:, :NUM_POSE].reshape(-1, 3))
        poses = turns.as_matrix().reshape(4, -1, 3, 3)
        moved = _rotation_vectors(poses[0], poses[1])
        leaving, coming = (
            _rotation_vectors(poses[2], poses[0]),
            _rotation_vectors(poses[1], poses[3]),
        )
        # in the tangent space of the first neighbour, where it is at 0
        placed = np.stack([np.zeros_like(moved), moved, -leaving, moved + coming])
        path = np.tensordot(weights, placed, 1)
        first = Rotation.from_matrix(np.tile(poses[0], (len(gap), 1, 1)))
        filled = first * Rotation.from_rotvec(path.reshape(-1, 3))
        result[gap, :NUM_POSE] = filled.as_rotvec().reshape(len(gap), NUM_POSE)
    return result


def _rotation_vectors(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """(J,3) of the turns from rotations (J,3,3) to others, in the frames of the first."""
    return np.asarray(Rotation.from_matrix(start.swapaxes(1, 2) @ end).as_rotvec())


def _beyond(start: int, end: int, known: np.ndarray, times: np.ndarray) -> tuple[int, int]:
    """Known frames before ``start`` and after ``end`` that tell the velocities there; these frames
    themselves where there is none near."""
    at = np.flatnonzero(known)
    earlier, later = times[start] - times[at], times[at] - times[end]
    found = []
    for frame, seconds in ((start, earlier), (end, later)):
        near = (seconds >= VELOCITY_WINDOW_S[0]) & (seconds <= VELOCITY_WINDOW_S[1])
        found.append(int(at[near][seconds[near].argmin()]) if near.any() else frame)
    return found[0], found[1]


def _hermite(when: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Weights (N,4) at times ``when`` (N,) of values at ``knots`` (4,): start, end of a bridge, and
    the frames that tell its velocities, which are the start, the end where nothing does."""
    length = knots[1] - knots[0]
    s = ((when - knots[0]) / length)[:, None]
    mean = np.array([-1.0, 1.0, 0.0, 0.0]) / length
    slopes = [mean, mean]
    if knots[2] < knots[0]:
        slopes[0] = np.array([1.0, 0.0, -1.0, 0.0]) / (knots[0] - knots[2])
    if knots[3] > knots[1]:
        slopes[1] = np.array([0.0, -1.0, 0.0, 1.0]) / (knots[3] - knots[1])
    believed = VELOCITY_WEIGHT * min(1.0, VELOCITY_WEIGHT_UNTIL_S / length)
    first, last = (mean + believed * (slope - mean) for slope in slopes)
    rise = s**2 * (3 - 2 * s)
    ends = np.concatenate([1 - rise, rise, np.zeros_like(s), np.zeros_like(s)], 1)
    bends = s * (1 - s) ** 2 * first - s**2 * (1 - s) * last
    return np.asarray(ends + length * bends)


def continuous(rotation_vectors: np.ndarray) -> np.ndarray:
    """Rotation vectors (T,3) of the same turns without jumps of a full turn between frames.

    Each is v or v - 2 pi v / |v|, whichever is nearer to the one before; an upright person seen by
    a camera whose y is down is always about half a turn from rest, where the two meet.
    """
    result = rotation_vectors.copy()
    for t in range(1, len(result)):
        angle = np.linalg.norm(result[t])
        if angle < 1e-9:
            continue
        other = result[t] * (1 - 2 * np.pi / angle)
        if np.linalg.norm(other - result[t - 1]) < np.linalg.norm(result[t] - result[t - 1]):
            result[t] = other
    return result


def bridged_sigma(
    joints: np.ndarray, known: np.ndarray, sigma: np.ndarray, times: np.ndarray
) -> np.ndarray:
    """Stated deviation (T,J), metres, of joints (T,J,3) whose unknown frames were bridged.

    ``sigma`` (T,J) is that of the known frames (T,); ``times`` (T,) seconds. The known frames say
    how far off such a bridge is: it is built over all their stretches of the same length. Where
    there are too few of those, a joint is off by what it moves, at the speed it has elsewhere, in
    the time to the nearest known frame.
    """
    result = sigma.copy()
    at = np.flatnonzero(known)
    seconds = np.abs(times[:, None] - times[at][None]).min(1)
    speed = _speed(joints, known, times)
    for t in np.flatnonzero(~known):
        ends = np.concatenate([at[at < t][-1:], at[at > t][:1]])
        knots = ends
        weights = np.ones((1, 1))
        if len(ends) == 2:
            before, after = _beyond(int(ends[0]), int(ends[1]), known, times)
            knots = np.array([*ends, before, after])
            weights = _hermite(times[[t]], times[knots])
        steps = knots - t
        tried = np.arange(max(0, -steps.min()), len(known) - max(0, steps.max()))
        tried = tried[known[tried] & np.all([known[tried + step] for step in steps], axis=0)]
        if len(tried) < FEWEST_BRIDGES:
            off = np.minimum(speed * seconds[t], LARGEST_BRIDGED_SIGMA_M)
        else:
            built = np.tensordot(weights[0], [joints[tried + step] for step in steps], 1)
            off = np.sqrt(((joints[tried] - built) ** 2).mean((0, 2)))
        result[t] = np.hypot(off, sigma[ends].max(0))
    return result


def _speed(joints: np.ndarray, known: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Usual speed (J,) along one coordinate, m/s, between neighbouring known frames."""
    pairs = np.flatnonzero(known[1:] & known[:-1])
    if len(pairs) < FEWEST_BRIDGES:
        return np.full(joints.shape[1], WALKING_SPEED)
    moved = (joints[pairs + 1] - joints[pairs]) / np.diff(times)[pairs, None, None]
    return np.maximum(np.sqrt((moved**2).mean((0, 2))), STANDING_SPEED)
