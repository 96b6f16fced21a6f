"""Triangulation of points from pixels of several views with outliers.

Every pair of views proposes the midpoint between its two rays. The proposal with the least
truncated reprojection cost over all views is chosen. It is then refined by four Gauss-Newton steps
on the distorted pixels of the inlier views. All points are processed at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from intercap_core.geometry.camera import projection
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply

# Two rays with a smaller angle between them give no depth: its error would be more than 14 times
# (1 / sin 4 degrees) that across the rays.
MIN_PARALLAX_DEG = 4.0


@dataclass(frozen=True)
class Triangulation:
    """Triangulated points and their reprojection errors."""

    points: np.ndarray
    """(N, 3) metres, master frame; NaN if fewer than two views agree."""
    inlier: np.ndarray
    """(N, C) bool: views that agree with the point."""
    error: np.ndarray
    """(N,) RMS reprojection error of the inliers, px; NaN without a point."""
    view_error: np.ndarray
    """(N, C) px; NaN if not seen or without a point."""

    @property
    def views(self) -> np.ndarray:
        """(N,) int8: views that agree."""
        return self.inlier.sum(1).astype(np.int8)


def spread(triangulation: Triangulation, rig: Rig) -> np.ndarray:
    """Return the standard error (N,) of each point along one coordinate, metres; 0 = no point.

    n views determine 3 coordinates by 2n values. With an RMS reprojection error of e pixels, the
    variance of a value is n e^2 / (2n - 3). About 2n / 3 values determine each coordinate, so its
    variance is 1.5 e^2 / (2n - 3) square pixels.
    """
    eyes = rig.master_from_colour[:, :3, 3]
    away = np.linalg.norm(triangulation.points[:, None] - eyes, axis=2)
    metres = away / np.array([camera.colour.fx for camera in rig])  # size of a pixel at the point
    views = np.maximum(triangulation.inlier.sum(1), 2)
    pixel = np.where(triangulation.inlier, metres, 0.0).sum(1) / views
    return np.nan_to_num(triangulation.error * pixel * np.sqrt(1.5 / (2 * views - 3)))


def pixel_scale(rig: Rig) -> np.ndarray:
    """Return the number (C,) of pixels of each camera per pixel of a 1080p image, by height."""
    return np.array([camera.colour.height / 1080 for camera in rig])


def rays_of(pixels: np.ndarray, rig: Rig) -> np.ndarray:
    """Return ray directions (..., C, n, 3) float64, master frame, of pixels (..., C, n, 2).

    A direction has z = 1 in the camera's frame; it is not a unit vector.
    """
    rays = np.empty((*pixels.shape[:-1], 3))
    whole = [slice(None)]
    for at in whole if pixels.ndim == 3 else _blocks(len(pixels), pixels[:1].size // 2):
        for c, camera in enumerate(rig):
            directions = camera.colour.unproject(pixels[at][..., c, :, :])
            rays[at][..., c, :, :] = directions @ camera.master_from_colour[:3, :3].T
    return rays


def _blocks(count: int, size: int = 1) -> list[slice]:
    """Divide rows of ``size`` pixels into blocks, whose intermediate results take 50 MB."""
    together = max(1, 160_000 // max(size, 1))
    return [slice(start, start + together) for start in range(0, count, together)]


def midpoints(
    first: np.ndarray, second: np.ndarray, from_first: np.ndarray, from_second: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the midpoints (..., 3) and lengths (...) of the shortest lines between rays, metres.

    ``first``, ``second`` (..., 3) are directions, ``from_first``, ``from_second`` their origins.
    NaN if the rays are nearly parallel (:data:`MIN_PARALLAX_DEG`) or closest behind an origin.
    """
    between = from_second - from_first
    aa, bb = (first * first).sum(-1), (second * second).sum(-1)
    ab = (first * second).sum(-1)
    a_between, b_between = (first * between).sum(-1), (second * between).sum(-1)
    determinant = aa * bb - ab * ab
    apart = determinant > aa * bb * np.sin(np.radians(MIN_PARALLAX_DEG)) ** 2
    safe = np.where(apart, determinant, 1.0)
    s = (bb * a_between - ab * b_between) / safe
    t = (ab * a_between - aa * b_between) / safe
    good = apart & (s > 0) & (t > 0)
    on_first = from_first + s[..., None] * first
    on_second = from_second + t[..., None] * second
    point = np.where(good[..., None], (on_first + on_second) / 2, np.nan)
    gap = np.where(good, np.linalg.norm(on_first - on_second, axis=-1), np.nan)
    return point, gap


def view_pairs(rig: Rig) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Return pairs of cameras (a, b), a < b: those to try first, and the rest.

    The first list pairs each camera with the five cameras whose viewing directions differ most
    nearly by 70 degrees from its own. Up to six cameras these are all pairs. For more cameras their
    number grows linearly, not quadratically.
    """
    axes = rig.master_from_colour[:, :3, 2]
    angle = np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1)))
    first = {
        (min(a, int(b)), max(a, int(b)))
        for a, row in enumerate(np.abs(angle - 70.0))
        for b in np.argsort(np.where(np.arange(len(rig)) == a, np.inf, row), kind="stable")[
            : min(5, len(rig) - 1)
        ]
    }
    every = list(combinations(range(len(rig)), 2))
    return [p for p in every if p in first], [p for p in every if p not in first]


def reproject(points: np.ndarray, rig: Rig) -> np.ndarray:
    """Return the pixels (N, C, 2) of points (N, 3), master frame, in every view."""
    pixels = np.empty((len(points), len(rig), 2))
    for at in _blocks(len(points), len(rig)):
        seen = np.moveaxis(apply(rig.colour_from_master, points[at]), 0, 1)
        pixels[at] = projection.project(seen, rig.colour_parameters)
    return pixels


def triangulate(
    pixels: np.ndarray, weights: np.ndarray, rig: Rig, *, max_error_px: float
) -> Triangulation:
    """Triangulate N points from C views.

    Args:
        pixels: (N, C, 2) distorted pixels.
        weights: (N, C) confidence, 0 = not seen.
        rig: the cameras.
        max_error_px: reprojection error beyond which a view is an outlier, pixels of a 1080p image.
    """
    count, views = weights.shape
    result = Triangulation(
        points=np.full((count, 3), np.nan),
        inlier=np.zeros((count, views), bool),
        error=np.full(count, np.nan),
        view_error=np.full((count, views), np.nan),
    )
    wanted = np.flatnonzero((weights > 0).sum(1) >= 2)
    size = 20_000  # points at once: bounds memory at some 100 MB with six views
    for start in range(0, len(wanted), size):
        block = wanted[start : start + size]
        _triangulate_block(result, block, pixels[block], weights[block], rig, max_error_px)
    return result


def _triangulate_block(
    result: Triangulation,
    rows: np.ndarray,
    pixels: np.ndarray,
    weights: np.ndarray,
    rig: Rig,
    max_error_px: float,
) -> None:
    """Triangulate n points and write them to the rows (n,) of the result.

    pixels (n, C, 2), weights (n, C): see :func:`triangulate`.
    """
    limit = max_error_px * pixel_scale(rig)
    points = _best_proposal(pixels, weights, rig, limit)
    error = _errors(points, pixels, weights, rig)
    for _ in range(4):
        inlier = error < limit
        points = _refined(points, pixels, weights * inlier, rig)
        error = _errors(points, pixels, weights, rig)
    inlier = error < limit
    good = inlier.sum(1) >= 2
    inlier &= good[:, None]
    points[~good] = np.nan
    mean_square = np.where(inlier, error**2, 0).sum(1) / np.maximum(inlier.sum(1), 1)
    result.points[rows] = points
    result.inlier[rows] = inlier
    result.error[rows] = np.where(good, np.sqrt(mean_square), np.nan)
    result.view_error[rows] = np.where(good[:, None] & (weights > 0), error, np.nan)


def _errors(points: np.ndarray, pixels: np.ndarray, weights: np.ndarray, rig: Rig) -> np.ndarray:
    """Return reprojection errors (N, C), px; infinite if not seen, behind a camera, no point."""
    finite = np.isfinite(points).all(1)
    in_camera = np.moveaxis(
        apply(rig.colour_from_master, np.where(finite[:, None], points, 0)), 0, 1
    )
    error = np.linalg.norm(projection.project(in_camera, rig.colour_parameters) - pixels, axis=-1)
    return np.where((weights > 0) & (in_camera[..., 2] > 0) & finite[:, None], error, np.inf)


def _best_proposal(
    pixels: np.ndarray, weights: np.ndarray, rig: Rig, limit: np.ndarray
) -> np.ndarray:
    """Return the pair's midpoint (N, 3) with the least truncated cost over all views; NaN = none.

    limit (C,): error at which the cost of a view is truncated, px. Pairs of the second list of
    :func:`view_pairs` are tried only for points without a proposal.
    """
    rays = rays_of(np.swapaxes(pixels, 0, 1), rig)  # (C, N, 3)
    centres = rig.master_from_colour[:, :3, 3]
    best = np.full((len(pixels), 3), np.nan)
    best_cost = np.full(len(pixels), np.inf)
    for pairs in view_pairs(rig):
        rest = np.isinf(best_cost)
        for a, b in pairs:
            rows = np.flatnonzero(rest & (weights[:, a] > 0) & (weights[:, b] > 0))
            if not len(rows):
                continue
            proposal, _ = midpoints(rays[a, rows], rays[b, rows], centres[a], centres[b])
            error = _errors(proposal, pixels[rows], weights[rows], rig)
            cost = (weights[rows] * np.minimum(error / limit, 1.0) ** 2).sum(1)
            cost += _agreed_by_chance(rays[a, rows], rays[b, rows])
            better = np.isfinite(proposal[:, 0]) & (cost < best_cost[rows])
            best[rows[better]], best_cost[rows[better]] = proposal[better], cost[better]
    return best


def _agreed_by_chance(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return an additional cost (N,) of proposals by nearly parallel rays (N, 3).

    For pixels near the line between two cameras that face each other, the two rays meet at some
    point even if the pixels show different points. The cost decreases from 2, that of two outlier
    views of full confidence, to 0 at an angle of 25 degrees between the lines of the rays. Six
    views alternately high and low hardly ever have such pairs.
    """
    sine = np.linalg.norm(np.cross(first, second), axis=1)
    sine /= np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    return 2.0 * np.maximum(0, 1 - sine / np.sin(np.radians(25.0)))


def _refined(points: np.ndarray, pixels: np.ndarray, weights: np.ndarray, rig: Rig) -> np.ndarray:
    """Return points (N, 3) after one Gauss-Newton step of each point's Huber reprojection cost."""
    rows = np.flatnonzero(np.isfinite(points[:, 0]) & ((weights > 0).sum(1) >= 2))
    if not len(rows):
        return points
    rotation = rig.colour_from_master[:, :3, :3]
    in_camera = np.moveaxis(apply(rig.colour_from_master, points[rows]), 0, 1)
    projected, by_camera = projection.project_with_jacobian(in_camera, rig.colour_parameters)
    jacobian = by_camera @ rotation  # (n, C, 2, 3)
    residual = projected - pixels[rows]
    # typical standard deviation of good 2D detectors: 4 px of a 1080p image
    huber = 4.0 * pixel_scale(rig)
    size = np.linalg.norm(residual, axis=-1)
    weight = weights[rows] * np.minimum(1.0, huber / np.maximum(size, 1e-9)) / pixel_scale(rig) ** 2
    weighted = jacobian * weight[..., None, None]
    normal = np.einsum("ncij,ncik->njk", weighted, jacobian)
    gradient = np.einsum("ncij,nci->nj", weighted, residual)
    # A little damping limits the step for two nearly parallel rays.
    damping = 1e-6 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    step = np.linalg.solve(normal + damping + 1e-12 * np.eye(3), gradient[..., None])[..., 0]
    result = points.copy()
    result[rows] -= step
    return result
