"""Depth term of E_O (equation 1, :mod:`.object_depth`) summed over a rendering, compiled.

The same residual and Jacobian as the plain version, pixel by pixel, with robust weights, straight
into the normal equations, without temporaries.
"""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def normal_equations(
    rendered,
    face,
    shift,
    measured,
    points,
    trust,
    face_normals,
    rotation,
    origin,
    eye,
    gate,
    scale,
):
    """J'WJ (6, 6), J'Wr (6,) of equation 1's depth term and how many pixels count in it.

    ``rendered``, ``face`` (h, w) of a rendering whose pixel (u, v) is pixel (u, v) + ``shift`` of
    the evidence: ``measured`` (H, W) depth, 0 where none, the ``points`` (H, W, 3) it measures,
    master frame, and ``trust`` (H, W) in each. ``face_normals`` (F, 3) object frame, ``rotation``
    (3, 3) and ``origin`` (3,) of master_from_object, ``eye`` (3,) the camera's centre. A pixel
    counts where the two depths differ by less than ``gate`` metres, with Geman-McClure weights of
    ``scale`` metres. Metres throughout; columns as in :func:`.object_depth.residuals`.
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
            nx, ny, nz = _turned(face_normals, f, rotation)
            px, py, pz = points[y, x, 0], points[y, x, 1], points[y, x, 2]
            # the rendered point lies on the same ray: eye + (p - eye) * rendered / measured
            short = 1.0 - here / measured[y, x]
            residual = short * (nx * (px - eye[0]) + ny * (py - eye[1]) + nz * (pz - eye[2]))
            ox, oy, oz = px - origin[0], py - origin[1], pz - origin[2]
            row[0], row[1], row[2] = ny * oz - nz * oy, nz * ox - nx * oz, nx * oy - ny * ox
            row[3], row[4], row[5] = -nx, -ny, -nz
            robust = scale * scale / (scale * scale + residual * residual)
            weight = trust[y, x] * robust * robust
            for i in range(6):
                weighted = weight * row[i]
                gradient[i] += weighted * residual
                for j in range(i, 6):
                    hessian[i, j] += weighted * row[j]
    for i in range(6):
        for j in range(i):
            hessian[i, j] = hessian[j, i]
    return hessian, gradient, count


@numba.njit(cache=True, nogil=True)
def matches(rendered, face, shift, measured, points, face_normals, rotation, eye):
    """Where both are: measured minus rendered depth (N,), the distance of the measured points from
    the rendered planes (N,), both metres, and where in the evidence (N, 2) as x, y.

    Arguments as in :func:`normal_equations`.
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
            nx, ny, nz = _turned(face_normals, f, rotation)
            short = 1.0 - here / measured[y, x]
            gap[count] = measured[y, x] - here
            across[count] = np.abs(
                short
                * (
                    nx * (points[y, x, 0] - eye[0])
                    + ny * (points[y, x, 1] - eye[1])
                    + nz * (points[y, x, 2] - eye[2])
                )
            )
            where[count, 0], where[count, 1] = x, y
            count += 1
    return gap[:count], across[:count], where[:count]


@numba.njit(cache=True, nogil=True)
def agreement(rendered, face, x0, y0, measured, rays, face_normals, rotation, free_m, scale):
    """Measured depth against a rendering, nothing left out: pixels compared, those of them that are
    not measured nearer by more than ``free_m``, and the sum of their agreement.

    The rendering's pixel (u, v) is pixel (u + x0, v + y0) of ``measured`` (H, W), 0 where none;
    ``rays`` (H, W, 2) of its lens; ``rotation`` (3, 3) camera_from_object. A pixel agrees by
    scale^2 / (scale^2 + r^2), r the distance across the surface, metres.
    """
    compared, free, total = 0, 0, 0.0
    for v in range(rendered.shape[0]):
        for u in range(rendered.shape[1]):
            f = face[v, u]
            depth = measured[y0 + v, x0 + u]
            if f < 0 or depth <= 0:
                continue
            compared += 1
            gap = np.float64(depth) - rendered[v, u]
            if gap > -free_m:
                free += 1
                nx, ny, nz = _turned(face_normals, f, rotation)
                r = gap * (nx * rays[y0 + v, x0 + u, 0] + ny * rays[y0 + v, x0 + u, 1] + nz)
                total += scale * scale / (scale * scale + r * r)
    return compared, free, total


@numba.njit(cache=True, nogil=True)
def _turned(face_normals, f, rotation):
    x, y, z = face_normals[f, 0], face_normals[f, 1], face_normals[f, 2]
    return (
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z,
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z,
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z,
    )
