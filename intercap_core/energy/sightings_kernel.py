"""What views and triangulated points say of a keypoint, compiled: :mod:`.body_keypoints`."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from intercap_core.camera.projection import MIN_DEPTH_M
from intercap_core.camera.projection_kernels import distort_with_jacobian


class Seen(NamedTuple):
    """What T frames' keypoints are compared with, in the model's floating type.

    observed (T,C,K,2), confidence, sigma (T,C,K), lenses (C,13), colour_from_master (C,4,4), shift
    (T,C,K,3): see :func:`.body_keypoints.reprojection`; targets (T,K,3), trust (T,K): see
    :func:`.body_keypoints.triangulated`. What there is none of is of no frame.
    """

    observed: np.ndarray
    confidence: np.ndarray
    sigma: np.ndarray
    lenses: np.ndarray
    colour_from_master: np.ndarray
    shift: np.ndarray
    targets: np.ndarray
    trust: np.ndarray
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
def ask(seen, t, k, p, slopes, gradient, matrix):
    """What frame t says of keypoint k at p: returns its cost and, if ``slopes`` are wanted, writes
    gradient (3,) and matrix (3,3) by the point."""
    cost = 0.0
    gradient[:] = 0
    matrix[:] = 0
    square = seen.scale * seen.scale
    j = np.empty((2, 3))
    views = seen.confidence.shape[1] if len(seen.confidence) else 0
    for c in range(views):
        trust = seen.confidence[t, c, k]
        if not trust > 0:
            continue
        x, y, z = p
        if len(seen.shift):
            x += seen.shift[t, c, k, 0]
            y += seen.shift[t, c, k, 1]
            z += seen.shift[t, c, k, 2]
        m = seen.colour_from_master[c]
        u, v, ux, uy, uz, vx, vy, vz = _project(
            m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3],
            m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3],
            m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3],
            seen.lenses[c],
        )
        sharp = 1.0 / seen.sigma[t, c, k]
        ru = (u - seen.observed[t, c, k, 0]) * sharp
        rv = (v - seen.observed[t, c, k, 1]) * sharp
        squared = ru * ru + rv * rv
        share = square / (squared + square)
        cost += 0.5 * trust * share * squared
        if not slopes:
            continue
        weight = trust * share * share
        for i in range(3):
            j[0, i] = (ux * m[0, i] + uy * m[1, i] + uz * m[2, i]) * sharp
            j[1, i] = (vx * m[0, i] + vy * m[1, i] + vz * m[2, i]) * sharp
        for i in range(3):
            gradient[i] += weight * (j[0, i] * ru + j[1, i] * rv)
            for o in range(3):
                matrix[i, o] += weight * (j[0, i] * j[0, o] + j[1, i] * j[1, o])
    if len(seen.targets) and seen.trust[t, k] > 0:
        sharp = 1.0 / seen.targets_sigma
        r0 = (p[0] - seen.targets[t, k, 0]) * sharp
        r1 = (p[1] - seen.targets[t, k, 1]) * sharp
        r2 = (p[2] - seen.targets[t, k, 2]) * sharp
        squared = r0 * r0 + r1 * r1 + r2 * r2
        share = square / (squared + square)
        cost += 0.5 * seen.trust[t, k] * share * squared
        weight = seen.trust[t, k] * share * share * sharp
        gradient[0] += weight * r0
        gradient[1] += weight * r1
        gradient[2] += weight * r2
        for i in range(3):
            matrix[i, i] += weight * sharp
    return cost
