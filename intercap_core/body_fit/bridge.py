"""Interpolation of frames without a valid fit.

A bridge is the interpolated run of frames between two frames with a valid fit, the known ones.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.body.parameters import NUM_POSE


def bridge(vectors: np.ndarray, known: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return parameter vectors with the unknown rows interpolated.

    Between two known frames each parameter follows a cubic Hermite curve, whose velocities at both
    ends are estimated from known frames nearby. Rotations are interpolated in the tangent space of
    the first of the two frames, by the shortest way. Before the first and after the last known
    frame the body does not move.

    Args:
        vectors: (T, P) parameter vectors.
        known: (T,) bool; at least one frame is known.
        times: (T,) seconds.
    """
    result = vectors.copy()
    at = np.flatnonzero(known)
    result[: at[0]], result[at[-1] :] = vectors[at[0]], vectors[at[-1]]
    for start, end in pairwise(at.tolist()):
        if end == start + 1:
            continue
        gap = np.arange(start + 1, end)
        before, after = _velocity_frames(start, end, known, times)
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
        # the four knots in the tangent space of the first one: ``start`` is 0, ``end`` is moved
        placed = np.stack([np.zeros_like(moved), moved, -leaving, moved + coming])
        path = np.tensordot(weights, placed, 1)
        first = Rotation.from_matrix(np.tile(poses[0], (len(gap), 1, 1)))
        filled = first * Rotation.from_rotvec(path.reshape(-1, 3))
        result[gap, :NUM_POSE] = filled.as_rotvec().reshape(len(gap), NUM_POSE)
    return result


def _rotation_vectors(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return rotation vectors (J, 3) v with end = start exp(v), of rotations (J, 3, 3)."""
    return np.asarray(Rotation.from_matrix(start.swapaxes(1, 2) @ end).as_rotvec())


def _velocity_frames(start: int, end: int, known: np.ndarray, times: np.ndarray) -> tuple[int, int]:
    """Return the known frames that determine the velocities at ``start`` and ``end``.

    They are the nearest ones before ``start`` and after ``end`` at a distance of 0.045 to 0.15 s;
    ``start`` or ``end`` itself if there is none.
    """
    at = np.flatnonzero(known)

    def nearest(frame: int, seconds: np.ndarray) -> int:
        # velocities from nearer frames are noise of the fit, those from farther ones belong to
        # another motion; tuned on the studio
        near = (seconds >= 0.045) & (seconds <= 0.15)
        return int(at[near][seconds[near].argmin()]) if near.any() else frame

    return nearest(start, times[start] - times[at]), nearest(end, times[at] - times[end])


def _hermite(when: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Return weights (N, 4): values at the times ``when`` (N,) are weights @ values at the knots.

    knots (4,): times of start and end of a bridge, and of the frames of :func:`_velocity_frames`.
    """
    length = knots[1] - knots[0]
    s = ((when - knots[0]) / length)[:, None]
    mean = np.array([-1.0, 1.0, 0.0, 0.0]) / length
    slopes = [mean, mean]
    if knots[2] < knots[0]:
        slopes[0] = np.array([1.0, 0.0, -1.0, 0.0]) / (knots[0] - knots[2])
    if knots[3] > knots[1]:
        slopes[1] = np.array([0.0, -1.0, 0.0, 1.0]) / (knots[3] - knots[1])
    # Weight of the velocities at the ends against the mean velocity of the bridge. 0.7 to 1 is best
    # on gaps of 1 to 15 frames at 15 Hz (measured on the studio). Bridges longer than 1 s were not
    # measured; their weight decreases.
    weight = 0.85 * min(1.0, 1.0 / length)
    first, last = (mean + weight * (slope - mean) for slope in slopes)
    # cubic Hermite basis: values at both ends, then their slopes times the length
    rise = s**2 * (3 - 2 * s)
    ends = np.concatenate([1 - rise, rise, np.zeros_like(s), np.zeros_like(s)], 1)
    bends = s * (1 - s) ** 2 * first - s**2 * (1 - s) * last
    return np.asarray(ends + length * bends)


def unwrap_turns(rotation_vectors: np.ndarray) -> np.ndarray:
    """Return rotation vectors (T, 3) of the same rotations, continuous over frames.

    v and v - 2 pi v / |v| are the same rotation. The one nearer to the vector of the previous frame
    is returned. Both have the same length at 180 degrees, where fitted vectors jump. This is the
    orientation of an upright person in a master frame whose y points down.
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
    """Return the standard deviation (T, J) of joints after bridging, metres.

    The error of a bridged frame is measured on the known frames: all trial bridges with the same
    knots relative to the frame are compared with the fits. If less than five are possible (tuned),
    the error is the usual speed of the joint times the time to the nearest known frame. The larger
    deviation of the two ends is added in quadrature.

    Args:
        joints: (T, J, 3) metres.
        known: (T,) bool.
        sigma: (T, J) standard deviation in the known frames, metres.
        times: (T,) seconds.
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
            before, after = _velocity_frames(int(ends[0]), int(ends[1]), known, times)
            knots = np.array([*ends, before, after])
            weights = _hermite(times[[t]], times[knots])
        steps = knots - t
        tried = np.arange(max(0, -steps.min()), len(known) - max(0, steps.max()))
        tried = tried[known[tried] & np.all([known[tried + step] for step in steps], axis=0)]
        if len(tried) < 5:
            off = np.minimum(speed * seconds[t], 0.5)  # an arm's length
        else:
            built = np.tensordot(weights[0], [joints[tried + step] for step in steps], 1)
            off = np.sqrt(((joints[tried] - built) ** 2).mean((0, 2)))
        result[t] = np.hypot(off, sigma[ends].max(0))
    return result


def _speed(joints: np.ndarray, known: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return the usual speed (J,) along one coordinate, m/s, between adjacent known frames."""
    pairs = np.flatnonzero(known[1:] & known[:-1])
    if len(pairs) < 5:  # as few as for trial bridges
        return np.full(joints.shape[1], 1.0)  # speed of a walk
    moved = (joints[pairs + 1] - joints[pairs]) / np.diff(times)[pairs, None, None]
    # at least 0.1 m/s: a standing person sways
    return np.maximum(np.sqrt((moved**2).mean((0, 2))), 0.1)
