"""Turns of a symmetrical object that leave all images as they are."""

from __future__ import annotations

import numpy as np

from intercap_core.geometry.rigid.mesh import ObjectMesh


def free_turns(mesh: ObjectMesh, pose: np.ndarray) -> np.ndarray:
    """Steps (N, 6) of a pose (4, 4) that no image shows: turns about the symmetry's axis, or any of
    a sphere's."""
    symmetry = mesh.symmetry
    if symmetry.sphere:
        axes, offset = np.eye(3), np.zeros(3)
    elif symmetry.axis is not None and symmetry.offset is not None:
        axes, offset = symmetry.axis[None], symmetry.offset
    else:
        return np.zeros((0, 6))
    turn = axes @ pose[:3, :3].T
    return np.concatenate([turn, -np.cross(turn, pose[:3, :3] @ offset)], axis=1)


def without_turns(
    information: np.ndarray, gradient: np.ndarray, steps: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """``information`` (..., 6, 6) and ``gradient`` (..., 6) without what they say of ``steps``
    (N, 6): the facets of a round mesh seem to tell its spin."""
    for step in steps:
        row = information @ step
        size = np.maximum(row @ step, 1e-9)
        seen = (row @ step > 1e-9) / size
        gradient = gradient - row * (seen * (gradient @ step))[..., None]
        information = information - row[..., :, None] * row[..., None, :] * seen[..., None, None]
    return information, gradient
