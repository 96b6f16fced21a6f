"""Rigid transforms ``a_from_b``: arrays (..., 4, 4) with x_a = R x_b + t, metres.

The solvers update a transform by a step of six numbers in frame a: a rotation vector w (rad), which
turns the object about its own origin, and a shift d (m) of that origin::

    R <- exp(w) R,    t <- t + d

This is the exponential map of SO(3) x R^3, not that of SE(3): the rotation does not carry the
origin along a helix. The derivatives of the energy terms belong to this update.

SciPy's rotations are imported where they are used: every job imports this module, and many read
no rotation vector.
"""

from __future__ import annotations

import numpy as np


def invert(a_from_b: np.ndarray) -> np.ndarray:
    """Return ``b_from_a`` (..., 4, 4) of rigid transforms (..., 4, 4)."""
    rotation_t = np.swapaxes(a_from_b[..., :3, :3], -1, -2)
    result = np.zeros_like(a_from_b)
    result[..., :3, :3] = rotation_t
    result[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation_t, a_from_b[..., :3, 3])
    result[..., 3, 3] = 1
    return result


def apply(a_from_b: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Map points (..., N, 3) of b to a; keeps the points' float type."""
    rotation = a_from_b[..., :3, :3].astype(points.dtype)
    translation = a_from_b[..., None, :3, 3].astype(points.dtype)
    return points @ np.swapaxes(rotation, -1, -2) + translation


def rigid(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Build transforms (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3)."""
    result = np.zeros((*rotation.shape[:-2], 4, 4))
    result[..., :3, :3] = rotation
    result[..., :3, 3] = translation
    result[..., 3, 3] = 1
    return result


def is_rigid(transform: np.ndarray, tolerance: float = 1e-4) -> bool:
    """Return whether one (4, 4) array is finite, proper and orthonormal within ``tolerance``."""
    if transform.shape != (4, 4) or not np.all(np.isfinite(transform)):
        return False
    rotation = transform[:3, :3]
    return bool(
        np.abs(rotation @ rotation.T - np.eye(3)).max() < tolerance
        and np.linalg.det(rotation) > 0
        and np.abs(transform[3] - (0, 0, 0, 1)).max() < tolerance
    )


def apply_step(a_from_b: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return transforms (..., 4, 4) updated by steps (..., 6): rotation vector, then shift."""
    turn = rotation_exp(step[..., :3])
    return rigid(turn @ a_from_b[..., :3, :3], a_from_b[..., :3, 3] + step[..., 3:])


def step_between(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return steps (..., 6) that lead from ``start`` to ``end`` (..., 4, 4): the inverse of
    :func:`apply_step`, with rotations of at most pi."""
    turn = rotation_log(end[..., :3, :3] @ np.swapaxes(start[..., :3, :3], -1, -2))
    return np.concatenate([turn, end[..., :3, 3] - start[..., :3, 3]], axis=-1)


def rotation_exp(vector: np.ndarray) -> np.ndarray:
    """Return rotation matrices (..., 3, 3) of rotation vectors (..., 3), rad."""
    from scipy.spatial.transform import Rotation

    flat = Rotation.from_rotvec(vector.reshape(-1, 3)).as_matrix()
    return flat.reshape(*vector.shape[:-1], 3, 3)


def rotation_log(rotation: np.ndarray) -> np.ndarray:
    """Return rotation vectors (..., 3), rad, of length at most pi, of matrices (..., 3, 3)."""
    from scipy.spatial.transform import Rotation

    flat = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_rotvec()
    return flat.reshape(*rotation.shape[:-2], 3)
