"""The lens of :mod:`.projection` for one point, compiled: for kernels that visit few points each.

Equal to :func:`.projection.project` and :func:`.projection.project_with_jacobian` to rounding.
"""

from __future__ import annotations

import numba
import numpy as np

from intercap_core.camera.projection import MIN_DEPTH_M


@numba.njit(cache=True, nogil=True)
def project_point(px, py, pz, parameters):
    """Pixel (u, v) of one point, camera frame, metres; ``parameters`` (13,)."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, limit = parameters
    z = max(pz, MIN_DEPTH_M)
    x, y = px / z, py / z
    stretch = max(np.sqrt(x * x + y * y) / limit, 1.0)
    x, y = x / stretch, y / stretch
    s = x * x + y * y
    d = (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))
    u = fx * stretch * (x * d + 2 * p1 * x * y + p2 * (s + 2 * x * x)) + cx
    v = fy * stretch * (y * d + p1 * (s + 2 * y * y) + 2 * p2 * x * y) + cy
    return u, v


@numba.njit(cache=True, nogil=True)
def project_point_with_jacobian(px, py, pz, parameters):
    """Pixel (u, v) of one point and du/dX, du/dY, du/dZ, dv/dX, dv/dY, dv/dZ, px/m.

    For points in front of the camera and within the metric radius: those that a pixel shows.
    """
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, _ = parameters
    z = max(pz, MIN_DEPTH_M)
    x, y = px / z, py / z
    s = x * x + y * y
    below = 1 + s * (k4 + s * (k5 + s * k6))
    d = (1 + s * (k1 + s * (k2 + s * k3))) / below
    slope = k1 + s * (2 * k2 + 3 * s * k3) - d * (k4 + s * (2 * k5 + 3 * s * k6))
    dd = 2 * slope / below
    u = fx * (x * d + 2 * p1 * x * y + p2 * (s + 2 * x * x)) + cx
    v = fy * (y * d + p1 * (s + 2 * y * y) + 2 * p2 * x * y) + cy
    xx = fx * (d + x * x * dd + 2 * p1 * y + 6 * p2 * x) / z
    xy = (x * y * dd + 2 * p1 * x + 2 * p2 * y) / z
    yy = fy * (d + y * y * dd + 6 * p1 * y + 2 * p2 * x) / z
    uy, vx = fx * xy, fy * xy
    return u, v, xx, uy, -(xx * x + uy * y), vx, yy, -(vx * x + yy * y)
