"""Depth term of E_O: lambda_depth || (R_D - D) * S ||^2 of equation 1.

R_D is the rendered depth, D the measured depth, S the object's mask; lambda_depth is in
:mod:`intercap_core.object_track.view_fit`. The paper compares depth along the ray. The residual
here is point to plane: the same difference along the normal of the rendered triangle. It equals the
depth difference times the cosine of incidence, so grazing surfaces do not dominate, and it is
linear in small motions:

    r = n . (p - X)        dr/dw = n x (p - o)        dr/dd = -n

with p the measured point, X the surface point of the object under the same pixel and n the normal
there. The object moves by X' = exp(w) (X - o) + o + d, with o its translation.
"""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def normal_equations(
    rendered, face, shift, measured, points, trust,
    face_normals, rotation, origin, eye, gate, scale,
):  # fmt: skip
    """Sum the depth term over a rendering: J'WJ (6, 6), J'Wr (6,) and the number of pixels used.

    The loop runs over the pixels that the rendering and the patch of measurements share. A pixel
    whose depths differ by ``gate`` or more is left out. Columns are w (rad), then d (m); all
    lengths in metres.

    Args:
        rendered, face: (h, w) depth and face number of the rendering, -1 outside.
        shift: offset (x, y) of the rendering's first pixel in the patch of measurements.
        measured: (H, W) depth, 0 where invalid.
        points: (H, W, 3) measured points, master frame.
        trust: (H, W) weight of each measured pixel.
        face_normals: (F, 3) unit normals, object frame.
        rotation, origin: (3, 3) and (3,) of master_from_object.
        eye: (3,) centre of the camera, master frame.
        gate: largest difference of the two depths.
        scale: Geman-McClure scale.
    """
    hessian, gradient = np.zeros((6, 6)), np.zeros(6)
    count = 0
    row = np.empty(6)
    for v in range(max(0, -shift[1]), min(rendered.shape[0], measured.shape[0] - shift[1])):
        for u in range(max(0, -shift[0]), min(rendered.shape[1], measured.shape[1] - shift[0])):
            f = face[v, u]
            x, y = u + shift[0], v + shift[1]
            if f < 0 or measured[y, x] <= 0 or trust[y, x] <= 0:
                continue
            here = np.float64(rendered[v, u])
            if not np.abs(measured[y, x] - here) < gate:
                continue
            count += 1
            nx, ny, nz = rotated_normal(face_normals, f, rotation)
            px, py, pz = points[y, x, 0], points[y, x, 1], points[y, x, 2]
            # the rendered point lies on the same ray: eye + (p - eye) * rendered / measured
            short = 1.0 - here / measured[y, x]
            residual = short * (nx * (px - eye[0]) + ny * (py - eye[1]) + nz * (pz - eye[2]))
            ox, oy, oz = px - origin[0], py - origin[1], pz - origin[2]
            row[0], row[1], row[2] = ny * oz - nz * oy, nz * ox - nx * oz, nx * oy - ny * ox
            row[3], row[4], row[5] = -nx, -ny, -nz
            robust = scale * scale / (scale * scale + residual * residual)
            weight = trust[y, x] * robust * robust
            add_row(hessian, gradient, row, residual, weight)
    return hessian, gradient, count


@numba.njit(cache=True, nogil=True)
def matches(rendered, face, shift, measured, points, face_normals, rotation, eye):
    """Compare measured and rendered depth in all pixels that have both.

    Arguments as in :func:`normal_equations`.

    Returns:
        gap: (N,) measured minus rendered depth, metres.
        across: (N,) distance of the measured points from the rendered planes, metres.
        where: (N, 2) pixels x, y of the patch.
    """
    most = rendered.shape[0] * rendered.shape[1]
    gap, across = np.empty(most), np.empty(most)
    where = np.empty((most, 2), np.int32)
    count = 0
    for v in range(max(0, -shift[1]), min(rendered.shape[0], measured.shape[0] - shift[1])):
        for u in range(max(0, -shift[0]), min(rendered.shape[1], measured.shape[1] - shift[0])):
            f = face[v, u]
            x, y = u + shift[0], v + shift[1]
            if f < 0 or measured[y, x] <= 0:
                continue
            here = np.float64(rendered[v, u])
            nx, ny, nz = rotated_normal(face_normals, f, rotation)
            px, py, pz = points[y, x, 0], points[y, x, 1], points[y, x, 2]
            short = 1.0 - here / measured[y, x]
            gap[count] = measured[y, x] - here
            along = nx * (px - eye[0]) + ny * (py - eye[1]) + nz * (pz - eye[2])
            across[count] = np.abs(short * along)
            where[count, 0], where[count, 1] = x, y
            count += 1
    return gap[:count], across[:count], where[:count]


@numba.njit(cache=True, nogil=True)
def add_row(hessian, gradient, row, residual, weight):
    """Add a weighted row (6,) of the Jacobian to J'WJ (6, 6) and J'Wr (6,)."""
    for i in range(6):
        weighted = weight * row[i]
        gradient[i] += weighted * residual
        for j in range(i, 6):
            hessian[i, j] += weighted * row[j]
            hessian[j, i] = hessian[i, j]


@numba.njit(cache=True, nogil=True)
def rotated_normal(face_normals, f, rotation):
    """Rotate the normal of face number ``f``."""
    x, y, z = face_normals[f, 0], face_normals[f, 1], face_normals[f, 2]
    return (
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z,
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z,
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z,
    )
