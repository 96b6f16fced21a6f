"""Compiled loops of :mod:`.segmented`: extent of points in an image, and unprojection."""

from __future__ import annotations

import numba
import numpy as np

from intercap_core.geometry.camera.projection import MIN_DEPTH_M
from intercap_core.geometry.camera.projection_kernels import project_point

_MILLIMETRE = np.float32(1e-3)


@numba.njit(cache=True, nogil=True)
def extent(points, pose, lens):
    """Minimum and maximum (2,3) of column, row and depth (metres) of the points in the image.

    The minimum is infinite if no point is in the image. All arrays are float64.

    Args:
        points: (M,3).
        pose: (4,4) camera_from_points.
        lens: (13,) lens parameters.
    """
    found = np.empty((2, 3))
    found[0], found[1] = np.inf, -np.inf
    limit = lens[12]
    place = np.empty(3)
    for point in points:
        for k in range(3):
            place[k] = pose[k, 3]
            for m in range(3):
                place[k] += pose[k, m] * point[m]
        x, y, z = place
        if not (z > MIN_DEPTH_M and x * x + y * y <= (limit * z) ** 2):
            continue
        u, v = project_point(x, y, z, lens)
        for k, value in enumerate((u, v, z)):
            found[0, k], found[1, k] = min(found[0, k], value), max(found[1, k], value)
    return found


@numba.njit(cache=True, nogil=True)
def placed(depth, index, rays, low, high, nearest, farthest, pose, bias):
    """Points (N,3) float32 of the pixels within a window and a range of depths.

    Args:
        depth: (H,W) uint16, millimetres.
        index: (M,) flat pixel indices.
        rays: (H,W,2) ray directions; pixels without a finite ray are skipped.
        low, high: first column and row, and column and row after the last.
        nearest, farthest: range of depths, exclusive, millimetres.
        pose: (4,4) float32, points_from_camera.
        bias: metres, subtracted from the depth along the ray.
    """
    width = depth.shape[1]
    points = np.empty((len(index), 3), np.float32)
    count = 0
    for flat in index:
        row, column = flat // width, flat % width
        if not (low[0] <= column < high[0] and low[1] <= row < high[1]):
            continue
        measured = depth[row, column]
        if not nearest < measured < farthest:
            continue
        across, down = rays[row, column]
        if not np.isfinite(across):
            continue
        z = np.float32(measured) * _MILLIMETRE
        z *= np.float32(1) - bias / z
        x, y = across * z, down * z
        for k in range(3):
            points[count, k] = pose[k, 0] * x + pose[k, 1] * y + pose[k, 2] * z + pose[k, 3]
        count += 1
    return points[:count].copy()
