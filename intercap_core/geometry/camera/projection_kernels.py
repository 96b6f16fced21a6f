"""The lens model of :mod:`.projection` for compiled kernels, one point at a time.

The results equal those of :func:`.projection.project` and :func:`.projection.project_with_jacobian`
up to rounding. This includes points nearer than ``MIN_DEPTH_M``, behind the camera and beyond the
metric radius. Divisions by zero follow IEEE 754 instead of raising, so that loops around these
functions can be vectorised. ``parameters`` (13,) is a lens as in :mod:`.projection`.
"""

from __future__ import annotations

import numba
import numpy as np

from intercap_core.geometry.camera.projection import MIN_DEPTH_M


@numba.njit(cache=True, nogil=True, error_model="numpy")
def distort(x, y, distortion):
    """Return the distorted (xd, yd) of a point (x, y) = (X/Z, Y/Z) within the metric radius.

    ``distortion`` is the tuple k1, k2, p1, p2, k3, k4, k5, k6. The precision is that of the
    arguments.
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = distortion
    one, two = type(x)(1), type(x)(2)  # a literal would turn single precision into double
    s = x * x + y * y
    d = (one + s * (k1 + s * (k2 + s * k3))) / (one + s * (k4 + s * (k5 + s * k6)))
    xd = x * d + two * p1 * x * y + p2 * (s + two * x * x)
    yd = y * d + p1 * (s + two * y * y) + two * p2 * x * y
    return xd, yd


@numba.njit(cache=True, nogil=True, error_model="numpy")
def distort_with_jacobian(x, y, parameters):
    """Return the distorted (xd, yd) of (x, y) = (X/Z, Y/Z) and its derivatives.

    The derivatives are dxd/dx, dxd/dy, dyd/dx, dyd/dy. Beyond the metric radius the map is
    continued as in :mod:`.projection`.
    """
    _, _, _, _, k1, k2, p1, p2, k3, k4, k5, k6, limit = parameters
    radius = np.sqrt(x * x + y * y)
    outside = radius > limit
    stretch = radius / limit if outside else 1.0
    x, y = x / stretch, y / stretch  # on the rim where outside
    s = x * x + y * y
    below = 1 + s * (k4 + s * (k5 + s * k6))
    d = (1 + s * (k1 + s * (k2 + s * k3))) / below
    slope = k1 + s * (2 * k2 + 3 * s * k3) - d * (k4 + s * (2 * k5 + 3 * s * k6))
    dd = 2 * slope / below
    xd, yd = distort(x, y, (k1, k2, p1, p2, k3, k4, k5, k6))
    xx = d + x * x * dd + 2 * p1 * y + 6 * p2 * x
    xy = x * y * dd + 2 * p1 * x + 2 * p2 * y  # the model's Jacobian is symmetric
    yx = xy
    yy = d + y * y * dd + 6 * p1 * y + 2 * p2 * x
    if outside:
        along_x, along_y = (xd - xx * x - xy * y) / s, (yd - xy * x - yy * y) / s
        xx, xy = xx + along_x * x, xy + along_x * y
        yx, yy = yx + along_y * x, yy + along_y * y
        xd, yd = xd * stretch, yd * stretch
    return xd, yd, xx, xy, yx, yy


@numba.njit(cache=True, nogil=True, error_model="numpy")
def project_point(px, py, pz, parameters):
    """Return the pixel (u, v) of one point, camera frame, metres."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, limit = parameters
    z = max(pz, MIN_DEPTH_M)
    x, y = px / z, py / z
    stretch = max(np.sqrt(x * x + y * y) / limit, 1.0)
    xd, yd = distort(x / stretch, y / stretch, (k1, k2, p1, p2, k3, k4, k5, k6))
    return fx * stretch * xd + cx, fy * stretch * yd + cy


@numba.njit(cache=True, nogil=True, error_model="numpy")
def project_point_with_jacobian(px, py, pz, parameters):
    """Return the pixel (u, v) of a point, and du/dX, du/dY, du/dZ, dv/dX, dv/dY, dv/dZ, px/m.

    ``px``, ``py``, ``pz``: the point X, Y, Z in the camera's frame, metres. If Z is raised to
    ``MIN_DEPTH_M``, the pixel does not depend on Z and these derivatives are zero.
    """
    fx, fy, cx, cy = parameters[0], parameters[1], parameters[2], parameters[3]
    z = max(pz, MIN_DEPTH_M)
    x, y = px / z, py / z
    xd, yd, xx, xy, yx, yy = distort_with_jacobian(x, y, parameters)
    ux, uy = fx * xx / z, fx * (xy / z)
    vx, vy = fy * (yx / z), fy * yy / z
    uz, vz = 0.0, 0.0
    if pz > MIN_DEPTH_M:
        uz, vz = -(ux * x + uy * y), -(vx * x + vy * y)
    return fx * xd + cx, fy * yd + cy, ux, uy, uz, vx, vy, vz


@numba.njit(cache=True, nogil=True, error_model="numpy")
def unproject(pixels, parameters, radii, distorted_radii):
    """Return X/Z and Y/Z (N, 2) of pixels (N, 2), float64: the exact inverse of the projection.

    Newton's iteration, which starts from the inverse of the radial distortion. NaN if the model has
    no inverse.

    Args:
        pixels: (N, 2)
        parameters: (13,) lens.
        radii: radii of :func:`.projection.radius_table`.
        distorted_radii: their distorted radii.
    """
    fx, fy, cx, cy = parameters[0], parameters[1], parameters[2], parameters[3]
    converged = 1e-12  # normalised image plane; 1e-9 px at f = 1000
    rays = np.empty_like(pixels)
    for n in range(len(pixels)):
        xd, yd = (pixels[n, 0] - cx) / fx, (pixels[n, 1] - cy) / fy
        distance = np.sqrt(xd * xd + yd * yd)
        scale = 1.0
        if distance > distorted_radii[-1]:
            scale = radii[-1] / distorted_radii[-1]
        elif distance > 0:
            at = np.searchsorted(distorted_radii, distance)
            low, high = distorted_radii[at - 1], distorted_radii[at]
            share = (distance - low) / (high - low)
            scale = (radii[at - 1] + share * (radii[at] - radii[at - 1])) / distance
        x, y = xd * scale, yd * scale
        off = np.inf
        for _ in range(8):
            at_x, at_y, xx, xy, yx, yy = distort_with_jacobian(x, y, parameters)
            rx, ry = at_x - xd, at_y - yd
            off = max(abs(rx), abs(ry))
            if off < converged:
                break
            determinant = xx * yy - xy * yx
            x -= (yy * rx - xy * ry) / determinant
            y -= (xx * ry - yx * rx) / determinant
        if not off < converged:
            at_x, at_y, xx, xy, yx, yy = distort_with_jacobian(x, y, parameters)
            off = np.sqrt((at_x - xd) ** 2 + (at_y - yd) ** 2)
        lost = not off < 1e-9  # no solution
        rays[n, 0], rays[n, 1] = (np.nan, np.nan) if lost else (x, y)
    return rays
