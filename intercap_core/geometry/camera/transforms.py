"""Rigid transforms ``a_from_b``: (..., 4, 4) arrays with x_a = R x_b + t, metres."""

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
    """Tell whether one (4, 4) array is finite, proper and orthonormal within ``tolerance``."""
    if transform.shape != (4, 4) or not np.all(np.isfinite(transform)):
        return False
    rotation = transform[:3, :3]
    return bool(
        np.abs(rotation @ rotation.T - np.eye(3)).max() < tolerance
        and np.linalg.det(rotation) > 0
        and np.abs(transform[3] - (0, 0, 0, 1)).max() < tolerance
    )
