"""One floor under all cameras, as a constraint on their poses.

Cameras that share no piece of it still stand over the same plane: it holds their height and their
tilt. The plane is unknown and eliminated (Schur complement).
"""

from __future__ import annotations

import numpy as np

from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.solve.robust import geman_mcclure_weight
from intercap_core.scene.constants import (
    FLOOR_COSINE,
    FLOOR_EFFECTIVE_POINTS,
    FLOOR_SIGMA_M,
    MAX_FLOOR_POINTS,
    MIN_FLOOR_POINTS,
    NEAR_FLOOR_M,
    ROBUST_SIGMA,
)
from intercap_core.scene.ground import Ground
from intercap_core.scene.surface import Surface


class FloorConstraint:
    """Adds the normal equations of one common floor; ``points`` by camera, its depth frame."""

    def __init__(self, rig: Rig, points: dict[int, np.ndarray], up: np.ndarray) -> None:
        self._rig = rig
        self._points = points
        self._up = up

    @property
    def cameras(self) -> frozenset[int]:
        """Those that see the floor."""
        return frozenset(self._points)

    @classmethod
    def of(cls, rig: Rig, surfaces: dict[int, Surface], ground: Ground) -> FloorConstraint | None:
        """The floor points near ``ground`` at the rig's poses; None where fewer than two cameras
        see it."""
        if not ground.found:
            return None
        points = {}
        for c, surface in surfaces.items():
            pose = rig[c].master_from_depth
            height = (apply(pose, surface.points) - ground.point) @ ground.normal
            facing = surface.normals @ pose[:3, :3].T @ ground.normal
            rows = np.flatnonzero((np.abs(height) < NEAR_FLOOR_M) & (facing > FLOOR_COSINE))
            if len(rows) >= MIN_FLOOR_POINTS:
                rows = np.random.default_rng(0).permutation(rows)[:MAX_FLOOR_POINTS]
                points[c] = surface.points[rows]
        return cls(rig, points, ground.normal) if len(points) >= 2 else None

    def __call__(self, poses: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Matrix (C, 6, C, 6) and gradient (C, 6) at ``poses`` (C, 4, 4); ``offset`` has no say.

        Raises ValueError for poses of another rig.
        """
        if len(poses) != len(self._rig):
            raise ValueError(f"{len(poses)} poses for {len(self._rig)} cameras")
        count = len(self._rig)
        own = {c: self._in_master(c, poses[c]) for c in self._points}
        everything = np.concatenate(list(own.values()))
        middle = everything.mean(0)
        axes = np.linalg.svd(everything - middle, full_matrices=False)[2]
        normal = axes[2] * np.sign(axes[2] @ self._up)
        matrix = np.zeros((count * 6, count * 6))
        gradient = np.zeros(count * 6)
        by_plane = np.zeros((3, 3))
        cross = np.zeros((3, count * 6))
        slope = np.zeros(3)
        for c, points in own.items():
            residual = (points - middle) @ normal
            robust = geman_mcclure_weight(residual**2, ROBUST_SIGMA * FLOOR_SIGMA_M)
            weight = robust * min(1.0, FLOOR_EFFECTIVE_POINTS / len(points)) / FLOOR_SIGMA_M**2
            arm = points - poses[c, :3, 3]
            by_pose = np.column_stack(
                [np.cross(arm, normal), np.broadcast_to(normal, points.shape)]
            )
            plane = np.column_stack(
                [(points - middle) @ axes[0], (points - middle) @ axes[1], -np.ones(len(points))]
            )
            at = slice(6 * c, 6 * c + 6)
            weighted = by_pose * weight[:, None]
            matrix[at, at] += weighted.T @ by_pose
            gradient[at] += weighted.T @ residual
            cross[:, at] += plane.T @ weighted
            by_plane += plane.T @ (plane * weight[:, None])
            slope += plane.T @ (weight * residual)
        solved = np.linalg.solve(by_plane, np.column_stack([cross, slope]))
        matrix -= cross.T @ solved[:, :-1]
        gradient -= cross.T @ solved[:, -1]
        return matrix.reshape(count, 6, count, 6), gradient.reshape(count, 6)

    def _in_master(self, camera: int, pose: np.ndarray) -> np.ndarray:
        between = self._rig[camera].colour_from_depth
        assert between is not None
        return apply(pose @ between, self._points[camera])
