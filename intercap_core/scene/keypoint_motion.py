"""The subject's keypoints of all views against one moving body: residuals and their derivatives.

Detectors err by a constant for each joint and view, and the cameras' poses are still off, so the
median residual of each keypoint in each view is taken off: what is left are changes over time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from intercap_core.body.keypoints import BODY, FACE, LEFT_HAND, RIGHT_HAND
from intercap_core.geometry.camera import projection
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.camera.triangulation import pixel_scale, triangulate
from intercap_core.scene.constants import (
    MIN_CONFIDENCE,
    MOTION_ROUNDS,
    MOTION_SIGMA_FLOOR_PX,
    OUTLIER_SIGMA,
    SLIPPED_PX_AT_1080P,
)
from intercap_core.scene.smooth_paths import Paths, smooth_paths

# Body; of each hand the wrist, knuckles and finger tips; corners of brows, eyes, nose and mouth.
# Points beyond these move with them and cost as much again.
_HAND = np.array([0, 4, 5, 8, 9, 13, 17, 20])
_FACE = np.array([0, 9, 10, 13, 19, 28, 31, 37])
POINTS = np.r_[
    np.arange(BODY.start, BODY.stop),
    LEFT_HAND.start + _HAND,
    RIGHT_HAND.start + _HAND,
    FACE.start + _FACE,
]


@dataclass(frozen=True, eq=False)
class Motion:
    """K keypoints in T sets of C views.

    ``paths`` in the master frame; ``residual`` (T, C, K, 2) px, found less expected, 0 where not
    ``seen``; ``seen`` and ``valid`` (T, C, K) bool: has a residual, and one that is no outlier;
    ``sigma`` (C, K) px, what the residuals scatter by; ``bias`` (C, K, 2) px was taken off.
    """

    rig: Rig
    times: np.ndarray
    paths: Paths
    residual: np.ndarray
    seen: np.ndarray
    valid: np.ndarray
    sigma: np.ndarray
    bias: np.ndarray

    @cached_property
    def by_point(self) -> np.ndarray:
        """d pixel / d point (T, C, K, 2, 3), px/m."""
        return _project(self.paths.points, self.rig)[1]

    @cached_property
    def expected(self) -> np.ndarray:
        """Pixels (T, C, K, 2) of the points."""
        return _project(self.paths.points, self.rig)[0]

    @cached_property
    def speed_px(self) -> np.ndarray:
        """Pixel velocities (T, C, K, 2), px/s, 0 where not known."""
        return np.nan_to_num(np.einsum("tckij,tkj->tcki", self.by_point, self.paths.velocity))

    def at_offsets(self, offset: np.ndarray) -> Motion:
        """The motion as seen by cameras that expose ``offset`` (C,) s late."""
        along = np.where(self.seen[..., None], self.speed_px * offset[:, None, None], 0.0)
        return replace(self, residual=self.residual - along)

    def shifted(self, seconds: float) -> np.ndarray:
        """How far (T, C, K, 2), px, the points would be seen from where they are expected by
        images that are ``seconds`` older; NaN where the path is not known."""
        points = self.paths.at(self.times - seconds)
        return _project(points, self.rig)[0] - self.expected

    @cached_property
    def projector(self) -> np.ndarray:
        """(T, K, 2C, 2C): makes weighted residuals free of where the point is, to first order.

        With A = W^(1/2) J it is (I - A (A'A)^-1 A') W^(1/2), W the inverse variances.
        """
        sets, views, count = self.valid.shape
        root = np.where(self.valid, 1 / self.sigma, 0.0)  # (T, C, K)
        root = np.repeat(np.moveaxis(root, 1, 2), 2, axis=2)  # (T, K, 2C)
        rows = np.moveaxis(self.by_point, 1, 2).reshape(sets, count, 2 * views, 3)
        rows = np.nan_to_num(rows) * root[..., None]
        normal = np.einsum("tkei,tkej->tkij", rows, rows)
        size = np.trace(normal, axis1=2, axis2=3)[..., None, None]
        normal = normal + (1e-9 * size + 1e-12) * np.eye(3)
        onto = np.einsum("tkei,tkij,tkfj->tkef", rows, np.linalg.inv(normal), rows, optimize=True)
        return (np.eye(2 * views) - onto) * root[:, :, None, :]

    def projected(self, values: np.ndarray) -> np.ndarray:
        """Weighted pixel differences (T, K, 2C) of all views' values (T, C, K, 2)."""
        flat = np.moveaxis(np.nan_to_num(values), 1, 2).reshape(*self.projector.shape[:3])
        return np.einsum("tkef,tkf->tke", self.projector, flat)

    def projected_of(self, camera: int, values: np.ndarray) -> np.ndarray:
        """The same of one camera's values (T, K, 2), all others 0."""
        columns = self.projector[..., 2 * camera : 2 * camera + 2]
        return np.einsum("tkef,tkf->tke", columns, np.nan_to_num(values))


def build_motion(
    keypoints: np.ndarray, rig: Rig, times: np.ndarray, start: np.ndarray | None = None
) -> Motion:
    """Fit moving points to ``keypoints`` (T, C, 135, 3) x, y, confidence, 0 = not seen.

    ``start`` (T, K, 3): points of nearly the same keypoints, NaN = not known.
    """
    pixels, seen = _chosen(keypoints)
    scale = pixel_scale(rig)[:, None]
    if start is None:
        points, valid = _triangulated(pixels, seen, rig)
        sigma = np.broadcast_to(4.0 * scale, seen.shape[1:])
        rounds = MOTION_ROUNDS
    else:
        points, valid, rounds = start, seen, MOTION_ROUNDS - 1
    for _ in range(rounds):
        smooth = smooth_paths(times, points).points
        expected, by_point = _project(smooth, rig)
        known = seen & np.isfinite(expected[..., 0])
        raw = np.where(known[..., None], pixels - expected, np.nan)
        bias = _nanmedian(np.where(valid[..., None], raw, np.nan))
        residual = raw - bias
        size = np.linalg.norm(residual, axis=-1)
        sigma = np.maximum(_scatter(size, known), MOTION_SIGMA_FLOOR_PX * scale)
        valid = known & (np.nan_to_num(size, nan=np.inf) < OUTLIER_SIGMA * sigma)
        points = _refitted(smooth, residual, by_point, valid, sigma)
    paths = smooth_paths(times, points)
    return _seeing(pixels, seen, rig, paths, sigma, bias)


def seeing(motion: Motion, keypoints: np.ndarray) -> Motion:
    """Other ``keypoints`` (T, C, 135, 3) of the same motion."""
    pixels, seen = _chosen(keypoints)
    return _seeing(pixels, seen, motion.rig, motion.paths, motion.sigma, motion.bias)


def _seeing(
    pixels: np.ndarray,
    seen: np.ndarray,
    rig: Rig,
    paths: Paths,
    sigma: np.ndarray,
    bias: np.ndarray,
) -> Motion:
    expected, _ = _project(paths.points, rig)
    seen = seen & np.isfinite(expected[..., 0])
    residual = np.where(seen[..., None], pixels - expected - bias, 0.0)
    valid = seen & (np.linalg.norm(residual, axis=-1) < OUTLIER_SIGMA * sigma)
    return Motion(rig, paths.times, paths, residual, seen, valid, sigma, bias)


def _chosen(keypoints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (T, C, K, 2) and whether they are seen (T, C, K), of :data:`POINTS`."""
    chosen = keypoints[:, :, POINTS]
    return chosen[..., :2], chosen[..., 2] >= MIN_CONFIDENCE


def _triangulated(pixels: np.ndarray, seen: np.ndarray, rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Points (T, K, 3) of each set on its own, and who agrees with them (T, C, K)."""
    sets, views, count = seen.shape
    found = triangulate(
        np.swapaxes(pixels, 1, 2).reshape(-1, views, 2),
        np.swapaxes(seen, 1, 2).reshape(-1, views).astype(float),
        rig,
        max_error_px=SLIPPED_PX_AT_1080P,
    )
    inlier = np.swapaxes(found.inlier.reshape(sets, count, views), 1, 2)
    return found.points.reshape(sets, count, 3), inlier


def _project(points: np.ndarray, rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (T, C, K, 2) and their derivatives (T, C, K, 2, 3) by points (T, K, 3)."""
    in_camera = np.moveaxis(apply(rig.colour_from_master, points.reshape(-1, 3)), 0, 1)
    in_camera = np.swapaxes(in_camera.reshape(*points.shape[:2], len(rig), 3), 1, 2)
    pixels, by_camera = projection.project_with_jacobian(in_camera, rig.colour_parameters[:, None])
    by_point = by_camera @ rig.colour_from_master[:, None, :3, :3]
    # A point that is not known must not come out as one at the smallest depth.
    lost = ~np.isfinite(points[..., 0])[:, None]
    return np.where(lost[..., None], np.nan, pixels), by_point


def _refitted(
    points: np.ndarray,
    residual: np.ndarray,
    by_point: np.ndarray,
    valid: np.ndarray,
    sigma: np.ndarray,
) -> np.ndarray:
    """One robust Gauss-Newton step of each point of each set; NaN where two views do not see it."""
    size = np.linalg.norm(np.nan_to_num(residual), axis=-1)
    weight = np.where(valid, 1 / (sigma**2 * (1 + (size / (2 * sigma)) ** 2)), 0.0)
    rows = np.nan_to_num(by_point)
    weighted = rows * weight[..., None, None]
    normal = np.einsum("tckij,tckil->tkjl", weighted, rows)
    slope = np.einsum("tckij,tcki->tkj", weighted, np.nan_to_num(residual))
    size = np.trace(normal, axis1=2, axis2=3)[..., None, None]
    normal = normal + (1e-6 * size + 1e-9) * np.eye(3)
    moved = points + np.linalg.solve(normal, slope[..., None])[..., 0]
    return np.where((valid.sum(1) >= 2)[..., None], moved, np.nan)


def _scatter(size: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Robust standard deviation (C, K) a coordinate of residuals of length ``size`` (T, C, K);
    few samples count little against the view's others."""
    of_point = _nanmedian(np.where(known, size, np.nan)) / 1.177  # of a Rayleigh median
    number = known.sum(0)
    of_view = _nanmedian(np.where(number > 0, of_point, np.nan).T)[:, None]
    of_view = np.where(number.any(1, keepdims=True), of_view, np.inf)
    share = number / (number + 5.0)
    few = np.where(number > 0, of_view, 0.0)
    return np.where(number > 0, share * of_point + (1 - share) * few, of_view)


def _nanmedian(values: np.ndarray) -> np.ndarray:
    """Median over the first axis, 0 where there is none."""
    order = np.sort(values, 0)  # NaN last
    count = np.isfinite(values).sum(0)
    low = np.take_along_axis(order, np.maximum(count - 1, 0)[None] // 2, 0)[0]
    high = np.take_along_axis(order, np.maximum(count, 1)[None] // 2, 0)[0]
    return np.where(count > 0, (low + high) / 2, 0.0)
