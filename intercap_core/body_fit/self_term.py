"""Self-penetration of the body, E_P = E_P_self: equation 5, a part of equations 2 and 6.

    E_P_self = sum over p of w rho(d - tolerance) / 2,   d = -n_q . (p - q),
    p: the samples of the skin that are inside another part of the body

PROX penalises colliding triangles by the distance fields of Tzionas et al. 2016. Here a sample p
inside another part is paired with the nearest vertex q of that part's surface. d is its depth along
the normal n_q. The term pushes p out and q the other way. w is the weight of a sample and rho is
Geman and McClure's, which levels off with depth: if the observations put one part deep inside
another, they are outliers or the person is thinner than the model, and a repulsion would correct
neither. :mod:`.self_contact` finds the pairs.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from intercap_core.body.correctives_kernel import PointSource
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import TRANSL
from intercap_core.body.skeleton_kernel import (
    PosedPoints,
    add_point,
    add_symmetric,
    project_on_direction,
    turned_back,
)
from intercap_core.body_fit.surface import SAMPLE_SHARE
from intercap_core.body_fit.term_inputs import (
    Batch,
    Bodies,
    CompiledTerm,
    Pairs,
    TermInputs,
    contiguous,
)

SELF_TOLERANCE_M = 0.003  # skin yields by some millimetres under pressure; tuned on the studio
SELF_REACH_M = 0.015  # scale of rho, the depth at which it levels off; tuned on the studio
# w, 1/m^2; the skin is fitted to 8 mm (measured on the studio)
SELF_WEIGHT = SAMPLE_SHARE / 0.008**2

_SHAPE = TRANSL.stop


# --- compiled --------------------------------------------------------------------------------


class PairArrays(NamedTuple):
    """:class:`.term_inputs.Pairs` for the kernels."""

    starts: np.ndarray
    """(T + 1,) start of the pairs of each frame, then M."""
    inner: np.ndarray
    """(M,) index of the sample p among the term's points."""
    outer: np.ndarray
    """(M,) index of the vertex q among the term's points."""
    normal: np.ndarray
    """(M, 3) n_q"""
    weight: float
    """1/m^2"""


class CompiledSelfPenetration:
    """E_P_self by the kernels below; the points of the last pairs are cached."""

    def __init__(self, model: BodyModel) -> None:
        self._model = model
        self._cached: tuple[Pairs, PointSource] | None = None

    def prepare(self, inputs: TermInputs, bodies: Bodies, derivatives: bool) -> CompiledTerm | None:
        """Return the term at these bodies, None if it is switched off or there are no frames."""
        if inputs.pairs is None or not len(bodies.frames):
            return None
        if self._cached is None or self._cached[0] is not inputs.pairs:
            vertices = inputs.pairs.vertices.numpy()
            self._cached = inputs.pairs, PointSource.of(self._model, vertices)
        source = self._cached[1]
        frames = np.arange(int(bodies.frames.max()) + 2)
        pairs = PairArrays(
            starts=np.searchsorted(inputs.pairs.frame.numpy(), frames),
            inner=contiguous(inputs.pairs.inner),
            outer=contiguous(inputs.pairs.outer),
            normal=contiguous(inputs.pairs.normal),
            weight=float(inputs.self_weight * SELF_WEIGHT),
        )
        rest = source.at_rest(contiguous(bodies.vectors[:, _SHAPE:]), derivatives)

        def used(frames: np.ndarray) -> np.ndarray:
            flags = np.zeros((len(frames), rest.points.shape[1]), bool)
            for row, t in zip(flags, frames, strict=True):
                of_frame = slice(pairs.starts[t], pairs.starts[t + 1])
                row[pairs.inner[of_frame]] = row[pairs.outer[of_frame]] = True
            return flags

        def posed(batch: Batch) -> PosedPoints:
            return batch.skeleton.with_points(source.selection, rest.points[batch.at])

        return CompiledTerm(
            rest,
            used,
            lambda batch, cost: add_cost(posed(batch), pairs, batch.frames, cost),
            lambda batch, equations: add_equations(
                posed(batch), pairs, batch.frames, equations, rest.gradient[batch.at]
            ),
        )


@numba.njit(cache=True, nogil=True)
def _depth(points, pairs, b, at):
    """Return the depth of pair ``at`` beyond the tolerance, metres; <= 0 has no cost."""
    n = pairs.normal[at]
    outer = project_on_direction(points, b, pairs.outer[at], n)
    return outer - project_on_direction(points, b, pairs.inner[at], n) - SELF_TOLERANCE_M


@numba.njit(cache=True, nogil=True)
def add_cost(points, pairs, frames, cost):
    """Add E_P_self to cost (B,) of the frames (B,)."""
    square = SELF_REACH_M * SELF_REACH_M
    for b in range(len(frames)):
        total = 0.0
        for at in range(pairs.starts[frames[b]], pairs.starts[frames[b] + 1]):
            depth = _depth(points, pairs, b, at)
            if depth > 0:
                total += depth * depth * square / (depth * depth + square)
        cost[b] += 0.5 * pairs.weight * total


@numba.njit(cache=True, nogil=True)
def add_equations(points, pairs, frames, equations, rest_gradient):
    """Add the normal equations of E_P_self to those of the frames (B,).

    For each frame the rows of all pairs are computed first. The columns that are zero in every row
    are dropped, and the rest is one dense product.

    equations: :class:`.term_inputs.BatchEquations`, filled in place.
    rest_gradient (B,N,3): gradient by the points at rest, filled in place; empty without pose blend
    shapes.
    """
    place, cost = equations.place, equations.cost
    gradient, hessian = equations.gradient, equations.hessian
    shape = np.flatnonzero(place[_SHAPE:] >= 0)
    columns = place[place >= 0]
    scratch = np.empty((points.chain.shape[1], 3), hessian.dtype)
    one = np.ones(1, hessian.dtype)[0]
    square = SELF_REACH_M * SELF_REACH_M
    for b in range(len(frames)):
        first, end = pairs.starts[frames[b]], pairs.starts[frames[b] + 1]
        rows = np.zeros((end - first, gradient.shape[1]), hessian.dtype)
        root = np.zeros(end - first, hessian.dtype)
        count = 0
        for at in range(first, end):
            depth = _depth(points, pairs, b, at)
            if depth <= 0:
                continue
            row, n = rows[count], pairs.normal[at]
            # d depth / d parameters = -n . (dp - dq)
            add_point(row, place, shape, points, b, pairs.outer[at], one, n, scratch)
            add_point(row, place, shape, points, b, pairs.inner[at], -one, n, scratch)
            share = square / (depth * depth + square)
            cost[b] += 0.5 * pairs.weight * share * depth * depth
            weight = pairs.weight * share * share
            for q in columns:
                gradient[b, q] += weight * depth * row[q]
            if len(rest_gradient):
                outer, inner = pairs.outer[at], pairs.inner[at]
                o, p = turned_back(points, b, outer, n), turned_back(points, b, inner, n)
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
        # loops, since a BLAS product would start its own threads for each frame
        block = np.zeros((m, m), hessian.dtype)
        for r in range(count):
            for p in range(m):
                for q in range(p + 1):
                    block[p, q] += dense[r, p] * dense[r, q]
        add_symmetric(block, used, hessian[b])
