"""Keypoints of all views compared with one moving body: smooth 3D paths, residuals, Jacobians.

A detector has a constant error for each joint and view, and the camera poses are not yet refined.
The median residual of each keypoint in each view is therefore subtracted, so residuals contain only
changes over time.

Axes: T sets, C views, K keypoints (:data:`POINTS`, a subset of the 135).
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
from intercap_core.geometry.solve.robust import OUTLIER_SIGMAS
from intercap_core.scene.smooth_paths import SmoothPaths, smooth_paths

MIN_CONFIDENCE = 0.3  # keypoints of lower confidence are ignored; tuned on the studio


# Indices of the K compared keypoints. The other keypoints move with these, so they would add little
# information and double the run time.
POINTS = np.r_[
    BODY,
    # of each hand: wrist, knuckles and finger tips
    np.add.outer([LEFT_HAND.start, RIGHT_HAND.start], [0, 4, 5, 8, 9, 13, 17, 20]).ravel(),
    # of the face: corners of brows, eyes, nose and mouth
    np.add(FACE.start, [0, 9, 10, 13, 19, 28, 31, 37]),
]


@dataclass(frozen=True, eq=False)
class KeypointMotion:
    """Paths and residuals of K keypoints in T sets of C views."""

    rig: Rig
    """Cameras."""
    times: np.ndarray
    """(T,) seconds."""
    paths: SmoothPaths
    """Paths of the K points, master frame."""
    residual: np.ndarray
    """(T, C, K, 2) detected minus expected pixel minus ``bias``; 0 = not ``seen``."""
    seen: np.ndarray
    """(T, C, K) bool: the keypoint is detected and its path is known."""
    valid: np.ndarray
    """(T, C, K) bool: ``seen`` and no outlier."""
    sigma: np.ndarray
    """(C, K) standard deviation of the residuals per coordinate, px."""
    bias: np.ndarray
    """(C, K, 2) median of detected minus expected pixel, px."""

    @cached_property
    def by_point(self) -> np.ndarray:
        """Derivatives (T, C, K, 2, 3) of the pixels by the point, px/m."""
        return _project(self.paths.points, self.rig)[1]

    @cached_property
    def expected(self) -> np.ndarray:
        """Pixels (T, C, K, 2) of the points."""
        return _pixels_of(self.paths.points, self.rig)

    @cached_property
    def speed_px(self) -> np.ndarray:
        """Pixel velocities (T, C, K, 2), px/s; 0 = unknown."""
        return np.nan_to_num(np.einsum("tckij,tkj->tcki", self.by_point, self.paths.velocity))

    def window(self, part: slice) -> KeypointMotion:
        """The motion in some sets, with the bias and scatter of all sets."""
        paths = self.paths
        paths = SmoothPaths(paths.times[part], paths.points[part], paths.velocity[part])
        return replace(
            self,
            times=self.times[part],
            paths=paths,
            residual=self.residual[part],
            seen=self.seen[part],
            valid=self.valid[part],
        )

    def at_offsets(self, offset: np.ndarray) -> KeypointMotion:
        """The same motion, with the effect of known time offsets removed from the residuals.

        ``offset``: (C,) seconds by which each camera exposes late.
        """
        return replace(self, residual=self.residual - self._displaced(offset))

    def _displaced(self, offset: np.ndarray) -> np.ndarray:
        """Displacement (T, C, K, 2) of seen keypoints by time offsets (C,), px."""
        return np.where(self.seen[..., None], self.speed_px * offset[:, None, None], 0.0)

    def without_offsets(self, keypoints: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Keypoints (T, C, 135, 3) with the effect of known time offsets removed from the compared
        ones.

        ``offset``: (C,) seconds by which each camera exposes late.
        """
        moved = keypoints.copy()
        moved[:, :, POINTS, :2] -= self._displaced(offset)
        return moved

    def shifted(self, seconds: float) -> np.ndarray:
        """Displacement (T, C, K, 2), px, of the points in images that are ``seconds`` older than
        their sets. NaN = the path is unknown there."""
        points = self.paths.at(self.times - seconds)
        return _pixels_of(points, self.rig) - self.expected

    @cached_property
    def projector(self) -> np.ndarray:
        """(T, K, 2C, 2C) projector that removes the point's position from weighted residuals.

        It takes 60 kB per set of six cameras: use it in windows.

        Rows and columns are x and y of each view. With A = W^(1/2) J it is
        (I - A (A'A)^-1 A') W^(1/2), with the inverse variances W and J = :attr:`by_point`.
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

    @cached_property
    def projected_residual(self) -> np.ndarray:
        """(T, K, 2C) :attr:`projector` times the residuals of all views."""
        flat = np.moveaxis(np.nan_to_num(self.residual), 1, 2).reshape(*self.projector.shape[:3])
        return np.einsum("tkef,tkf->tke", self.projector, flat)

    def projected_of(self, camera: int, values: np.ndarray) -> np.ndarray:
        """Apply :attr:`projector` to differences (T, K, 2) of one camera, 0 in the others."""
        columns = self.projector[..., 2 * camera : 2 * camera + 2]
        return np.einsum("tkef,tkf->tke", columns, np.nan_to_num(values))


def build_motion(
    keypoints: np.ndarray, rig: Rig, times: np.ndarray, start: np.ndarray | None = None
) -> KeypointMotion:
    """Fit moving points to keypoints.

    Alternates two or three times: smooth the paths, estimate bias and scatter of the residuals,
    reject outliers, and move each point by one Gauss-Newton step.

    Args:
        keypoints: (T, C, 135, 3) x, y, confidence; 0 = not seen.
        times: (T,) seconds.
        start: (T, K, 3) points of nearly the same keypoints, NaN = unknown; None = triangulate.
    """
    pixels, seen = _chosen(keypoints)
    sets, views, count = seen.shape
    scale = pixel_scale(rig)[:, None]
    if start is None:
        triangulation = triangulate(
            np.swapaxes(pixels, 1, 2).reshape(-1, views, 2),
            np.swapaxes(seen, 1, 2).reshape(-1, views).astype(float),
            rig,
            # at 1080p; so large because a moving limb is displaced in a view that is frames late
            max_error_px=60.0,
        )
        points = triangulation.points.reshape(sets, count, 3)
        valid = np.swapaxes(triangulation.inlier.reshape(sets, count, views), 1, 2)
        sigma = np.broadcast_to(4.0 * scale, seen.shape[1:])  # initial value, px
        rounds = 3
    else:
        points, valid, rounds = start, seen, 2
    for _ in range(rounds):
        smooth = smooth_paths(times, points).points
        expected, by_point = _project(smooth, rig)
        known = seen & np.isfinite(expected[..., 0])
        raw = np.where(known[..., None], pixels - expected, np.nan)
        bias = known_median(np.where(valid[..., None], raw, np.nan))
        residual = raw - bias
        size = np.linalg.norm(residual, axis=-1)
        sigma = np.maximum(_scatter(size, known), scale)  # a pixel at 1080p at least; tuned
        valid = known & (np.nan_to_num(size, nan=np.inf) < OUTLIER_SIGMAS * sigma)
        points = _refitted(smooth, residual, by_point, valid, sigma)
    return motion_along(smooth_paths(times, points), keypoints, rig, sigma, bias)


def motion_along(
    paths: SmoothPaths, keypoints: np.ndarray, rig: Rig, sigma: np.ndarray, bias: np.ndarray
) -> KeypointMotion:
    """Residuals of ``keypoints`` (T, C, 135, 3) against known paths, scatter and bias."""
    pixels, seen = _chosen(keypoints)
    expected = _pixels_of(paths.points, rig)
    seen = seen & np.isfinite(expected[..., 0])
    residual = np.where(seen[..., None], pixels - expected - bias, 0.0)
    valid = seen & (np.linalg.norm(residual, axis=-1) < OUTLIER_SIGMAS * sigma)
    return KeypointMotion(rig, paths.times, paths, residual, seen, valid, sigma, bias)


def _chosen(keypoints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (T, C, K, 2) and visibility (T, C, K) of :data:`POINTS`."""
    chosen = keypoints[:, :, POINTS]
    return chosen[..., :2], chosen[..., 2] >= MIN_CONFIDENCE


def _project(points: np.ndarray, rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (T, C, K, 2) and their derivatives (T, C, K, 2, 3) by points (T, K, 3)."""
    sets, count = points.shape[:2]
    pixels = np.empty((sets, len(rig), count, 2))
    by_point = np.empty((sets, len(rig), count, 2, 3))
    together = 1000  # sets, limited by memory: intermediate results of a set take 100 kB
    for start in range(0, sets, together):
        at = slice(start, start + together)
        pixels[at], by_camera = projection.project_with_jacobian(
            _in_cameras(points[at], rig), rig.colour_parameters[:, None]
        )
        by_point[at] = by_camera @ rig.colour_from_master[:, None, :3, :3]
    return _where_known(points, pixels), by_point


def _pixels_of(points: np.ndarray, rig: Rig) -> np.ndarray:
    """Pixels (T, C, K, 2) of points (T, K, 3)."""
    pixels = projection.project(_in_cameras(points, rig), rig.colour_parameters[:, None])
    return _where_known(points, pixels)


def _in_cameras(points: np.ndarray, rig: Rig) -> np.ndarray:
    """Points (T, K, 3) in the frame of each colour camera, (T, C, K, 3)."""
    in_camera = np.moveaxis(apply(rig.colour_from_master, points.reshape(-1, 3)), 0, 1)
    return np.swapaxes(in_camera.reshape(*points.shape[:2], len(rig), 3), 1, 2)


def _where_known(points: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """``pixels`` with NaN for unknown points, which projection places at the smallest depth."""
    return np.where(~np.isfinite(points[..., 0])[:, None, :, None], np.nan, pixels)


def _refitted(
    points: np.ndarray,
    residual: np.ndarray,
    by_point: np.ndarray,
    valid: np.ndarray,
    sigma: np.ndarray,
) -> np.ndarray:
    """One robust Gauss-Newton step of each point; NaN if fewer than two views see it."""
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
    """Robust standard deviation (C, K) per coordinate of residuals of length ``size`` (T, C, K).

    The value of a keypoint with n samples is averaged with the median of its view, with weights n
    and 5.
    """
    of_point = known_median(np.where(known, size, np.nan)) / 1.177  # of a Rayleigh median
    number = known.sum(0)
    of_view = known_median(np.where(number > 0, of_point, np.nan).T)[:, None]
    of_view = np.where(number.any(1, keepdims=True), of_view, np.inf)
    share = number / (number + 5.0)
    few = np.where(number > 0, of_view, 0.0)
    return np.where(number > 0, share * of_point + (1 - share) * few, of_view)


def known_median(values: np.ndarray) -> np.ndarray:
    """Median of the finite values over the first axis; 0 if there are none."""
    order = np.sort(values, 0)  # NaN last
    count = np.isfinite(values).sum(0)
    low = np.take_along_axis(order, np.maximum(count - 1, 0)[None] // 2, 0)[0]
    high = np.take_along_axis(order, np.maximum(count, 1)[None] // 2, 0)[0]
    return np.where(count > 0, (low + high) / 2, 0.0)
