"""Points of the skin as the object sees them: what is held does not slide, what stands stays.

    q = R^T (x - t)

A point x of the skin that sticks to the object is a constant q of its frame. Beyond the paper,
whose contact pulls along the surface's normal alone.
"""

from __future__ import annotations

import numpy as np


def local_points(points: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Points (T, N, 3) of the master frame in an object's, ``rotation`` (T, 3, 3) and
    ``translation`` (T, 3) master_from_object."""
    return (points - translation[:, None]) @ rotation


def local_by_object(
    points: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> np.ndarray:
    """Derivative (T, N, 3, 6) of :func:`local_points` by a turn (left) and a shift of the object.

    q' = R^T exp(-w) (x - t - d), so that dq/dw = R^T [x - t]_x and dq/dd = -R^T.
    """
    arm = points - translation[:, None]
    axes = rotation.transpose(0, 2, 1)[:, None]  # rows: the object's axes in the master frame
    # row a of R^T [v]_x is a x v
    by_turn = np.cross(axes, arm[:, :, None])
    return np.concatenate([by_turn, np.broadcast_to(-axes, by_turn.shape)], axis=3)


def robust(rate: np.ndarray, weight: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Geman-McClure weights (T, N) and energies (T,) of rates (T, N, 3) that have ``weight``
    (T, N): what slides faster than ``scale`` truly slides."""
    square = np.square(rate).sum(2)
    share = scale**2 / (scale**2 + square)
    return weight * share**2, 0.5 * (weight * square * share).sum(axis=1)
