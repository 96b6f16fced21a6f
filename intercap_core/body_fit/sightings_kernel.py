"""E_J (equation 3) of one keypoint, summed over views and its triangulated target, compiled.

Equal to :func:`.body_keypoints.reprojection` and :func:`.body_keypoints.triangulated` to rounding.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from intercap_core.geometry.camera.projection import MIN_DEPTH_M
from intercap_core.geometry.camera.projection_kernels import distort_with_jacobian


class KeypointObservations(NamedTuple):
    """What T frames' keypoints are compared with, in the model's floating type.

    observed (T,C,K,2), confidence, sigma (T,C,K), lenses (C,13), colour_from_master (C,4,4), shift
    (T,C,K,3): see :func:`.body_keypoints.reprojection`; targets (T,K,3), targets_confidence (T,K):
    see :func:`.body_keypoints.triangulated`. Arrays of what is absent have no frame.
    """

    observed: np.ndarray
    confidence: np.ndarray
    sigma: np.ndarray
    lenses: np.ndarray
    colour_from_master: np.ndarray
    shift: np.ndarray
    targets: np.ndarray
    targets_confidence: np.ndarray
    targets_sigma: float
    scale: float


@numba.njit(cache=True, nogil=True)
def _project(px, py, pz, lens):
    """:func:`.projection_kernels.project_point_with_jacobian`, by the inverse depth."""
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    free = pz > MIN_DEPTH_M
    inverse = 1 / pz if free else 1 / MIN_DEPTH_M
    x, y = px * inverse, py * inverse
    xd, yd, xx, xy, yx, yy = distort_with_jacobian(x, y, lens)
    by_z = -inverse if free else 0.0
    ux, uy, uz = fx * xx * inverse, fx * xy * inverse, fx * (xx * x + xy * y) * by_z
    vx, vy, vz = fy * yx * inverse, fy * yy * inverse, fy * (yx * x + yy * y) * by_z
    return fx * xd + cx, fy * yd + cy, ux, uy, uz, vx, vy, vz


@numba.njit(cache=True, nogil=True)
def evaluate_keypoint(given, t, k, p, derivatives, gradient, matrix):
    """E_J of keypoint k of frame t at point p (3,), metres, master frame: returns its cost and,
    with ``derivatives``, writes gradient (3,) and Gauss-Newton matrix (3,3) by the point."""
    cost = 0.0
    gradient[:] = 0
    matrix[:] = 0
    square = given.scale * given.scale
    j = np.empty((2, 3))
    views = given.confidence.shape[1] if len(given.confidence) else 0
    for c in range(views):
        confidence = given.confidence[t, c, k]
        if not confidence > 0:
            continue
        x, y, z = p
        if len(given.shift):
            x += given.shift[t, c, k, 0]
            y += given.shift[t, c, k, 1]
            z += given.shift[t, c, k, 2]
        m = given.colour_from_master[c]
        u, v, ux, uy, uz, vx, vy, vz = _project(
            m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3],
            m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3],
            m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3],
            given.lenses[c],
        )
        sharp = 1.0 / given.sigma[t, c, k]
        ru = (u - given.observed[t, c, k, 0]) * sharp
        rv = (v - given.observed[t, c, k, 1]) * sharp
        squared = ru * ru + rv * rv
        share = square / (squared + square)
        cost += 0.5 * confidence * share * squared
        if not derivatives:
            continue
        weight = confidence * share * share
        for i in range(3):
            j[0, i] = (ux * m[0, i] + uy * m[1, i] + uz * m[2, i]) * sharp
            j[1, i] = (vx * m[0, i] + vy * m[1, i] + vz * m[2, i]) * sharp
        for i in range(3):
            gradient[i] += weight * (j[0, i] * ru + j[1, i] * rv)
            for o in range(3):
                matrix[i, o] += weight * (j[0, i] * j[0, o] + j[1, i] * j[1, o])
    if len(given.targets) and given.targets_confidence[t, k] > 0:
        sharp = 1.0 / given.targets_sigma
        r0 = (p[0] - given.targets[t, k, 0]) * sharp
        r1 = (p[1] - given.targets[t, k, 1]) * sharp
        r2 = (p[2] - given.targets[t, k, 2]) * sharp
        squared = r0 * r0 + r1 * r1 + r2 * r2
        share = square / (squared + square)
        cost += 0.5 * given.targets_confidence[t, k] * share * squared
        weight = given.targets_confidence[t, k] * share * share * sharp
        gradient[0] += weight * r0
        gradient[1] += weight * r1
        gradient[2] += weight * r2
        for i in range(3):
            matrix[i, i] += weight * sharp
    return cost
