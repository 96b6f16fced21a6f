"""Frames without a believable fit are filled in between their neighbours."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from intercap_core.body.parameters import NUM_POSE

_FEWEST_BRIDGES = 5  # built where the truth is known, to tell how far off one is
_WALKING, _STANDING = 1.0, 0.1  # m/s: where nothing is known of the speed; people sway
_LARGEST_SIGMA = 0.5  # m, an arm's length


def bridge(vectors: np.ndarray, known: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Fill rows of parameter vectors (T,P) that are not ``known`` (T,), by time (T,), seconds.

    Rotations go the shortest way between the known neighbours (slerp, joint by joint), all else
    linearly; before the first and after the last known frame the body stands still. At least one
    frame is known.
    """
    result = vectors.copy()
    at, gaps = times[known], np.flatnonzero(~known)
    if not len(gaps):
        return result
    when = np.clip(times[gaps], at[0], at[-1])
    for column in range(NUM_POSE, vectors.shape[1]):
        result[gaps, column] = np.interp(when, at, vectors[known, column])
    for joint in range(NUM_POSE // 3):
        columns = slice(3 * joint, 3 * joint + 3)
        turns = Rotation.from_rotvec(vectors[known, columns])
        between = Slerp(at, turns)(when) if len(at) > 1 else turns[np.zeros(len(gaps), int)]
        result[gaps, columns] = between.as_rotvec()
    return result


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
    away = np.abs(times[:, None] - times[at][None]).min(1)
    speed = _speed(joints, known, times)
    for t in np.flatnonzero(~known):
        ends = np.concatenate([at[at < t][-1:], at[at > t][:1]])
        steps = ends - t
        tried = np.arange(max(0, -steps.min()), len(known) - max(0, steps.max()))
        tried = tried[known[tried] & np.all([known[tried + step] for step in steps], axis=0)]
        if len(tried) < _FEWEST_BRIDGES:
            off = np.minimum(speed * away[t], _LARGEST_SIGMA)
        else:
            share = (t - ends[0]) / (ends[1] - ends[0]) if len(ends) == 2 else 0.0
            built = (1 - share) * joints[tried + steps[0]] + share * joints[tried + steps[-1]]
            off = np.sqrt(((joints[tried] - built) ** 2).mean((0, 2)))
        result[t] = np.hypot(off, sigma[ends].max(0))
    return result


def _speed(joints: np.ndarray, known: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Usual speed (J,) along one coordinate, m/s, between neighbouring known frames."""
    pairs = np.flatnonzero(known[1:] & known[:-1])
    if len(pairs) < _FEWEST_BRIDGES:
        return np.full(joints.shape[1], _WALKING)
    moved = (joints[pairs + 1] - joints[pairs]) / np.diff(times)[pairs, None, None]
    return np.maximum(np.sqrt((moved**2).mean((0, 2))), _STANDING)
