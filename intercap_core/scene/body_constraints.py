"""Body keypoints of several views as constraints on the camera poses.

A bundle adjustment whose points are eliminated (Schur complement), so that the cameras' system
stays small however many points there are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.camera import projection
from intercap_core.camera.rig import Rig
from intercap_core.camera.transforms import apply, invert
from intercap_core.detection.read import Detections
from intercap_core.detection.sides import BODY_POINTS
from intercap_core.detection.subject import NOBODY, find_subject
from intercap_core.detection.swaps import triangulate_people

LOOSE_PX_AT_1080P = 40.0  # poses that are a centimetre off are not yet consistent
MIN_VIEWS = 3  # two views say nothing about their own relative pose along most motions
SIGMA_FLOOR_PX = 3.0
# A detector's error at one joint lasts about this long; sets closer together count as one.
ERROR_TIME_S = 0.5
POINT_STEPS = 2


@dataclass(frozen=True, eq=False)
class BodyViews:
    """The subject as all views see it: ``pixels`` (N, C, 2) and ``weights`` (N, C) of N points,
    and ``points`` (N, 3) triangulated at the start."""

    pixels: np.ndarray
    weights: np.ndarray
    points: np.ndarray


def body_views(
    detections: Detections, rig: Rig, times: np.ndarray, *, min_confidence: float
) -> BodyViews:
    """Find the subject at the start's poses; see :class:`BodyViews`."""
    index = find_subject(detections, rig, times, min_confidence=min_confidence)
    sets, views = index.shape
    keypoints = np.zeros((sets, views, 135, 3))
    for t, c in np.argwhere(index != NOBODY):
        keypoints[t, c, BODY_POINTS] = detections.people(t, c)[index[t, c], BODY_POINTS]
    keypoints, found = triangulate_people(
        keypoints, rig, min_confidence=min_confidence, max_error_px=LOOSE_PX_AT_1080P
    )
    by_point = np.swapaxes(keypoints, 1, 2).reshape(-1, views, 3)
    weights = by_point[..., 2] * found.inlier
    good = (found.views >= MIN_VIEWS) & np.isfinite(found.points[:, 0])
    gap = float(np.median(np.diff(times))) if sets > 1 else ERROR_TIME_S
    weights = weights * min(1.0, gap / ERROR_TIME_S)
    return BodyViews(by_point[good, :, :2], weights[good], found.points[good])


class BodyConstraint:
    """Adds the normal equations of reprojection to a rig's poses."""

    def __init__(self, views: BodyViews, rig: Rig) -> None:
        self._views = views
        self._lenses = rig.colour_parameters
        self._points = views.points.copy()

    def __call__(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Matrix (6C, 6C) and gradient (6C,) at ``poses`` (C, 4, 4): rotation about the camera's
        centre, applied on the left, then translation of ``master_from_colour``."""
        for _ in range(POINT_STEPS):
            residual, by_point, weight, _ = self._linearised(poses)
            normal, slope = _normal_of_points(residual, by_point, weight)
            self._points -= np.linalg.solve(normal, slope[..., None])[..., 0]
        residual, by_point, weight, by_pose = self._linearised(poses)
        normal, slope = _normal_of_points(residual, by_point, weight)
        count, views = weight.shape
        weighted = by_pose * weight[..., None, None]
        matrix = np.zeros((views, 6, views, 6))
        own = np.einsum("ncij,ncik->cjk", weighted, by_pose)
        matrix[np.arange(views), :, np.arange(views)] = own
        gradient = np.einsum("ncij,nci->cj", weighted, residual).ravel()
        cross = np.einsum("ncij,ncik->njck", by_point, weighted).reshape(count, 3, views * 6)
        solved = np.linalg.solve(normal, cross)
        flat = matrix.reshape(views * 6, views * 6)
        flat = flat - np.einsum("njk,njl->kl", cross, solved)
        return flat, gradient - np.einsum("njk,nj->k", solved, slope)

    def median_error(self, poses: np.ndarray) -> float:
        """Median reprojection error at ``poses``, px, after the points have settled."""
        self(poses)
        residual, _, weight, _ = self._linearised(poses)
        return float(np.median(np.linalg.norm(residual, axis=-1)[weight > 0]))

    def _linearised(
        self, poses: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Residual (N, C, 2), its derivatives by the point (N, C, 2, 3) and by the camera's motion
        (N, C, 2, 6), and weights (N, C)."""
        colour_from_master = invert(poses)
        in_camera = np.moveaxis(apply(colour_from_master, self._points), 0, 1)
        pixels, by_camera = projection.project_with_jacobian(in_camera, self._lenses)
        by_point = by_camera @ colour_from_master[:, :3, :3]
        arm = self._points[:, None] - poses[:, :3, 3]
        # x_c = R' (X - t): turning R by w changes x_c by R' [X - t]x w, moving t by v by -R' v.
        by_pose = np.concatenate([by_point @ _cross_matrix(arm), -by_point], -1)
        residual = pixels - self._views.pixels
        seen = self._views.weights > 0
        size = np.linalg.norm(residual, axis=-1)
        sigma = max(SIGMA_FLOOR_PX, float(np.median(size[seen])) / 1.177)  # of a Rayleigh median
        robust = 1 / (1 + (size / (3 * sigma)) ** 2) ** 2  # Geman-McClure
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
