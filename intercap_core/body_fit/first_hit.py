"""Where rays first meet a mesh, compiled: for some thousand rays at once, without a tree.

Triangles are looked at in groups that lie close together; a group is skipped where the ray misses
its bounding sphere or has hit something nearer. Moeller and Trumbore 1997, double precision.
"""

from __future__ import annotations

import numba
import numpy as np

_GROUP = 48  # triangles
# Bits of each coordinate along the curve, and those within a cube: 1/32 of the mesh's size.
_BITS, _CUBE_BITS = 9, 4
# Triangles reach this much of their size beyond their edges, so that no ray slips between two.
_BEYOND = 1e-9


def first_hits(
    points: np.ndarray, faces: np.ndarray, origins: np.ndarray, directions: np.ndarray
) -> np.ndarray:
    """How far (N,) along unit ``directions`` (N,3) from ``origins`` (N,3) rays meet triangles.

    Mesh of points (V,3) and faces (F,3), met from either side; infinite where there is nothing.
    """
    corners = points[faces].astype(np.float64)
    order, starts = _grouped(corners.mean(1))
    return _first_hits(corners[order], starts, origins.astype(float), directions.astype(float))


def _grouped(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Order (N,) of points (N,3) along Morton's curve, and where in it groups start, and the last
    ends: where the curve enters another cube, and after so many points."""
    low, size = points.min(0), np.ptp(points, axis=0).max()
    cell = ((points - low) / max(size, 1e-9) * (2**_BITS - 1)).astype(np.int64)
    place = np.zeros(len(points), np.int64)
    for bit in range(_BITS):
        for axis in range(3):
            place |= (cell[:, axis] >> bit & 1) << (3 * bit + axis)
    order = np.argsort(place, kind="stable")
    cube = place[order] >> 3 * _CUBE_BITS
    enters = np.flatnonzero(np.diff(cube)) + 1
    return order, np.union1d(enters, [*range(0, len(order), _GROUP), len(order)])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _first_hits(corners, starts, origins, directions):
    groups = len(starts) - 1
    x, y, z, radius = np.zeros(groups), np.zeros(groups), np.zeros(groups), np.zeros(groups)
    for g in range(groups):
        own = corners[starts[g] : starts[g + 1]]
        x[g], y[g], z[g] = own[:, :, 0].mean(), own[:, :, 1].mean(), own[:, :, 2].mean()
        for f in range(len(own)):
            for c in range(3):
                u, v, w = own[f, c, 0] - x[g], own[f, c, 1] - y[g], own[f, c, 2] - z[g]
                radius[g] = max(radius[g], np.sqrt(u * u + v * v + w * w))
    within = radius * radius * (1 + _BEYOND)
    along, aside = np.empty(groups), np.empty(groups)
    found = np.full(len(origins), np.inf)
    for r in range(len(origins)):
        ox, oy, oz = origins[r, 0], origins[r, 1], origins[r, 2]
        dx, dy, dz = directions[r, 0], directions[r, 1], directions[r, 2]
        for g in range(groups):  # apart from what decides, so that several are done at once
            u, v, w = x[g] - ox, y[g] - oy, z[g] - oz
            along[g] = u * dx + v * dy + w * dz
            aside[g] = u * u + v * v + w * w - along[g] * along[g] - within[g]
        for g in range(groups):
            if aside[g] > 0 or along[g] < -radius[g] or along[g] - radius[g] > found[r]:
                continue
            for f in range(starts[g], starts[g + 1]):
                t = _meets(corners[f], ox, oy, oz, dx, dy, dz)
                if 0 < t < found[r]:
                    found[r] = t
    return found


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _meets(triangle, ox, oy, oz, dx, dy, dz):
    """How far along the ray it meets a triangle (3,3); -1 = not."""
    ax, ay, az = triangle[0, 0], triangle[0, 1], triangle[0, 2]
    ux, uy, uz = triangle[1, 0] - ax, triangle[1, 1] - ay, triangle[1, 2] - az
    vx, vy, vz = triangle[2, 0] - ax, triangle[2, 1] - ay, triangle[2, 2] - az
    px, py, pz = dy * vz - dz * vy, dz * vx - dx * vz, dx * vy - dy * vx
    volume = ux * px + uy * py + uz * pz
    if volume == 0:
        return -1.0
    sx, sy, sz = ox - ax, oy - ay, oz - az
    u = (sx * px + sy * py + sz * pz) / volume
    if u < -_BEYOND or u > 1 + _BEYOND:
        return -1.0
    qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
    v = (dx * qx + dy * qy + dz * qz) / volume
    if v < -_BEYOND or u + v > 1 + _BEYOND:
        return -1.0
    return (vx * qx + vy * qy + vz * qz) / volume
