"""First intersections of a few thousand rays with a mesh, by a compiled loop without a tree.

Triangles are grouped with their neighbours. For each ray, a group is skipped if the ray misses the
group's bounding sphere, or if the sphere begins behind the nearest intersection so far. The others
are tested triangle by triangle (Moeller and Trumbore 1997) in double precision. The result is
exact, since only groups without a nearer intersection are skipped.
"""

from __future__ import annotations

import numba
import numpy as np

# Share of their size by which triangles are enlarged, so that no ray passes between two of them.
# It is some million times the rounding of double precision, 1e-16 (IEEE 754).
_MARGIN = 1e-9


def first_hits(
    points: np.ndarray, faces: np.ndarray, origins: np.ndarray, directions: np.ndarray
) -> np.ndarray:
    """Return the distance (N,) to the first intersection of each ray, infinite if there is none.

    Args:
        points: (V, 3) vertices.
        faces: (F, 3) triangles, which count from either side.
        origins: (N, 3)
        directions: (N, 3) unit vectors.
    """
    corners = points[faces].astype(np.float64)
    order, starts = _group_triangles(corners.mean(1))
    return _first_hits(corners[order], starts, origins.astype(float), directions.astype(float))


def _group_triangles(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sort points (N, 3) along Morton's curve and cut the curve into groups.

    A group ends if the curve enters another cube, of 1/32 of the size of the mesh, and at every
    48th point.

    Returns:
        (N,) order of the points.
        (G + 1,) start of each group in the order, then N.
    """
    bits, cube_bits = 9, 4  # of each coordinate: along the curve, and within a cube
    size_of_group = 48  # triangles: speed
    low, size = points.min(0), np.ptp(points, axis=0).max()
    cell = ((points - low) / max(size, 1e-9) * (2**bits - 1)).astype(np.int64)
    place = np.zeros(len(points), np.int64)
    for bit in range(bits):
        for axis in range(3):
            place |= (cell[:, axis] >> bit & 1) << (3 * bit + axis)
    order = np.argsort(place, kind="stable")
    cube = place[order] >> 3 * cube_bits
    enters = np.flatnonzero(np.diff(cube)) + 1
    return order, np.union1d(enters, [*range(0, len(order), size_of_group), len(order)])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _first_hits(corners, starts, origins, directions):
    """Compiled form of :func:`first_hits`.

    corners (F,3,3): corners of the triangles, group by group. starts (G + 1,): of the groups.
    """
    groups = len(starts) - 1
    x, y, z, radius = np.zeros(groups), np.zeros(groups), np.zeros(groups), np.zeros(groups)
    for g in range(groups):
        own = corners[starts[g] : starts[g + 1]]
        x[g], y[g], z[g] = own[:, :, 0].mean(), own[:, :, 1].mean(), own[:, :, 2].mean()
        for f in range(len(own)):
            for c in range(3):
                u, v, w = own[f, c, 0] - x[g], own[f, c, 1] - y[g], own[f, c, 2] - z[g]
                radius[g] = max(radius[g], np.sqrt(u * u + v * v + w * w))
    within = radius * radius * (1 + _MARGIN)
    along, aside = np.empty(groups), np.empty(groups)
    nearest = np.full(len(origins), np.inf)
    for r in range(len(origins)):
        ox, oy, oz = origins[r, 0], origins[r, 1], origins[r, 2]
        dx, dy, dz = directions[r, 0], directions[r, 1], directions[r, 2]
        for g in range(groups):  # separate from the tests below, so that the loop is vectorised
            u, v, w = x[g] - ox, y[g] - oy, z[g] - oz
            along[g] = u * dx + v * dy + w * dz
            aside[g] = u * u + v * v + w * w - along[g] * along[g] - within[g]
        for g in range(groups):
            if aside[g] > 0 or along[g] < -radius[g] or along[g] - radius[g] > nearest[r]:
                continue
            for f in range(starts[g], starts[g + 1]):
                t = _intersect(corners[f], ox, oy, oz, dx, dy, dz)
                if 0 < t < nearest[r]:
                    nearest[r] = t
    return nearest


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _intersect(triangle, ox, oy, oz, dx, dy, dz):
    """Return the distance along the ray to a triangle (3,3); -1 = no intersection."""
    ax, ay, az = triangle[0, 0], triangle[0, 1], triangle[0, 2]
    ux, uy, uz = triangle[1, 0] - ax, triangle[1, 1] - ay, triangle[1, 2] - az
    vx, vy, vz = triangle[2, 0] - ax, triangle[2, 1] - ay, triangle[2, 2] - az
    px, py, pz = dy * vz - dz * vy, dz * vx - dx * vz, dx * vy - dy * vx
    volume = ux * px + uy * py + uz * pz
    if volume == 0:
        return -1.0
    sx, sy, sz = ox - ax, oy - ay, oz - az
    u = (sx * px + sy * py + sz * pz) / volume
    if u < -_MARGIN or u > 1 + _MARGIN:
        return -1.0
    qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
    v = (dx * qx + dy * qy + dz * qz) / volume
    if v < -_MARGIN or u + v > 1 + _MARGIN:
        return -1.0
    return (vx * qx + vy * qy + vz * qz) / volume
