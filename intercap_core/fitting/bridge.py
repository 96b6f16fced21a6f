"""Frames without a believable fit are filled in between their neighbours."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from intercap_core.body.parameters import NUM_POSE


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


def seconds_to_known(known: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Time (T,) from each frame to the nearest known one, seconds."""
    return np.abs(times[:, None] - times[known][None]).min(1)
