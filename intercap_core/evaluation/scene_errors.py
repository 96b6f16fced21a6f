"""Displacement of cameras by the errors of their poses."""

from __future__ import annotations

import numpy as np

from intercap_core.geometry.camera.transforms import invert

# Side of the cube over which displacements are averaged (docs/evaluation.md).
CUBE_SIDE_M = 2.0


def rig_centre(master_from_camera: np.ndarray) -> np.ndarray:
    """The point (3,) nearest to all optical axes of cameras (C, 4, 4), least squares.

    A small ridge towards the mean camera position regularises parallel axes.
    """
    position = master_from_camera[:, :3, 3]
    axis = master_from_camera[:, :3, 2]
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    ridge = 1e-6 * np.eye(3)
    right = np.einsum("cij,cj->i", across, position) + ridge @ position.mean(0)
    return np.linalg.solve(across.sum(0) + ridge, right)


def displacement(
    master_from_camera: np.ndarray, true_master_from_camera: np.ndarray, master: int
) -> np.ndarray:
    """RMS displacement (C,) of the points of a 2 m cube at the rig's true centre, metres.

    Both rigs (C, 4, 4) are first expressed in the frame of their ``master`` camera. For each
    camera, a point x moves by A x + b, if the estimated instead of the true pose is used. The mean
    of |A x + b|^2 over the cube is |A centre + b|^2 + side^2 / 12 |A|^2, with the Frobenius norm
    |A|.
    """
    estimated = invert(master_from_camera[master]) @ master_from_camera
    true = invert(true_master_from_camera[master]) @ true_master_from_camera
    moved = estimated @ invert(true)
    linear = moved[:, :3, :3] - np.eye(3)
    at_centre = linear @ rig_centre(true) + moved[:, :3, 3]
    spread = CUBE_SIDE_M**2 / 12 * (linear**2).sum((1, 2))
    return np.sqrt((at_centre**2).sum(1) + spread)
