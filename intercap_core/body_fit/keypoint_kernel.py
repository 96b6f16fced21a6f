"""E_J (equation 3) of :mod:`.keypoint_term`, compiled.

Linear blend skinning makes a keypoint a sum of pieces, each of which follows one bone rigidly. A
piece depends only on the bone's joint and that joint's ancestors. For each body the kernel visits
the keypoints limb by limb; a limb is a group of keypoints on the same chain of joints. For each
keypoint:
1. :func:`evaluate_keypoint` sums the views to a gradient (3,) and a matrix (3, 3) by the point;
2. `_fill_rows` computes the derivatives (3, m) of the point by the m parameters of the limb;
3. their product is added to the dense block (m, m) of the limb.
The block is added to the normal equations at the end of the limb. The result equals that of the
PyTorch form in `bench/body_energy.py` to rounding, with pose blend shapes
(:mod:`intercap_core.body.correctives_kernel`) too.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from torch import Tensor

from intercap_core.body.correctives_kernel import add_to_row
from intercap_core.body.joints import PARENTS
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import TRANSL
from intercap_core.body.skeleton_kernel import add_symmetric, columns_of_limb, rest_points
from intercap_core.body_fit.term_inputs import KeypointSet
from intercap_core.geometry.camera.projection import MIN_DEPTH_M
from intercap_core.geometry.camera.projection_kernels import distort_with_jacobian

_SHAPE, _TRANSL = TRANSL.stop, TRANSL.start
_PARENTS = np.array(PARENTS)


class KeypointData(NamedTuple):
    """:class:`.term_inputs.Views` and :class:`.term_inputs.Targets` as arrays in the floating type
    of the model. Without observations of a kind, its arrays are empty."""

    observed: np.ndarray
    """(T, C, K, 2) px."""
    confidence: np.ndarray
    """(T, C, K), 0 = not detected."""
    sigma: np.ndarray
    """(T, C, K) px."""
    lenses: np.ndarray
    """(C, 13)"""
    colour_from_master: np.ndarray
    """(C, 4, 4)"""
    shift: np.ndarray
    """(T, C, K, 3) metres."""
    targets: np.ndarray
    """(T, K, 3) metres."""
    targets_confidence: np.ndarray
    """(T, K), 0 = no target."""
    targets_sigma: float
    """Metres."""
    scale: float
    """Scale of the robust penalty, standard deviations."""


class Pieces(NamedTuple):
    """E pieces of K keypoints.

    A piece is posed to R x + share t, with R and t of its bone. x is the part of the keypoint at
    rest that follows this bone, times its share.
    """

    starts: np.ndarray
    """(K + 1,) start of the pieces of each keypoint, then E."""
    bone: np.ndarray
    """(E,) joint that moves the piece."""
    share: np.ndarray
    """(E,) weight of the bone."""
    template: np.ndarray
    """(E, 3) x of the mean shape, times the share, metres."""
    directions: np.ndarray
    """(E, 3, S) derivatives of x by the shape."""
    carrier: np.ndarray
    """(K,) piece on the bone that carries the offset of the keypoint."""
    limb_starts: np.ndarray
    """(L + 1,) start of each limb in ``order``, then K."""
    order: np.ndarray
    """(K,) keypoints, limb by limb."""
    moved_by: np.ndarray
    """(L, 55) bool, the joints that move the limb."""
    posedirs: np.ndarray
    """(E, 3, 486) pose blend shapes, or (E, 3, 0)."""

    @classmethod
    def of(cls, model: BodyModel, chosen: KeypointSet) -> Pieces:
        """Return the pieces of chosen keypoints: one for each bone that a keypoint follows."""
        points = model.select(chosen.vertices, joints=True)
        weights = points.weights.double().numpy()
        dtype = points.template.numpy().dtype
        matrix = chosen.matrix.double().numpy()
        # keypoint and bone of each piece
        made_of, bone = np.nonzero((matrix != 0) @ (weights != 0))
        share = matrix[made_of] * weights[:, bone].T  # (E,N), of each point in each piece
        carrier = np.flatnonzero(bone == chosen.carrier.numpy()[made_of])
        starts = np.searchsorted(made_of, np.arange(len(matrix) + 1))

        def mixed(values: Tensor) -> np.ndarray:
            return np.tensordot(share, values.double().numpy(), 1).astype(dtype)

        posedirs = points.directions[..., :0] if points.posedirs is None else points.posedirs
        return cls(
            starts, bone, share.sum(1).astype(dtype), mixed(points.template),
            mixed(points.directions), carrier, chosen.limbs.starts, chosen.limbs.order,
            chosen.limbs.moved_by, mixed(posedirs),
        )  # fmt: skip

    def at_rest(self, shape: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        """Return the pieces (B,E,3) at rest of bodies of shape (B,S), with offsets (K,3)."""
        rest = rest_points(self.template, self.directions, shape)
        rest[:, self.carrier] += offsets
        return rest


@numba.njit(cache=True, nogil=True)
def _project(px, py, pz, lens):
    """Return u, v, du/d(x, y, z) and dv/d(x, y, z) of a point in the camera's frame.

    The same as :func:`.projection_kernels.project_point_with_jacobian`, with one division.
    """
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
def evaluate_keypoint(data, t, k, p, derivatives, gradient, matrix):
    """Return the cost of keypoint k of frame t at point p (3,), master frame, metres.

    With ``derivatives``, write gradient (3,) and Gauss-Newton matrix (3,3) by the point.
    """
    cost = 0.0
    gradient[:] = 0
    matrix[:] = 0
    square = data.scale * data.scale
    j = np.empty((2, 3))
    views = data.confidence.shape[1] if len(data.confidence) else 0
    for c in range(views):
        confidence = data.confidence[t, c, k]
        if not confidence > 0:
            continue
        x, y, z = p
        if len(data.shift):
            x += data.shift[t, c, k, 0]
            y += data.shift[t, c, k, 1]
            z += data.shift[t, c, k, 2]
        m = data.colour_from_master[c]
        u, v, ux, uy, uz, vx, vy, vz = _project(
            m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3],
            m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3],
            m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3],
            data.lenses[c],
        )
        sharp = 1.0 / data.sigma[t, c, k]
        ru = (u - data.observed[t, c, k, 0]) * sharp
        rv = (v - data.observed[t, c, k, 1]) * sharp
        squared = ru * ru + rv * rv
        share = square / (squared + square)  # Geman and McClure: rho = share * squared
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
    if len(data.targets) and data.targets_confidence[t, k] > 0:
        sharp = 1.0 / data.targets_sigma
        r0 = (p[0] - data.targets[t, k, 0]) * sharp
        r1 = (p[1] - data.targets[t, k, 1]) * sharp
        r2 = (p[2] - data.targets[t, k, 2]) * sharp
        squared = r0 * r0 + r1 * r1 + r2 * r2
        share = square / (squared + square)
        cost += 0.5 * data.targets_confidence[t, k] * share * squared
        weight = data.targets_confidence[t, k] * share * share * sharp
        gradient[0] += weight * r0
        gradient[1] += weight * r1
        gradient[2] += weight * r2
        for i in range(3):
            matrix[i, i] += weight * sharp
    return cost


@numba.njit(cache=True, nogil=True)
def _piece(skeleton, pieces, rest, b, e):
    """Return piece e of body b, posed: R x + share t (3,), metres."""
    m, w = pieces.bone[e], pieces.share[e]
    x, y, z = rest[b, e, 0], rest[b, e, 1], rest[b, e, 2]
    turn, offset = skeleton.rotations, skeleton.offsets
    p0 = turn[b, m, 0, 0] * x + turn[b, m, 0, 1] * y + turn[b, m, 0, 2] * z + w * offset[b, m, 0]
    p1 = turn[b, m, 1, 0] * x + turn[b, m, 1, 1] * y + turn[b, m, 1, 2] * z + w * offset[b, m, 1]
    p2 = turn[b, m, 2, 0] * x + turn[b, m, 2, 1] * y + turn[b, m, 2, 2] * z + w * offset[b, m, 2]
    return p0, p1, p2


@numba.njit(cache=True, nogil=True)
def _point(skeleton, pieces, rest, b, k):
    """Return the position (3,) of keypoint k of body b, metres."""
    p0, p1, p2 = 0.0, 0.0, 0.0
    for e in range(pieces.starts[k], pieces.starts[k + 1]):
        q0, q1, q2 = _piece(skeleton, pieces, rest, b, e)
        p0, p1, p2 = p0 + q0, p1 + q1, p2 + q2
    return p0, p1, p2


@numba.njit(cache=True, nogil=True)
def add_cost(skeleton, pieces, rest, data, frames, cost):
    """Add E_J to cost (B,) of the frames (B,); rest (B,E,3): pieces at rest."""
    gradient, matrix = np.empty(3), np.empty((3, 3))
    for b in range(len(frames)):
        total = 0.0
        for k in range(len(pieces.carrier)):
            p = _point(skeleton, pieces, rest, b, k)
            total += evaluate_keypoint(data, frames[b], k, p, False, gradient, matrix)
        cost[b] += total


@numba.njit(cache=True, nogil=True)
def _fill_rows(skeleton, pieces, rest, b, k, local, shape, rows, moved):
    """Write the derivatives (3,m) of keypoint k to ``rows``.

    local (P,): column of each parameter in the rows, -1 = none. shape: indices of the fitted shape
    components. moved (3,S): scratch, for the derivatives by all shape components.
    """
    rows[:] = 0
    moved[:] = 0
    for e in range(pieces.starts[k], pieces.starts[k + 1]):
        m, w = pieces.bone[e], pieces.share[e]
        q0, q1, q2 = _piece(skeleton, pieces, rest, b, e)
        up = m
        while up >= 0:
            a0 = q0 - w * skeleton.joints[b, up, 0]
            a1 = q1 - w * skeleton.joints[b, up, 1]
            a2 = q2 - w * skeleton.joints[b, up, 2]
            for d in range(3):
                place = local[3 * up + d]
                if place >= 0:  # a rotation f of the joint moves the piece by f x a
                    f0 = skeleton.frames[b, up, 0, d]
                    f1 = skeleton.frames[b, up, 1, d]
                    f2 = skeleton.frames[b, up, 2, d]
                    rows[0, place] += f1 * a2 - f2 * a1
                    rows[1, place] += f2 * a0 - f0 * a2
                    rows[2, place] += f0 * a1 - f1 * a0
            up = _PARENTS[up]
        for d in range(3):
            if local[_TRANSL + d] >= 0:
                rows[d, local[_TRANSL + d]] += w
        if len(shape):
            for i in range(3):
                r0 = skeleton.rotations[b, m, i, 0]
                r1 = skeleton.rotations[b, m, i, 1]
                r2 = skeleton.rotations[b, m, i, 2]
                for s in range(moved.shape[1]):
                    moved[i, s] += (
                        r0 * pieces.directions[e, 0, s]
                        + r1 * pieces.directions[e, 1, s]
                        + r2 * pieces.directions[e, 2, s]
                        + w * skeleton.moved[b, m, i, s]
                    )
    for s in shape:
        for i in range(3):
            rows[i, local[_SHAPE + s]] = moved[i, s]


@numba.njit(cache=True, nogil=True)
def _add_correctives(
    skeleton, pieces, b, k, by_keypoint, rest_gradient, rows, local, joints, by_pose
):
    """Add the contributions of the pose blend shapes of keypoint k.

    by_keypoint (3,): gradient of the cost by the keypoint.
    rest_gradient (B,E,3): the gradient by the pieces at rest is added.
    rows (3,m): the derivatives of the blend shapes by ``joints`` are added.
    local (P,): column of each parameter in the rows, -1 = none.
    by_pose (54,3,9): see :func:`.correctives_kernel.rotation_derivatives`.
    """
    for e in range(pieces.starts[k], pieces.starts[k + 1]):
        turn = skeleton.rotations[b, pieces.bone[e]]
        for i in range(3):
            for d in range(3):
                rest_gradient[b, e, d] += turn[i, d] * by_keypoint[i]
            add_to_row(rows[i], local, joints, turn[i], pieces.posedirs[e], by_pose)


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _weigh(matrix, rows, weighted):
    """Write the product of matrix (3,3) and rows (3,m) to ``weighted`` (3,m)."""
    for i in range(3):
        m0, m1, m2 = matrix[i, 0], matrix[i, 1], matrix[i, 2]
        for q in range(rows.shape[1]):
            weighted[i, q] = m0 * rows[0, q] + m1 * rows[1, q] + m2 * rows[2, q]


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _add_product(rows, weighted, block):
    """Add the lower triangle of rows^T weighted, (m,m), to block; rows and weighted (3,m)."""
    for p in range(block.shape[0]):
        a0, a1, a2 = rows[0, p], rows[1, p], rows[2, p]
        for q in range(p + 1):
            block[p, q] += a0 * weighted[0, q] + a1 * weighted[1, q] + a2 * weighted[2, q]


@numba.njit(cache=True, nogil=True)
def _add_offset(turn, by_keypoint, matrix, weighted, to, first, gradient, hessian):
    """Add the blocks of a keypoint's offset, whose three columns start at ``first``.

    turn (3,3): rotation of the bone that carries the offset.
    by_keypoint (3,), matrix (3,3): gradient and Gauss-Newton matrix by the keypoint.
    weighted (3,m): matrix times the keypoint's rows, whose columns in the hessian are ``to``.
    """
    for d in range(3):
        r0, r1, r2 = turn[0, d], turn[1, d], turn[2, d]
        gradient[first + d] += r0 * by_keypoint[0] + r1 * by_keypoint[1] + r2 * by_keypoint[2]
        for e in range(3):
            for i in range(3):
                hessian[first + d, first + e] += turn[i, e] * (
                    r0 * matrix[0, i] + r1 * matrix[1, i] + r2 * matrix[2, i]
                )
        for q in range(weighted.shape[1]):
            part = r0 * weighted[0, q] + r1 * weighted[1, q] + r2 * weighted[2, q]
            hessian[to[q], first + d] += part
            hessian[first + d, to[q]] += part


@numba.njit(cache=True, nogil=True)
def add_equations(skeleton, pieces, rest, data, frames, equations, rest_gradient):
    """Add the normal equations of E_J to those of the frames (B,).

    rest (B,E,3): pieces at rest.
    equations: :class:`.term_inputs.BatchEquations`, filled in place.
    rest_gradient (B,E,3): gradient by the pieces at rest, filled in place; B = 0 without pose blend
    shapes.
    """
    place, cost = equations.place, equations.cost
    gradient, hessian = equations.gradient, equations.hessian
    dtype = hessian.dtype
    shape = np.flatnonzero(place[_SHAPE:] >= 0)
    moved = np.empty((3, len(place) - _SHAPE), dtype)
    by_keypoint, matrix = np.empty(3), np.empty((3, 3))
    narrow = np.empty((3, 3), dtype)
    limbs = len(pieces.limb_starts) - 1
    all_local = np.empty((limbs, len(place)), np.int64)
    all_to, width = np.empty((limbs, len(place)), np.int64), np.empty(limbs, np.int64)
    for limb in range(limbs):
        moved_by = pieces.moved_by[limb]
        width[limb] = columns_of_limb(moved_by, place, all_local[limb], all_to[limb])
    for b in range(len(frames)):
        for limb in range(limbs):
            m, local, to = width[limb], all_local[limb], all_to[limb]
            rows, weighted = np.empty((3, m), dtype), np.empty((3, m), dtype)
            block = np.zeros((m, m), dtype)
            of_limb = np.flatnonzero(pieces.moved_by[limb, 1:]) + 1
            for at in range(pieces.limb_starts[limb], pieces.limb_starts[limb + 1]):
                k = pieces.order[at]
                p = _point(skeleton, pieces, rest, b, k)
                cost[b] += evaluate_keypoint(data, frames[b], k, p, True, by_keypoint, matrix)
                if matrix[0, 0] + matrix[1, 1] + matrix[2, 2] == 0:
                    continue
                _fill_rows(skeleton, pieces, rest, b, k, local, shape, rows, moved)
                for q in range(m):
                    gradient[b, to[q]] += (
                        rows[0, q] * by_keypoint[0]
                        + rows[1, q] * by_keypoint[1]
                        + rows[2, q] * by_keypoint[2]
                    )
                if len(rest_gradient):
                    _add_correctives(
                        skeleton, pieces, b, k, by_keypoint, rest_gradient, rows, local, of_limb,
                        equations.by_pose[b],
                    )  # fmt: skip
                for i in range(3):
                    for o in range(3):
                        narrow[i, o] = matrix[i, o]
                _weigh(narrow, rows, weighted)
                _add_product(rows, weighted, block)
                if k < equations.offsets:
                    turn = skeleton.rotations[b, pieces.bone[pieces.carrier[k]]]
                    first = equations.first_offset + 3 * k
                    _add_offset(
                        turn, by_keypoint, matrix, weighted, to, first, gradient[b], hessian[b]
                    )
            add_symmetric(block, to, hessian[b])
