"""Errors of a fitted body against the true body, metres; joints are the 55 of SMPL-X."""

from __future__ import annotations

import numpy as np

from intercap_core.body.joints import BODY_JOINTS, FINGER_JOINTS, JOINT_INDEX
from intercap_core.geometry.solve.robust import MEDIAN_CHI_3


def vertex_error(vertices: np.ndarray, true_vertices: np.ndarray) -> np.ndarray:
    """Per-vertex error (PVE) (...): mean distance of corresponding vertices (..., V, 3)."""
    return np.linalg.norm(vertices - true_vertices, axis=-1).mean(-1)


def joint_error(joints: np.ndarray, true_joints: np.ndarray) -> np.ndarray:
    """MPJPE (...): mean distance of the 22 body joints of (..., 55, 3), without alignment."""
    return joint_errors(joints, true_joints).mean(-1)


def joint_errors(joints: np.ndarray, true_joints: np.ndarray) -> np.ndarray:
    """Distance (..., 22) of each body joint of (..., 55, 3) from the true joint."""
    return np.linalg.norm(joints - true_joints, axis=-1)[..., BODY_JOINTS]


def hand_error(
    joints: np.ndarray,
    tips: np.ndarray,
    true_joints: np.ndarray,
    true_tips: np.ndarray,
    *,
    align_wrists: bool = False,
) -> np.ndarray:
    """Mean distance (..., 2) over the 15 joints and 5 fingertips of the left and the right hand.

    Args:
        joints, true_joints: (..., 55, 3).
        tips, true_tips: (..., 10, 3) thumb to little finger, left hand first.
        align_wrists: first translate the fitted hand so that its wrist is at the true wrist.
    """
    errors = []
    for side, name in enumerate(("left", "right")):
        wrist = JOINT_INDEX[f"{name}_wrist"]
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
    """Points (..., V, 3) of the true surface that correspond to the vertices of the fitted mesh.

    Args:
        true_vertices: (..., Vt, 3).
        true_faces: (Ft, 3).
        face: (V,) face of the true mesh that corresponds to each fitted vertex in rest pose.
        weights: (V, 3) barycentric weights within that face.
    """
    corners = true_faces[face]
    return sum(
        true_vertices[..., corners[:, k], :] * weights[:, k, None].astype(true_vertices.dtype)
        for k in range(3)
    )


def normalised_joint_error(
    joints: np.ndarray, true_joints: np.ndarray, sigma: np.ndarray, which: slice = BODY_JOINTS
) -> np.ndarray:
    """Distance (..., J) of joints from the truth over the distance expected from ``sigma``.

    The expected distance is :data:`MEDIAN_CHI_3` * ``sigma``, so the median of the result is 1 if
    the stated deviations are calibrated.

    Args:
        joints, true_joints: (..., 55, 3).
        sigma: (..., 55) stated standard deviation of each coordinate, metres.
        which: the joints that are evaluated.
    """
    error = np.linalg.norm(joints - true_joints, axis=-1)[..., which]
    return error / (MEDIAN_CHI_3 * np.maximum(sigma[..., which], 1e-9))
