"""Errors of a fitted body against the true one: arrays in, numbers out, metres."""

from __future__ import annotations

import numpy as np

BODY_JOINTS = slice(0, 22)
WRISTS = (20, 21)
FINGER_JOINTS = (slice(25, 40), slice(40, 55))  # left, right
# A three-dimensional normal error is longer than this many standard deviations half of the time
# (the median of the chi distribution with three degrees of freedom).
MEDIAN_CHI_3 = 1.5382


def vertex_error(vertices: np.ndarray, true_vertices: np.ndarray) -> np.ndarray:
    """PVE (...): mean distance of corresponding vertices (..., V, 3)."""
    return np.linalg.norm(vertices - true_vertices, axis=-1).mean(-1)


def joint_error(joints: np.ndarray, true_joints: np.ndarray) -> np.ndarray:
    """MPJPE (...): mean distance of the 22 body joints of (..., 55, 3), nothing aligned."""
    body = joints[..., BODY_JOINTS, :] - true_joints[..., BODY_JOINTS, :]
    return np.linalg.norm(body, axis=-1).mean(-1)


def hand_error(
    joints: np.ndarray,
    tips: np.ndarray,
    true_joints: np.ndarray,
    true_tips: np.ndarray,
    *,
    align_wrists: bool = False,
) -> np.ndarray:
    """Mean distance (..., 2) over each hand's 15 joints and 5 tips, left then right.

    ``joints`` (..., 55, 3), ``tips`` (..., 10, 3) thumb to little finger, left then right.
    ``align_wrists`` first moves (not turns) the fitted hand's wrist onto the true one.
    """
    errors = []
    for side, wrist in enumerate(WRISTS):
        at = slice(5 * side, 5 * side + 5)
        fitted = np.concatenate([joints[..., FINGER_JOINTS[side], :], tips[..., at, :]], -2)
        true = np.concatenate([true_joints[..., FINGER_JOINTS[side], :], true_tips[..., at, :]], -2)
        if align_wrists:
            fitted = fitted - (joints - true_joints)[..., wrist, None, :]
        errors.append(np.linalg.norm(fitted - true, axis=-1).mean(-1))
    return np.stack(errors, -1)


def corresponding_vertices(
    true_vertices: np.ndarray, true_faces: np.ndarray, face: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """The true surface's points (..., V, 3) that correspond to a fitted mesh's vertices.

    ``true_vertices`` (..., Vt, 3), ``true_faces`` (Ft, 3); ``face`` (V,) and barycentric
    ``weights`` (V, 3) say which point of the true mesh each vertex is, in rest pose.
    """
    corners = true_faces[face]
    return sum(
        true_vertices[..., corners[:, k], :] * weights[:, k, None].astype(true_vertices.dtype)
        for k in range(3)
    )


def normalised_joint_error(
    joints: np.ndarray, true_joints: np.ndarray, sigma: np.ndarray
) -> np.ndarray:
    """Distance of the 22 body joints (..., 22) over the stated deviation: median 1 if honest.

    ``sigma`` (..., 55) is the standard deviation of each coordinate, metres.
    """
    error = np.linalg.norm(joints - true_joints, axis=-1)[..., BODY_JOINTS]
    return error / (MEDIAN_CHI_3 * np.maximum(sigma[..., BODY_JOINTS], 1e-9))
