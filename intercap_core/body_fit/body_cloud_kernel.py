"""E_D (equation 4) of :mod:`.body_cloud`, compiled: a limb's samples touch few columns.

Equal to :func:`.body_cloud.assemble` to rounding, pose blend shapes included: see
:mod:`.correctives_kernel`.
"""

from __future__ import annotations

import numba
import numpy as np

from intercap_core.body.correctives_kernel import add_to_row
from intercap_core.body.parameters import TRANSL
from intercap_core.body.skeleton_kernel import columns_of_limb, turned_back

_SHAPE, _TRANSL = TRANSL.stop, TRANSL.start
_TOGETHER = 4  # rows that are added to a block at once


@numba.njit(cache=True, nogil=True)
def _find_columns(moved_by, place, group, place_u, local, local_u, to):
    """A limb's columns: writes where each parameter's (P,) and each covering's (G,) is in its rows,
    -1 = not there, and ``to``, where they stand in the normal equations; how many there are."""
    m = columns_of_limb(moved_by, place, local, to)
    local_u[:] = -1
    for g in group:
        if place_u[g] >= 0 and local_u[g] < 0:
            local_u[g], to[m] = m, place_u[g]
            m += 1
    return m


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _fill_row(row, local, shape, c, b, i, n, arms, by_shape):
    """Write n . d point i / d parameters of body b by the columns ``local`` (P,); n . point.

    ``shape``: the shape's fitted columns, from 0; arms (L,3), by_shape (S,) scratch.
    """
    x0, x1, x2, along = c.rest[b, i, 0], c.rest[b, i, 1], c.rest[b, i, 2], 0.0
    n0, n1, n2 = n
    t0, t1, t2 = n0 * 0, n0 * 0, n0 * 0
    for q in range(len(row)):
        row[q] = 0
    for s in range(len(by_shape)):
        by_shape[s] = 0
    for j in range(len(arms)):
        arms[j, 0] = arms[j, 1] = arms[j, 2] = 0
    for k in range(c.bones.shape[1]):
        w, m = c.shares[i, k], c.bones[i, k]
        if w == 0:
            continue
        r00, r01, r02 = c.rotations[b, m, 0, 0], c.rotations[b, m, 0, 1], c.rotations[b, m, 0, 2]
        r10, r11, r12 = c.rotations[b, m, 1, 0], c.rotations[b, m, 1, 1], c.rotations[b, m, 1, 2]
        r20, r21, r22 = c.rotations[b, m, 2, 0], c.rotations[b, m, 2, 1], c.rotations[b, m, 2, 2]
        p0 = r00 * x0 + r01 * x1 + r02 * x2 + c.offsets[b, m, 0]
        p1 = r10 * x0 + r11 * x1 + r12 * x2 + c.offsets[b, m, 1]
        p2 = r20 * x0 + r21 * x1 + r22 * x2 + c.offsets[b, m, 2]
        along += w * (n0 * p0 + n1 * p1 + n2 * p2)
        for j in range(len(arms)):
            part, joint = c.below[i, j, k], c.chain[i, j]
            if part != 0:
                arms[j, 0] += part * (p0 - c.joints[b, joint, 0])
                arms[j, 1] += part * (p1 - c.joints[b, joint, 1])
                arms[j, 2] += part * (p2 - c.joints[b, joint, 2])
        if len(shape):
            t0 += w * (r00 * n0 + r10 * n1 + r20 * n2)
            t1 += w * (r01 * n0 + r11 * n1 + r21 * n2)
            t2 += w * (r02 * n0 + r12 * n1 + r22 * n2)
            w0, w1, w2 = w * n0, w * n1, w * n2
            for s in range(len(by_shape)):
                by_shape[s] += (
                    w0 * c.moved[b, m, 0, s] + w1 * c.moved[b, m, 1, s] + w2 * c.moved[b, m, 2, s]
                )
    for j in range(len(arms)):
        a0, a1, a2, joint = arms[j, 0], arms[j, 1], arms[j, 2], c.chain[i, j]
        if (a0 == 0 and a1 == 0 and a2 == 0) or local[3 * joint] < 0:
            continue
        # n . (w x a) = w . (a x n)
        u0, u1, u2 = a1 * n2 - a2 * n1, a2 * n0 - a0 * n2, a0 * n1 - a1 * n0
        for d in range(3):
            if local[3 * joint + d] >= 0:
                row[local[3 * joint + d]] += (
                    c.frames[b, joint, 0, d] * u0
                    + c.frames[b, joint, 1, d] * u1
                    + c.frames[b, joint, 2, d] * u2
                )
    for d in range(3):
        if local[_TRANSL + d] >= 0:
            row[local[_TRANSL + d]] = n[d]
    if len(shape):
        for s in range(len(by_shape)):
            by_shape[s] += (
                t0 * c.directions[i, 0, s] + t1 * c.directions[i, 1, s] + t2 * c.directions[i, 2, s]
            )
    for s in shape:
        row[local[_SHAPE + s]] = by_shape[s]
    return along


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _add_squares(rows, weights, block):
    """Add the lower triangle of rows^T diag(weights) rows, of four rows (4,m), to block (m,m)."""
    for p in range(block.shape[0]):
        a0, a1 = weights[0] * rows[0, p], weights[1] * rows[1, p]
        a2, a3 = weights[2] * rows[2, p], weights[3] * rows[3, p]
        for q in range(p + 1):
            block[p, q] += a0 * rows[0, q] + a1 * rows[1, q] + a2 * rows[2, q] + a3 * rows[3, q]


@numba.njit(cache=True, nogil=True)
def add_equations(
    chain,
    limbs,
    normal,
    weight,
    target,
    thickness,
    group,
    frames,
    place,
    place_u,
    cost,
    gradient,
    hessian,
    rest_gradient,
    tables,
    by_pose,
):
    """Add the normal equations of E_D to those of the frames (B,).

    ``limbs``: as :attr:`.Selection.limbs`; normal (T,N,3), weight (T,N), 0 = no row, target (T,N);
    thickness (G,) of each group's points, (N,), whose derivative by its column in ``place_u`` (G,)
    is itself; ``place`` (P,): the parameters' columns; -1 = fixed. cost (B,), gradient (B,n),
    hessian (B,n,n). rest_gradient (B,N,3): that of the points at rest, filled in, tables (N,3,486)
    and by_pose (B,54,3,9): see :mod:`.correctives_kernel`; of no body without pose blend shapes.
    """
    order, starts, moved_by = limbs
    dtype = hessian.dtype
    shape = np.flatnonzero(place[_SHAPE:] >= 0)
    arms = np.empty((chain.chain.shape[1], 3), dtype)
    by_shape = np.empty(len(place) - _SHAPE, dtype)
    weights, weighted = np.empty(_TOGETHER, dtype), np.empty(1, dtype)
    limbs_count, size = len(starts) - 1, len(place) + len(place_u)
    all_local = np.empty((limbs_count, len(place)), np.int64)
    all_local_u = np.empty((limbs_count, len(place_u)), np.int64)
    all_to, width = np.empty((limbs_count, size), np.int64), np.empty(limbs_count, np.int64)
    for limb in range(limbs_count):
        width[limb] = _find_columns(
            moved_by[limb], place, group[order[starts[limb] : starts[limb + 1]]], place_u,
            all_local[limb], all_local_u[limb], all_to[limb],
        )  # fmt: skip
    for b in range(len(frames)):
        t, total = frames[b], 0.0
        for limb in range(limbs_count):
            m, filled = width[limb], 0
            local, local_u, to = all_local[limb], all_local_u[limb], all_to[limb]
            rows, block = np.empty((_TOGETHER, m), dtype), np.zeros((m, m), dtype)
            sample_gradient = np.zeros(m, dtype)
            of_limb = np.flatnonzero(moved_by[limb, 1:]) + 1
            for at in range(starts[limb], starts[limb + 1]):
                i = order[at]
                w, g = weight[t, i], group[i]
                if not w > 0:
                    continue
                row = rows[filled]
                n = normal[t, i, 0], normal[t, i, 1], normal[t, i, 2]
                along = _fill_row(row, local, shape, chain, b, i, n, arms, by_shape)
                if local_u[g] >= 0:
                    row[local_u[g]] = thickness[g]
                e = target[t, i] - along - thickness[g]
                total += w * e * e / 2
                weighted[0] = w * e
                for q in range(m):
                    sample_gradient[q] -= weighted[0] * row[q]
                if len(rest_gradient):
                    back = turned_back(chain, b, i, n)
                    for d in range(3):
                        rest_gradient[b, i, d] -= weighted[0] * back[d]
                    add_to_row(row, local, of_limb, back, tables[i], by_pose[b])
                weights[filled] = w
                filled += 1
                if filled == _TOGETHER:
                    _add_squares(rows, weights, block)
                    filled = 0
            if filled:
                for r in range(filled, _TOGETHER):
                    weights[r] = 0
                    rows[r] = 0
                _add_squares(rows, weights, block)
            for p in range(m):
                gradient[b, to[p]] += sample_gradient[p]
                for q in range(p):
                    block[q, p] = block[p, q]
            for p in range(m):
                for q in range(m):
                    hessian[b, to[p], to[q]] += block[p, q]
        cost[b] += total
