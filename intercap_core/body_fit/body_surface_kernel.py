"""E_P_self (equation 5) of :mod:`.body_self`, and the cost of E_D (equation 4), compiled.

Equal to the plain terms to rounding; what pose blend shapes add to a gradient is left to
:mod:`.correctives_kernel`. The normal equations of E_D are in :mod:`.body_cloud_kernel`.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from intercap_core.body.parameters import TRANSL
from intercap_core.body.skeleton_kernel import add_point, turned_back

_SHAPE = TRANSL.stop


class SelfPairs(NamedTuple):
    """Pairs of :class:`.body_self.Pairs` by frame: those of frame t from starts[t] to starts[t+1].

    inner, outer (M,) points of a chain, normal (M,3). tolerance, reach (m) and weight (1/m^2) as
    in :mod:`.body_self`.
    """

    starts: np.ndarray
    inner: np.ndarray
    outer: np.ndarray
    normal: np.ndarray
    tolerance: float
    reach: float
    weight: float

    def used_points(self, frames: np.ndarray, count: int) -> np.ndarray:
        """Which of so many points the pairs of the frames (B,) are made of, (B,N) bool."""
        used = np.zeros((len(frames), count), bool)
        for row, first, end in zip(used, self.starts[frames], self.starts[frames + 1], strict=True):
            row[self.inner[first:end]] = row[self.outer[first:end]] = True
        return used


@numba.njit(cache=True, nogil=True)
def _along(c, b, i, n):
    """n . point i of body b."""
    x, along = c.rest[b, i], 0.0
    for k in range(c.bones.shape[1]):
        w = c.shares[i, k]
        if w == 0:
            continue
        r, o = c.rotations[b, c.bones[i, k]], c.offsets[b, c.bones[i, k]]
        for d in range(3):
            along += w * n[d] * (r[d, 0] * x[0] + r[d, 1] * x[1] + r[d, 2] * x[2] + o[d])
    return along


@numba.njit(cache=True, nogil=True)
def add_plane_cost(chain, normal, weight, target, thickness, group, frames, cost):
    """Add E_D, sum w e^2 / 2, e = target - n . v - thickness, to cost (B,) of the frames (B,).

    normal (T,N,3), weight (T,N), 0 = no row, target (T,N); thickness (G,) of each group's points,
    (N,).
    """
    for b in range(len(frames)):
        t, total = frames[b], 0.0
        for i in range(len(group)):
            if weight[t, i] > 0:
                along = _along(chain, b, i, normal[t, i])
                e = target[t, i] - along - thickness[group[i]]
                total += weight[t, i] * e * e / 2
        cost[b] += total


@numba.njit(cache=True, nogil=True)
def _depth(chain, pairs, b, at):
    """Depth of pair ``at`` beyond the tolerance, metres; not positive = no contact."""
    n = pairs.normal[at]
    outer = _along(chain, b, pairs.outer[at], n)
    return outer - _along(chain, b, pairs.inner[at], n) - pairs.tolerance


@numba.njit(cache=True, nogil=True)
def add_self_cost(chain, pairs, frames, cost):
    """Add E_P_self to cost (B,) of the frames (B,)."""
    square = pairs.reach * pairs.reach
    for b in range(len(frames)):
        total = 0.0
        for at in range(pairs.starts[frames[b]], pairs.starts[frames[b] + 1]):
            depth = _depth(chain, pairs, b, at)
            if depth > 0:
                total += depth * depth * square / (depth * depth + square)
        cost[b] += 0.5 * pairs.weight * total


@numba.njit(cache=True, nogil=True)
def add_self_equations(chain, pairs, frames, place, cost, gradient, hessian, rest_gradient):
    """Add the normal equations of E_P_self to those of the frames (B,).

    ``place`` (P,): each parameter's column, -1 = fixed. cost (B,), gradient (B,n), hessian (B,n,n).
    rest_gradient (B,N,3): that of the points at rest, filled in; of no body without pose blend
    shapes.
    """
    shape = np.flatnonzero(place[_SHAPE:] >= 0)
    columns = place[place >= 0]
    scratch = np.empty((chain.chain.shape[1], 3), hessian.dtype)
    one = np.ones(1, hessian.dtype)[0]
    square = pairs.reach * pairs.reach
    for b in range(len(frames)):
        first, end = pairs.starts[frames[b]], pairs.starts[frames[b] + 1]
        rows = np.zeros((end - first, gradient.shape[1]), hessian.dtype)
        root = np.zeros(end - first, hessian.dtype)
        count = 0
        for at in range(first, end):
            depth = _depth(chain, pairs, b, at)
            if depth <= 0:
                continue
            row, n = rows[count], pairs.normal[at]
            # d depth / d parameters = -n . (dp - dq)
            add_point(row, place, shape, chain, b, pairs.outer[at], one, n, scratch)
            add_point(row, place, shape, chain, b, pairs.inner[at], -one, n, scratch)
            share = square / (depth * depth + square)
            cost[b] += 0.5 * pairs.weight * share * depth * depth
            weight = pairs.weight * share * share
            for q in columns:
                gradient[b, q] += weight * depth * row[q]
            if len(rest_gradient):
                outer, inner = pairs.outer[at], pairs.inner[at]
                o, p = turned_back(chain, b, outer, n), turned_back(chain, b, inner, n)
                for d in range(3):
                    rest_gradient[b, outer, d] += weight * depth * o[d]
                    rest_gradient[b, inner, d] -= weight * depth * p[d]
            root[count] = np.sqrt(weight)
            count += 1
        if count == 0:
            continue
        used = np.empty(len(columns), np.int64)
        m = 0
        for q in columns:
            if np.any(rows[:count, q]):
                used[m] = q
                m += 1
        dense = np.empty((count, m), hessian.dtype)
        for r in range(count):
            for q in range(m):
                dense[r, q] = root[r] * rows[r, used[q]]
        # written out: a BLAS product would start its threads for each frame
        block = np.zeros((m, m), hessian.dtype)
        for r in range(count):
            for p in range(m):
                for q in range(p + 1):
                    block[p, q] += dense[r, p] * dense[r, q]
        for p in range(m):
            for q in range(p):
                hessian[b, used[p], used[q]] += block[p, q]
                hessian[b, used[q], used[p]] += block[p, q]
            hessian[b, used[p], used[p]] += block[p, p]
