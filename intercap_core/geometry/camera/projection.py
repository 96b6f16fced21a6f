"""The rational lens model of OpenCV, for numpy arrays and torch tensors alike.

A camera is the vector ``parameters`` (..., 13): fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6,
metric_radius. Its leading axes broadcast against those of the points, so ``(C, 1, 13)``
parameters project points (T, C, K, 3) of all cameras at once.

With x = X/Z, y = Y/Z, s = x^2 + y^2 and the radial factor
d(s) = (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3):

    u = fx (x d + 2 p1 x y + p2 (s + 2 x^2)) + cx
    v = fy (y d + p1 (s + 2 y^2) + 2 p2 x y) + cy

(https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html). The pixel (0, 0) is the *centre* of the
first pixel. A calibration is valid only up to ``metric_radius`` = sqrt(s). Beyond it the
rational factor may decrease, so that points far outside would be projected into the image. There
the map is continued linearly along the ray from the principal point: the distorted position at the
metric radius is scaled by radius / metric_radius. Projections are therefore finite and monotone.
:func:`inside_model` returns which points the calibration covers.
"""

from __future__ import annotations

from typing import Any

import numpy as np

MIN_DEPTH_M = 1e-3  # points nearer than this, or behind the camera, are projected as at this depth


def _namespace(array: Any) -> Any:
    """Return torch for a tensor, numpy otherwise (torch is never imported for numpy's sake)."""
    if type(array).__module__.partition(".")[0] == "torch":
        import torch

        return torch
    return np


def _as_parameters(parameters: Any, points: Any, xp: Any) -> Any:
    if xp is np:
        return np.asarray(parameters, points.dtype)
    if not isinstance(parameters, xp.Tensor):
        parameters = np.array(parameters)
    return xp.as_tensor(parameters, dtype=points.dtype, device=points.device)


def radial_fraction(s: Any, q: Any) -> tuple[Any, Any]:
    """Return numerator and denominator (...) of the radial factor d at s (...), of lenses q."""
    k1, k2, k3, k4, k5, k6 = (q[..., i] for i in (4, 5, 8, 9, 10, 11))
    return 1 + s * (k1 + s * (k2 + s * k3)), 1 + s * (k4 + s * (k5 + s * k6))


def _radial(s: Any, q: Any) -> tuple[Any, Any]:
    """Return the radial factor d (...) at s (...), and 2 dd/ds; dd/dx = x (2 dd/ds)."""
    k1, k2, k3, k4, k5, k6 = (q[..., i] for i in (4, 5, 8, 9, 10, 11))
    numerator, denominator = radial_fraction(s, q)
    d = numerator / denominator
    slope = k1 + s * (2 * k2 + 3 * s * k3) - d * (k4 + s * (2 * k5 + 3 * s * k6))
    return d, 2 * slope / denominator


def _distort(x: Any, y: Any, q: Any, xp: Any) -> tuple[Any, ...]:
    """Distort x, y (...) of the normalised plane, continued beyond the metric radius.

    Returns xd, yd and the function that gives their derivatives (dxd/dx, dxd/dy, dyd/dx, dyd/dy).
    """
    limit = q[..., 12]
    squared = x * x + y * y
    outside = squared > limit * limit
    # The inner choice keeps sqrt away from 0, where autograd's derivative of it is infinite.
    one = xp.ones_like(squared)
    stretch = xp.where(outside, xp.sqrt(xp.where(outside, squared, one)) / limit, one)
    x, y = x / stretch, y / stretch  # on the rim where outside
    s = x * x + y * y
    d, dd = _radial(s, q)
    p1, p2 = q[..., 6], q[..., 7]
    xd = x * d + 2 * p1 * x * y + p2 * (s + 2 * x * x)
    yd = y * d + p1 * (s + 2 * y * y) + 2 * p2 * x * y

    def derivatives() -> tuple[Any, Any, Any, Any]:
        xx = d + x * x * dd + 2 * p1 * y + 6 * p2 * x
        xy = x * y * dd + 2 * p1 * x + 2 * p2 * y  # the model's Jacobian is symmetric
        yy = d + y * y * dd + 6 * p1 * y + 2 * p2 * x
        # Outside, the map is (distorted rim point) * stretch: the model's derivative across the
        # ray, and the distorted rim point over the radius along it.
        zero = xp.zeros_like(s)
        safe = xp.where(outside, s, one)
        along_x = xp.where(outside, (xd - xx * x - xy * y) / safe, zero)
        along_y = xp.where(outside, (yd - xy * x - yy * y) / safe, zero)
        return xx + along_x * x, xy + along_x * y, xy + along_y * x, yy + along_y * y

    return xd * stretch, yd * stretch, derivatives


def _normalise(points: Any, xp: Any) -> tuple[Any, Any, Any, Any]:
    """Return X/Z, Y/Z and 1/Z with Z raised to ``MIN_DEPTH_M``, and whether Z was not raised."""
    z = points[..., 2]
    free = z > MIN_DEPTH_M
    inverse_z = 1 / xp.where(free, z, xp.full_like(z, MIN_DEPTH_M))
    return points[..., 0] * inverse_z, points[..., 1] * inverse_z, inverse_z, free


def project(points: Any, parameters: Any) -> Any:
    """Project points (..., 3), camera frame, metres, to pixels (..., 2).

    The result is finite for all points; the module describes points beyond the metric radius. A
    point nearer than ``MIN_DEPTH_M``, or behind the camera, is treated as if at that depth.
    """
    xp = _namespace(points)
    q = _as_parameters(parameters, points, xp)
    x, y, _, _ = _normalise(points, xp)
    xd, yd, _ = _distort(x, y, q, xp)
    return xp.stack([q[..., 0] * xd + q[..., 2], q[..., 1] * yd + q[..., 3]], -1)


def project_with_jacobian(points: Any, parameters: Any) -> tuple[Any, Any]:
    """Project points (..., 3) to pixels (..., 2), with d pixel / d point (..., 2, 3), px/m.

    If :func:`project` raises the depth of a point, its pixel does not depend on Z: column 2 is 0.
    """
    xp = _namespace(points)
    q = _as_parameters(parameters, points, xp)
    x, y, inverse_z, free = _normalise(points, xp)
    xd, yd, derivatives = _distort(x, y, q, xp)
    fx, fy = q[..., 0], q[..., 1]
    pixels = xp.stack([fx * xd + q[..., 2], fy * yd + q[..., 3]], -1)
    xx, xy, yx, yy = derivatives()
    by_z = xp.where(free, -inverse_z, xp.zeros_like(inverse_z))
    u_row = [fx * xx * inverse_z, fx * xy * inverse_z, fx * (xx * x + xy * y) * by_z]
    v_row = [fy * yx * inverse_z, fy * yy * inverse_z, fy * (yx * x + yy * y) * by_z]
    return pixels, xp.stack([xp.stack(u_row, -1), xp.stack(v_row, -1)], -2)


def inside_model(points: Any, parameters: Any) -> Any:
    """Return whether points (..., 3) are in front of the lens and within its metric radius."""
    xp = _namespace(points)
    q = _as_parameters(parameters, points, xp)
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    return (z > MIN_DEPTH_M) & (x * x + y * y <= (q[..., 12] * z) ** 2)


def radius_table(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return radii (N,) from 0 to the metric radius, and their distorted radii (N,), ascending.

    The inverse of the projection starts from this table.
    """
    q = np.asarray(parameters, np.float64)
    radii = np.linspace(0.0, q[12], 1024)
    return radii, np.maximum.accumulate(radii * _radial(radii * radii, q)[0])
