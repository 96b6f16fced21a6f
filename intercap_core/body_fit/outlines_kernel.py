"""Which vertex of the body each point of a mask's rim touches, compiled; see :mod:`.outlines`."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def touched(
    centre,
    rays,
    planes,
    vertices,
    normals,
    samples,
    patch,
    length,
    facing,
    reach,
    aside,
    turned,
):
    """Sample (M,), signed distance (M,) outward and whether it counts (M,) of rays through a rim.

    centre (3,) of the camera, unit rays (M,3) and normals ``planes`` (M,3), in the frame of the
    vertices and their normals (R,3); samples (S,) and patch (S,20) are places among those. Only
    samples whose normal is within ``facing`` (a cosine) of the right angle to the line of sight can
    be on the rim. ``length`` metres a radian between normals; a match counts
    within ``reach`` metres along the plane's normal, ``aside`` metres beside the ray, and where the
    cosine between the normals is over ``turned``.
    """
    kind, where = vertices.dtype, np.empty((6, len(samples)), vertices.dtype)
    rim = np.empty(len(samples), np.int64)
    count = 0
    for s in range(len(samples)):
        v = samples[s]
        along = square = vertices[v, 0] * 0
        for d in range(3):
            gap = vertices[v, d] - centre[d]
            along += gap * normals[v, d]
            square += gap * gap
        if along * along < facing * facing * square:
            rim[count] = s
            for d in range(3):
                where[d, count] = vertices[v, d] - centre[d]
                where[3 + d, count] = normals[v, d]
            count += 1
    where, apart = where[:, :count].copy(), np.empty(count, kind)
    sample = np.zeros(len(rays), np.int64)
    distance = np.zeros(len(rays), kind)
    valid = np.zeros(len(rays), np.bool_)
    if count == 0:
        return sample, distance, valid
    turn = 2 * length * length  # |n - m|^2 = 2 - 2 n . m of unit vectors
    for m in range(len(rays)):
        rx, ry, rz = rays[m, 0], rays[m, 1], rays[m, 2]
        nx, ny, nz = planes[m, 0], planes[m, 1], planes[m, 2]
        tx, ty, tz = ry * nz - rz * ny, rz * nx - rx * nz, rx * ny - ry * nx
        for at in range(count):
            x, y, z = where[0, at], where[1, at], where[2, at]
            height, beside = x * nx + y * ny + z * nz, x * tx + y * ty + z * tz
            cosine = where[3, at] * nx + where[4, at] * ny + where[5, at] * nz
            apart[at] = height * height + beside * beside - turn * cosine
        best = rim[np.argmin(apart)]
        least = vertices[0, 0] * 0 + np.inf
        for v in patch[best]:
            x, y, z = (
                vertices[v, 0] - centre[0],
                vertices[v, 1] - centre[1],
                vertices[v, 2] - centre[2],
            )
            height, beside = x * nx + y * ny + z * nz, x * tx + y * ty + z * tz
            cosine = normals[v, 0] * nx + normals[v, 1] * ny + normals[v, 2] * nz
            far = beside * beside - turn * cosine  # one nearer to the plane is not more on the rim
            if far < least:
                least = far
                distance[m] = -height
                valid[m] = cosine > turned and abs(height) < reach and abs(beside) < aside
        sample[m] = best
    return sample, distance, valid
