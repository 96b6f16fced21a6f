"""Pose blend shapes of chosen points, compiled: the points at rest, and the exact gradient.

A point at rest moves by P vec(R - I), R the 54 local rotations below the root. Terms take the moved
points, and leave the pull p = dE / dx on each point at rest; then dE/dR = P^T p, and as a change of
an axis-angle theta turns its rotation by the left Jacobian's J_l d theta,

    dE / d theta = J_l^T sum over columns c of R_c x (dE/dR)_c.

Gauss-Newton's matrices leave these derivatives out: they are millimetres a radian beside the
decimetres by which a turn moves a limb, and would tie every point to every joint. A minimum is
where the gradient is zero, so it stays where it is.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from intercap_core.body.parameters import NUM_POSE
from intercap_core.energy.skeleton_kernel import _rodrigues

NUM_FEATURES = 486  # nine numbers of each rotation but the root's
_FIRST = 3  # parameter of the first joint below the root
_TOGETHER = 16  # points whose table stays in a core's own cache for all bodies


class Correctives(NamedTuple):
    """Of the points ``ids`` (n,) of a term, those that are moved: tables (n,3,486), metres."""

    ids: np.ndarray
    tables: np.ndarray

    @classmethod
    def of(cls, tables: np.ndarray) -> Correctives:
        """Those of a term's points (N,3,486)."""
        ids = np.flatnonzero(tables.any((1, 2)))
        return cls(ids, np.ascontiguousarray(tables[ids]))


@numba.njit(cache=True, nogil=True)
def features(vectors):
    """vec(R - I) (B,486) of the parameter vectors (B,P)."""
    out = np.empty((len(vectors), NUM_FEATURES), vectors.dtype)
    local, jacobian = np.empty((3, 3)), np.empty((3, 3))
    for b in range(len(vectors)):
        x = vectors[b]
        for p in range(_FIRST, NUM_POSE, 3):
            _rodrigues(
                np.float64(x[p]), np.float64(x[p + 1]), np.float64(x[p + 2]), local, jacobian
            )
            for i in range(3):
                for c in range(3):
                    out[b, 3 * (p - _FIRST) + 3 * i + c] = local[i, c] - (1 if i == c else 0)
    return out


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def move(correctives, feature, asked, rest):
    """Move the points at rest (B,N,3), those that are ``asked`` (B,N) for, by feature (B,486).

    By hand, as :func:`.skeleton_kernel.rest_points`.
    """
    ids, tables = correctives
    for first in range(0, len(ids), _TOGETHER):
        for b in range(len(rest)):
            by = feature[b]
            for i in range(first, min(first + _TOGETHER, len(ids))):
                if not asked[b, ids[i]]:
                    continue
                t0, t1, t2 = tables[i, 0], tables[i, 1], tables[i, 2]
                x = y = z = rest[b, 0, 0] * 0
                for k in range(NUM_FEATURES):
                    x += t0[k] * by[k]
                    y += t1[k] * by[k]
                    z += t2[k] * by[k]
                rest[b, ids[i], 0] += x
                rest[b, ids[i], 1] += y
                rest[b, ids[i], 2] += z


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def gather(correctives, pull, by_feature):
    """Add to by_feature (B,486) what the pull (B,N,3) on points at rest is by the features."""
    ids, tables = correctives
    for first in range(0, len(ids), _TOGETHER):
        for b in range(len(pull)):
            by = by_feature[b]
            for i in range(first, min(first + _TOGETHER, len(ids))):
                x, y, z = pull[b, ids[i], 0], pull[b, ids[i], 1], pull[b, ids[i], 2]
                if x == 0 and y == 0 and z == 0:
                    continue
                t0, t1, t2 = tables[i, 0], tables[i, 1], tables[i, 2]
                for k in range(NUM_FEATURES):
                    by[k] += x * t0[k] + y * t1[k] + z * t2[k]


@numba.njit(cache=True, nogil=True)
def add_gradient(vectors, by_feature, place, gradient):
    """Add a gradient by the features (B,486) to that by the parameters (B,n).

    vectors (B,P); ``place`` (P,): each parameter's column, -1 = fixed.
    """
    local, jacobian = np.empty((3, 3)), np.empty((3, 3))
    for b in range(len(vectors)):
        x = vectors[b]
        for p in range(_FIRST, NUM_POSE, 3):
            _rodrigues(
                np.float64(x[p]), np.float64(x[p + 1]), np.float64(x[p + 2]), local, jacobian
            )
            f = by_feature[b, 3 * (p - _FIRST) : 3 * (p - _FIRST) + 9].copy().reshape(3, 3)
            u0, u1, u2 = 0.0, 0.0, 0.0
            for c in range(3):
                u0 += local[1, c] * f[2, c] - local[2, c] * f[1, c]
                u1 += local[2, c] * f[0, c] - local[0, c] * f[2, c]
                u2 += local[0, c] * f[1, c] - local[1, c] * f[0, c]
            for d in range(3):
                if place[p + d] >= 0:
                    gradient[b, place[p + d]] += (
                        jacobian[0, d] * u0 + jacobian[1, d] * u1 + jacobian[2, d] * u2
                    )
