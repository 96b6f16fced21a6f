"""Cloud term of the body's energy, E_D: equation 4, a part of equation 2.

    E_D = sum over views v, points p of the person's cloud in v of min over visible vertices |v - p|

Here the distance is measured along the normal of the surface. Beyond the paper: the measured
surface is clothing and hair, not skin,

    E_D = sum over samples s of weight_s e_s^2 / 2,      e_s = target_s - n_s . v_s - c_g(s),
    c_g = c0_g exp(u_g),                                 u_g ~ N(0, spread_g^2)

with the sample v_s of the skin, the normal n_s there, and target_s, the mean of n_s . p over the
points p that were matched to the sample. Each covering g (trunk, thighs, hair, ...) has one
thickness c_g > 0 in all frames. c0_g is the usual thickness, of everyday garments
(:mod:`.surface`). Errors of neighbouring points come from one fold of cloth, so a sample counts as
one measurement however many points it has. :mod:`.matching` finds the points of each sample.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from torch import Tensor

from intercap_core.body.correctives_kernel import PointSource, add_to_row
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import TRANSL
from intercap_core.body.skeleton_kernel import (
    PosedPoints,
    add_symmetric,
    columns_of_limb,
    project_on_direction,
    turned_back,
)
from intercap_core.body_fit.surface import Samples
from intercap_core.body_fit.term_inputs import (
    Batch,
    Bodies,
    CloudRows,
    CompiledTerm,
    TermInputs,
    contiguous,
)

_SHAPE, _TRANSL = TRANSL.stop, TRANSL.start


def residuals(points: Tensor, rows: CloudRows, thickness: Tensor, group: Tensor) -> Tensor:
    """Return e (B, N), metres; positive if the measured surface is outside of the covering.

    Args:
        points: (B, N, 3) samples, metres.
        rows: rows of the B bodies.
        thickness: (G,) or (B, G) of the coverings, metres.
        group: (N,) covering of each sample.
    """
    return rows.target - (rows.normal * points).sum(2) - thickness[..., group]


# --- compiled --------------------------------------------------------------------------------


class CloudArrays(NamedTuple):
    """:class:`.term_inputs.CloudRows` of T frames and N samples, and the G coverings."""

    normal: np.ndarray
    """(T, N, 3)"""
    weight: np.ndarray
    """(T, N) 1/m^2, 0 = no row."""
    target: np.ndarray
    """(T, N) metres."""
    thickness: np.ndarray
    """(G,) metres."""
    group: np.ndarray
    """(N,) covering of each sample."""


class CompiledCloud:
    """E_D by the kernels below."""

    def __init__(self, model: BodyModel, samples: Samples) -> None:
        self._source = PointSource.of(model, samples.vertex)
        self._group = samples.group

    def prepare(self, inputs: TermInputs, bodies: Bodies, derivatives: bool) -> CompiledTerm | None:
        """Return the term at these bodies, None if it is switched off."""
        if inputs.rows is None:
            return None
        target, normal, weight = map(contiguous, inputs.rows)
        rows = CloudArrays(normal, weight, target, contiguous(bodies.thickness), self._group)
        selection = self._source.selection
        rest = self._source.at_rest(contiguous(bodies.vectors[:, _SHAPE:]), derivatives)

        def posed(batch: Batch) -> PosedPoints:
            return batch.skeleton.with_points(selection, rest.points[batch.at])

        return CompiledTerm(
            rest,
            lambda frames: np.asarray(rows.weight[frames] > 0),
            lambda batch, cost: add_cost(posed(batch), rows, batch.frames, cost),
            lambda batch, equations: add_equations(
                posed(batch), selection.limbs, rows, batch.frames, equations,
                rest.gradient[batch.at], rest.tables,
            ),
        )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def add_cost(points, rows, frames, cost):
    """Add E_D of the rows, :class:`CloudArrays`, to cost (B,) of the frames (B,)."""
    normal, weight, target, thickness, group = rows
    for b in range(len(frames)):
        t, total = frames[b], 0.0
        for i in range(len(group)):
            if weight[t, i] > 0:
                along = project_on_direction(points, b, i, normal[t, i])
                e = target[t, i] - along - thickness[group[i]]
                total += weight[t, i] * e * e / 2
        cost[b] += total


@numba.njit(cache=True, nogil=True)
def _find_columns(moved_by, place, group, place_u, local, local_u, to):
    """Number the columns of a limb's rows and return their count m: parameters, then coverings.

    moved_by (55,) bool: the joints that move the limb. group: coverings of the limb's samples.
    place (P,), place_u (G,): column of each parameter and covering in the normal equations, -1 =
    fixed.
    local (P,), local_u (G,): filled with their columns in the limb's rows, -1 = none.
    to: its first m entries are filled with the columns of the rows in the normal equations.
    """
    m = columns_of_limb(moved_by, place, local, to)
    local_u[:] = -1
    for g in group:
        if place_u[g] >= 0 and local_u[g] < 0:
            local_u[g], to[m] = m, place_u[g]
            m += 1
    return m


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _fill_row(row, local, shape, c, b, i, n, arms, by_shape):
    """Write n . d point i / d parameters of body b to ``row``, and return n . point.

    The same as :func:`.skeleton_kernel.add_point` on an empty row with scale 1, but faster.

    local (P,): column of each parameter in the row, -1 = none.
    shape: indices of the fitted shape components.
    c: :class:`.skeleton_kernel.PosedPoints`.
    arms (L,3), by_shape (S,): scratch, for lever arms and the derivatives by the shape.
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
        # n . (omega x a) = omega . (a x n)
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
def add_equations(points, limbs, arrays, frames, equations, rest_gradient, tables):
    """Add the normal equations of E_D to those of the frames (B,).

    For each body and limb, the rows n . dv of the limb's samples are computed and their weighted
    squares are added to one dense block (m,m), four rows at a time. The block is added to the
    normal equations at the end of the limb. Samples without weight are skipped.

    limbs: :class:`.selection.Limbs` of the samples. arrays: :class:`CloudArrays`.
    equations: :class:`.term_inputs.BatchEquations`, filled in place.
    rest_gradient (B,N,3): gradient by the points at rest, filled in place; tables (N,3,486): see
    :mod:`intercap_core.body.correctives_kernel`. B and N are 0 without pose blend shapes.
    """
    normal, weight, target, thickness, group = arrays
    place, place_u, cost = equations.place, equations.place_u, equations.cost
    gradient, hessian = equations.gradient, equations.hessian
    order, starts, moved_by = limbs
    dtype = hessian.dtype
    shape = np.flatnonzero(place[_SHAPE:] >= 0)
    together = 4  # rows that are added to a block at once, for speed
    arms = np.empty((points.chain.shape[1], 3), dtype)
    by_shape = np.empty(len(place) - _SHAPE, dtype)
    weights, weighted = np.empty(together, dtype), np.empty(1, dtype)
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
            rows, block = np.empty((together, m), dtype), np.zeros((m, m), dtype)
            sample_gradient = np.zeros(m, dtype)
            of_limb = np.flatnonzero(moved_by[limb, 1:]) + 1
            for at in range(starts[limb], starts[limb + 1]):
                i = order[at]
                w, g = weight[t, i], group[i]
                if not w > 0:
                    continue
                row = rows[filled]
                n = normal[t, i, 0], normal[t, i, 1], normal[t, i, 2]
                along = _fill_row(row, local, shape, points, b, i, n, arms, by_shape)
                if local_u[g] >= 0:
                    row[local_u[g]] = thickness[g]
                e = target[t, i] - along - thickness[g]
                total += w * e * e / 2
                weighted[0] = w * e
                for q in range(m):
                    sample_gradient[q] -= weighted[0] * row[q]
                if len(rest_gradient):
                    back = turned_back(points, b, i, n)
                    for d in range(3):
                        rest_gradient[b, i, d] -= weighted[0] * back[d]
                    add_to_row(row, local, of_limb, back, tables[i], equations.by_pose[b])
                weights[filled] = w
                filled += 1
                if filled == together:
                    _add_squares(rows, weights, block)
                    filled = 0
            if filled:
                for r in range(filled, together):
                    weights[r] = 0
                    rows[r] = 0
                _add_squares(rows, weights, block)
            for p in range(m):
                gradient[b, to[p]] += sample_gradient[p]
            add_symmetric(block, to, hessian[b])
        cost[b] += total
