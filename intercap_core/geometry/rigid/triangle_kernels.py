"""Kernels of one triangle: segments and rays that cross it, and its point nearest to another."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def segment_hit(x, y, z, u, v, w, triangles, at):
    """Return the share of the segment from (x, y, z) by (u, v, w) before it hits one of triangles
    (F, 3, 3), inf if it does not (Moeller and Trumbore 1997)."""
    ax, ay, az = triangles[at, 0, 0], triangles[at, 0, 1], triangles[at, 0, 2]
    bx, by, bz = triangles[at, 1, 0] - ax, triangles[at, 1, 1] - ay, triangles[at, 1, 2] - az
    cx, cy, cz = triangles[at, 2, 0] - ax, triangles[at, 2, 1] - ay, triangles[at, 2, 2] - az
    px, py, pz = v * cz - w * cy, w * cx - u * cz, u * cy - v * cx
    volume = bx * px + by * py + bz * pz
    if volume == 0:
        return np.inf
    tx, ty, tz = x - ax, y - ay, z - az
    s = (tx * px + ty * py + tz * pz) / volume
    if not 0 <= s <= 1:
        return np.inf
    qx, qy, qz = ty * bz - tz * by, tz * bx - tx * bz, tx * by - ty * bx
    t = (u * qx + v * qy + w * qz) / volume
    if t < 0 or s + t > 1:
        return np.inf
    along = (cx * qx + cy * qy + cz * qz) / volume
    return along if 0 <= along <= 1 else np.inf


@numba.njit(inline="always")
def normal_of(triangles, at):
    """Return the normal of one of triangles (F, 3, 3), whose length is twice the area."""
    ux, uy, uz = (
        triangles[at, 1, 0] - triangles[at, 0, 0],
        triangles[at, 1, 1] - triangles[at, 0, 1],
        triangles[at, 1, 2] - triangles[at, 0, 2],
    )
    vx, vy, vz = (
        triangles[at, 2, 0] - triangles[at, 0, 0],
        triangles[at, 2, 1] - triangles[at, 0, 1],
        triangles[at, 2, 2] - triangles[at, 0, 2],
    )
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


@numba.njit(cache=True, nogil=True)
def ray_crosses(x, y, z, corners):
    """Return whether the ray from (x, y, z) along +z crosses a triangle (3, 3).

    Computed in double precision: (x, y) must be on the same side of all three projected edges, and
    the triangle's height there above z. If (x, y) is on the line of an edge, it is treated as moved
    by an infinitesimal (e, e^2). The two faces at an edge then give consistent answers (simulation
    of simplicity, Edelsbrunner and Mucke 1990).
    """
    total, height, sign = 0.0, 0.0, 0
    for k in range(3):
        a, b, c = corners[k], corners[(k + 1) % 3], corners[(k + 2) % 3]
        # both faces of an edge use the same direction of it
        turned = a[0] > b[0] or (a[0] == b[0] and a[1] > b[1])
        if turned:
            a, b = b, a
        ax, ay = np.float64(a[0]), np.float64(a[1])
        ux, uy = np.float64(b[0]) - ax, np.float64(b[1]) - ay
        area = ux * (np.float64(y) - ay) - uy * (np.float64(x) - ax)
        side = area
        if side == 0:
            side = -uy if uy != 0 else ux
        if turned:
            area, side = -area, -side
        own_sign = 1 if side > 0 else -1
        if side == 0 or (sign and own_sign != sign):  # an edge of no length, or outside of it
            return False
        sign = own_sign
        total += area
        height += area * np.float64(c[2])
    return total != 0 and height / total > z


@numba.njit(inline="always")
def squared_distance(x, y, z, triangles, at):
    """Return the squared distance of a point to one of triangles (F, 3, 3)."""
    dx, dy, dz = from_nearest(x, y, z, triangles, at)
    return dx * dx + dy * dy + dz * dz


@numba.njit(inline="always")
def from_nearest(x, y, z, triangles, at):
    """Return the vector to a point from the nearest point of one of triangles (F, 3, 3).

    It depends on the region of the triangle's plane that the point projects to: a corner, an edge
    or the inside (Ericson, Real-Time Collision Detection, 5.1.5).
    """
    ax, ay, az = triangles[at, 0, 0], triangles[at, 0, 1], triangles[at, 0, 2]
    ux, uy, uz = triangles[at, 1, 0] - ax, triangles[at, 1, 1] - ay, triangles[at, 1, 2] - az
    vx, vy, vz = triangles[at, 2, 0] - ax, triangles[at, 2, 1] - ay, triangles[at, 2, 2] - az
    px, py, pz = x - ax, y - ay, z - az
    uu, uv, vv = (
        ux * ux + uy * uy + uz * uz,
        ux * vx + uy * vy + uz * vz,
        vx * vx + vy * vy + vz * vz,
    )
    d1, d2 = ux * px + uy * py + uz * pz, vx * px + vy * py + vz * pz
    d3, d4, d5, d6 = d1 - uu, d2 - uv, d1 - uv, d2 - vv
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    zero, one = np.float32(0), np.float32(1)
    if d1 <= 0 and d2 <= 0:
        s, t = zero, zero
    elif d3 >= 0 and d4 <= d3:
        s, t = one, zero
    elif d6 >= 0 and d5 <= d6:
        s, t = zero, one
    elif vc <= 0 and d1 >= 0 and d3 <= 0:
        s, t = d1 / (d1 - d3), zero
    elif vb <= 0 and d2 >= 0 and d6 <= 0:
        s, t = zero, d2 / (d2 - d6)
    elif va <= 0 and d4 >= d3 and d5 >= d6:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        s = one - t
    else:
        scale = one / (va + vb + vc)
        s, t = vb * scale, vc * scale
    return px - s * ux - t * vx, py - s * uy - t * vy, pz - s * uz - t * vz
