"""Body keypoints of several views as constraints on the camera poses.

A bundle adjustment whose points are eliminated (Schur complement), so that the cameras' system
stays small however many points there are.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

import numpy as np

from intercap_core.body.keypoints import NUM_KEYPOINTS
from intercap_core.geometry.camera import projection
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import invert
from intercap_core.geometry.solve.robust import geman_mcclure_weight
from intercap_core.person.sides import BODY_POINTS
from intercap_core.scene.constants import (
    KEYPOINT_ERROR_TIME_S,
    KEYPOINT_SIGMA_FLOOR_PX,
    MIN_BODY_VIEWS,
    POINT_STEPS,
    ROBUST_SIGMA,
)
from intercap_core.scene.subject_views import SubjectViews


@dataclass(frozen=True, eq=False)
class BodyViews:
    """The subject as all views see it: ``pixels`` (N, C, 2) and ``weights`` (N, C) of N points,
    ``points`` (N, 3) triangulated at the start, and ``velocity`` (N, 3) m/s, 0 where unknown.
    ``unit`` (N,): points of one joint within the time that a detector's error lasts share one."""

    pixels: np.ndarray
    weights: np.ndarray
    points: np.ndarray
    velocity: np.ndarray
    unit: np.ndarray

    def subset(self, rows: np.ndarray) -> BodyViews:
        """The points chosen."""
        return BodyViews(
            self.pixels[rows],
            self.weights[rows],
            self.points[rows],
            self.velocity[rows],
            self.unit[rows],
        )

    def halves(self) -> tuple[BodyViews, BodyViews]:
        """The points of every second span of time, and the others."""
        odd = self.unit // NUM_KEYPOINTS % 2 == 1
        return self.subset(~odd), self.subset(odd)


def body_views(subject: SubjectViews, times: np.ndarray) -> BodyViews:
    """The body's keypoints that enough views agree on, at ``times`` (T,) seconds."""
    views = subject.keypoints.shape[1]
    by_point = np.swapaxes(subject.keypoints[:, :, BODY_POINTS], 1, 2).reshape(-1, views, 3)
    inlier = np.swapaxes(subject.inlier[:, :, BODY_POINTS], 1, 2).reshape(-1, views)
    points = subject.joints[:, BODY_POINTS].reshape(-1, 3)
    enough = min(MIN_BODY_VIEWS, views)
    good = (subject.views[:, BODY_POINTS].ravel() >= enough) & np.isfinite(points[:, 0])
    gap = float(np.median(np.diff(times))) if len(times) > 1 else KEYPOINT_ERROR_TIME_S
    weights = by_point[..., 2] * inlier * min(1.0, gap / KEYPOINT_ERROR_TIME_S)
    velocity = np.nan_to_num(velocities(subject.joints[:, BODY_POINTS], times)).reshape(-1, 3)
    joint = np.arange(NUM_KEYPOINTS)[BODY_POINTS]
    span = np.floor(times / KEYPOINT_ERROR_TIME_S).astype(np.int64)
    unit = (NUM_KEYPOINTS * span[:, None] + joint).ravel()
    return BodyViews(by_point[good, :, :2], weights[good], points[good], velocity[good], unit[good])


def velocities(points: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Central differences (T, K, 3), m/s, of points (T, K, 3) at ``times`` (T,); NaN at both ends
    and beside what is not known."""
    result = np.full(points.shape, np.nan)
    if len(times) > 2:
        result[1:-1] = (points[2:] - points[:-2]) / (times[2:] - times[:-2])[:, None, None]
    return result


class BodyConstraint:
    """Adds the normal equations of reprojection to a rig's poses."""

    def __init__(self, views: BodyViews, rig: Rig) -> None:
        self._views = views
        self._lenses = rig.colour_parameters
        self._points = views.points.copy()

    def __call__(self, poses: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Matrix (C, 6, C, 6) and gradient (C, 6) at ``poses`` (C, 4, 4) of cameras that expose
        ``offset`` (C,) s after the set's time: rotation about the camera's centre, applied on the
        left, and translation of ``master_from_colour``."""
        for _ in range(POINT_STEPS):
            residual, by_point, weight, _ = self._linearised(poses, offset)
            normal, slope = _normal_of_points(residual, by_point, weight)
            self._points -= np.linalg.solve(normal, slope[..., None])[..., 0]
        residual, by_point, weight, by_pose = self._linearised(poses, offset)
        normal, slope = _normal_of_points(residual, by_point, weight)
        count, views = weight.shape
        weighted = by_pose * weight[..., None, None]
        matrix = np.zeros((views, 6, views, 6))
        own = np.einsum("ncij,ncik->cjk", weighted, by_pose)
        matrix[np.arange(views), :, np.arange(views)] = own
        gradient = np.einsum("ncij,nci->cj", weighted, residual)
        cross = np.einsum("ncij,ncik->njck", by_point, weighted).reshape(count, 3, -1)
        solved = np.linalg.solve(normal, cross)
        matrix -= np.einsum("njk,njl->kl", cross, solved).reshape(matrix.shape)
        gradient -= np.einsum("njk,nj->k", solved, slope).reshape(gradient.shape)
        return matrix, gradient

    def unit_errors(
        self, poses: np.ndarray, offset: np.ndarray, camera: int
    ) -> dict[Hashable, float]:
        """By unit of the points that ``camera`` sees, after they have settled: the mean
        reprojection error in all views, px."""
        self(poses, offset)
        residual, _, _, _ = self._linearised(poses, offset)
        known = self._views.weights > 0
        error = np.where(known, np.linalg.norm(residual, axis=-1), 0.0).sum(1)
        error /= np.maximum(known.sum(1), 1)
        result: dict[Hashable, float] = {}
        for unit in np.unique(self._views.unit[known[:, camera]]):
            own = error[known[:, camera] & (self._views.unit == unit)]
            result[int(unit)] = float(own.mean())
        return result

    def median_error(self, poses: np.ndarray, offset: np.ndarray) -> float:
        """Median reprojection error, px, after the points have settled."""
        self(poses, offset)
        residual, _, weight, _ = self._linearised(poses, offset)
        return float(np.median(np.linalg.norm(residual, axis=-1)[weight > 0]))

    def _linearised(
        self, poses: np.ndarray, offset: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Residual (N, C, 2), its derivatives by the point (N, C, 2, 3) and by the camera's motion
        (N, C, 2, 6), and weights (N, C)."""
        colour_from_master = invert(poses)
        velocity = self._views.velocity[:, None]
        seen = self._points[:, None] + offset[:, None] * velocity  # (N, C, 3), where it then was
        in_camera = np.einsum("cij,ncj->nci", colour_from_master[:, :3, :3], seen)
        in_camera += colour_from_master[:, :3, 3]
        pixels, by_camera = projection.project_with_jacobian(in_camera, self._lenses)
        by_point = by_camera @ colour_from_master[:, :3, :3]
        arm = seen - poses[:, :3, 3]
        # x_c = R' (X - t): turning R by w changes x_c by R' [X - t]x w, moving t by v by -R' v.
        by_pose = np.concatenate([by_point @ _cross_matrix(arm), -by_point], -1)
        residual = pixels - self._views.pixels
        size = np.linalg.norm(residual, axis=-1)
        known = self._views.weights > 0
        sigma = max(
            KEYPOINT_SIGMA_FLOOR_PX, float(np.median(size[known])) / 1.177
        )  # of a Rayleigh median
        robust = geman_mcclure_weight(size**2, ROBUST_SIGMA * sigma)
        return residual, by_point, self._views.weights * robust / sigma**2, by_pose


def _normal_of_points(
    residual: np.ndarray, by_point: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    weighted = by_point * weight[..., None, None]
    normal = np.einsum("ncij,ncik->njk", weighted, by_point)
    damping = 1e-6 * np.trace(normal, axis1=1, axis2=2) + 1e-9
    normal += damping[:, None, None] * np.eye(3)
    return normal, np.einsum("ncij,nci->nj", weighted, residual)


def _cross_matrix(vectors: np.ndarray) -> np.ndarray:
    """[v]x (..., 3, 3) of vectors (..., 3)."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    rows = [np.stack(r, -1) for r in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return np.stack(rows, -2)
