"""Errors of a fitted body against the true one: arrays in, numbers out, metres."""

from __future__ import annotations

import numpy as np

from intercap_core.body.keypoints import CONTOUR, FACE, KeypointMap

BODY_JOINTS = slice(0, 22)
WRISTS = (20, 21)
FOOT_JOINTS = (7, 8, 10, 11)  # ankles and balls
FINGER_JOINTS = (slice(25, 40), slice(40, 55))  # left, right
BOTH_HANDS = slice(25, 55)
# A three-dimensional normal error is longer than this many standard deviations half of the time
# (the median of the chi distribution with three degrees of freedom).
MEDIAN_CHI_3 = 1.5382


def vertex_error(vertices: np.ndarray, true_vertices: np.ndarray) -> np.ndarray:
    """PVE (...): mean distance of corresponding vertices (..., V, 3)."""
    return np.linalg.norm(vertices - true_vertices, axis=-1).mean(-1)


def visible_vertex_error(
    vertices: np.ndarray,
    true_vertices: np.ndarray,
    visible: np.ndarray,
) -> np.ndarray:
    """The same (...) over the vertices that cameras truly see (..., V) bool; NaN where none is."""
    error = np.linalg.norm(vertices - true_vertices, axis=-1)
    count = visible.sum(-1)
    mean = (error * visible).sum(-1) / np.maximum(count, 1)
    return np.where(count > 0, mean, np.nan)


def joint_error(joints: np.ndarray, true_joints: np.ndarray) -> np.ndarray:
    """MPJPE (...): mean distance of the 22 body joints of (..., 55, 3), nothing aligned."""
    return joint_errors(joints, true_joints).mean(-1)


def joint_errors(joints: np.ndarray, true_joints: np.ndarray) -> np.ndarray:
    """Distance (..., 22) of each of these joints."""
    return np.linalg.norm(joints - true_joints, axis=-1)[..., BODY_JOINTS]


def landmarks(vertices: np.ndarray, keypoints: KeypointMap) -> np.ndarray:
    """Face landmarks (..., 68, 3) on the skin of (..., V, 3): 51 inner ones, then the jaw line."""
    ids, weights = (
        np.concatenate([of[FACE], of[CONTOUR]]) for of in (keypoints.ids, keypoints.weights)
    )
    return (vertices[..., ids, :] * weights[..., None]).sum(-2)


def landmark_error(found: np.ndarray, true: np.ndarray, *, align: bool = False) -> np.ndarray:
    """Mean distance (...) of corresponding points (..., N, 3).

    ``align`` first moves and turns the found ones as a whole onto the true ones (Kabsch 1976): what
    is left is the face's form and expression, without the place and turn of the head.
    """
    if align:
        middle = true.mean(-2, keepdims=True)
        centred = found - found.mean(-2, keepdims=True)
        u, _, vt = np.linalg.svd(np.swapaxes(true - middle, -1, -2) @ centred)
        flip = np.ones(u.shape[:-1])
        flip[..., 2] = np.sign(np.linalg.det(u @ vt))
        rotation = (u * flip[..., None, :]) @ vt
        found = centred @ np.swapaxes(rotation, -1, -2) + middle
    return np.linalg.norm(found - true, axis=-1).mean(-1)


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
    true_vertices: np.ndarray,
    true_faces: np.ndarray,
    face: np.ndarray,
    weights: np.ndarray,
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
    joints: np.ndarray,
    true_joints: np.ndarray,
    sigma: np.ndarray,
    which: slice = BODY_JOINTS,
) -> np.ndarray:
    """Distance of some joints (..., 22) over the stated deviation: median 1 if calibrated.

    ``sigma`` (..., 55) is the standard deviation of each coordinate, metres. ``which`` of the 55
    joints; the body's where nothing is said.
    """
    error = np.linalg.norm(joints - true_joints, axis=-1)[..., which]
    return error / (MEDIAN_CHI_3 * np.maximum(sigma[..., which], 1e-9))
