"""Compiled kernels that pose skeletons and differentiate single points.

A skeleton is posed once for all terms, joint by joint from the root, with the formulas of
:mod:`intercap_core.body.kinematics`. The derivative of a point x along a vector n (3,) is the row
n^T dx / d parameters; :mod:`.jacobian` derives it. Without pose blend shapes the rows equal those
of :class:`.jacobian.Linearisation` to rounding. ``place`` (P,) is the column of each parameter in a
row, -1 = none. All arrays have one floating type.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from intercap_core.body.joints import NUM_JOINTS, PARENTS
from intercap_core.body.kinematics import SMALL_ANGLE_SQUARED
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import TRANSL
from intercap_core.body.selection import Selection

_SHAPE, _TRANSL = TRANSL.stop, TRANSL.start
_PARENTS = np.array(PARENTS)


class RestJoints(NamedTuple):
    """The joints of the mean shape."""

    joints: np.ndarray
    """(55, 3) metres."""
    directions: np.ndarray
    """(55, 3, S) derivatives by the shape."""

    @classmethod
    def of(cls, model: BodyModel) -> RestJoints:
        """Return a body's joints, by a selection: point 0 is a vertex, 1 to 55 are the joints."""
        selection = model.select(np.array([0]), joints=True)
        return cls(selection.template[1:].numpy(), selection.directions[1:].numpy())


class PosedPoints(NamedTuple):
    """B posed bodies and N of their points, as arrays for kernels.

    ``rotations`` to ``moved`` are the fields of :class:`Skeleton`; ``directions`` to ``below`` are
    those of :class:`.selection.Selection`.
    """

    rest: np.ndarray
    """(B, N, 3) points at rest, metres."""
    rotations: np.ndarray
    """(B, 55, 3, 3)"""
    offsets: np.ndarray
    """(B, 55, 3)"""
    joints: np.ndarray
    """(B, 55, 3)"""
    frames: np.ndarray
    """(B, 55, 3, 3)"""
    moved: np.ndarray
    """(B, 55, 3, S)"""
    directions: np.ndarray
    """(N, 3, S)"""
    bones: np.ndarray
    """(N, K)"""
    shares: np.ndarray
    """(N, K) skinning weights: ``bone_weights`` of the selection."""
    chain: np.ndarray
    """(N, L)"""
    below: np.ndarray
    """(N, L, K)"""


class Skeleton(NamedTuple):
    """B posed skeletons. A point x that follows only joint k moves to
    rotations[k] @ x + offsets[k]."""

    rotations: np.ndarray
    """(B, 55, 3, 3)"""
    offsets: np.ndarray
    """(B, 55, 3) metres."""
    joints: np.ndarray
    """(B, 55, 3) metres."""
    frames: np.ndarray
    """(B, 55, 3, 3) R_parent J_l: maps a change of a joint's axis-angle to its rotation vector in
    the world; B = 0 without derivatives."""
    moved: np.ndarray
    """(B, 55, 3, S) derivatives of the offsets by the shape; B = 0 without derivatives."""

    def with_points(self, selection: Selection, rest: np.ndarray) -> PosedPoints:
        """Return the arrays of a selection's points; rest (B,N,3)."""
        return PosedPoints(
            rest, *self, selection.directions.numpy(), selection.bones.numpy(),
            selection.bone_weights.numpy(), selection.chain.numpy(), selection.below.numpy(),
        )  # fmt: skip


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def rest_points(template, directions, shape):
    """Return points (B,N,3) of bodies of shape (B,S); template (N,3), directions (N,3,S).

    The loops replace a BLAS product, which would start its own threads and whose rounding would
    depend on the number of bodies.
    """
    points = np.empty((len(shape), *template.shape), template.dtype)
    for b in range(len(shape)):
        for i in range(len(template)):
            for d in range(3):
                moved = template[i, d]
                for s in range(shape.shape[1]):
                    moved += directions[i, d, s] * shape[b, s]
                points[b, i, d] = moved
    return points


@numba.njit(cache=True, nogil=True)
def columns_of_limb(moved_by, place, local, to):
    """Number the fitted parameters that move a limb, and return their count m.

    A limb's rows have one column for each of these parameters (:class:`.selection.Limbs`).

    moved_by (55,) bool: the joints that move the limb.
    place (P,): column of each parameter in the normal equations, -1 = fixed.
    local (P,): filled with the column of each parameter in the limb's rows, -1 = none.
    to: its first m entries are filled with the columns of these parameters in the normal equations.
    """
    local[:] = -1
    m = 0
    for p in range(len(place)):
        if place[p] >= 0 and (p >= _TRANSL or moved_by[p // 3]):  # joint k has 3k to 3k+2
            local[p], to[m] = m, place[p]
            m += 1
    return m


@numba.njit(cache=True, nogil=True)
def add_symmetric(block, to, hessian):
    """Add a symmetric block (m,m), given by its lower triangle, to the rows and columns ``to``."""
    for p in range(len(block)):
        for q in range(p):
            hessian[to[p], to[q]] += block[p, q]
            hessian[to[q], to[p]] += block[p, q]
        hessian[to[p], to[p]] += block[p, p]


@numba.njit(cache=True, nogil=True)
def turned_back(points, b, i, n):
    """Return sum_k w_k R_k^T n: a world vector n at point i of body b, rotated to the rest pose."""
    t0 = t1 = t2 = n[0] * np.float32(0)  # zeros of the type of n
    for k in range(points.bones.shape[1]):
        w = points.shares[i, k]
        if w == 0:
            continue
        r = points.rotations[b, points.bones[i, k]]
        t0 += w * (r[0, 0] * n[0] + r[1, 0] * n[1] + r[2, 0] * n[2])
        t1 += w * (r[0, 1] * n[0] + r[1, 1] * n[1] + r[2, 1] * n[2])
        t2 += w * (r[0, 2] * n[0] + r[1, 2] * n[1] + r[2, 2] * n[2])
    return t0, t1, t2


def pose(rest: RestJoints, vectors: np.ndarray, *, derivatives: bool) -> Skeleton:
    """Pose the skeletons of parameter vectors (B,P)."""
    count, size = len(vectors), rest.directions.shape[2]
    also = count if derivatives else 0
    skeleton = Skeleton(
        np.empty((count, NUM_JOINTS, 3, 3), vectors.dtype),
        np.empty((count, NUM_JOINTS, 3), vectors.dtype),
        np.empty((count, NUM_JOINTS, 3), vectors.dtype),
        np.empty((also, NUM_JOINTS, 3, 3), vectors.dtype),
        np.empty((also, NUM_JOINTS, 3, size), vectors.dtype),
    )
    _pose(rest.joints, rest.directions, _PARENTS, vectors, *skeleton)
    return skeleton


@numba.njit(cache=True, nogil=True)
def _rodrigues(x, y, z, local, jacobian):
    """Write rotation and left Jacobian (3,3) of the axis-angle x, y, z; see :mod:`.kinematics`."""
    t2 = x * x + y * y + z * z
    if t2 < SMALL_ANGLE_SQUARED:
        a = 1 - t2 / 6 + t2 * t2 / 120
        b = 0.5 - t2 / 24 + t2 * t2 / 720
        c = 1 / 6 - t2 / 120 + t2 * t2 / 5040
    else:
        t = np.sqrt(t2)
        half = np.sin(t / 2)
        a, b = np.sin(t) / t, 2 * half * half / t2
        c = (1 - a) / t2
    for matrix, first, second in ((local, a, b), (jacobian, b, c)):
        matrix[0, 0] = 1 - second * (y * y + z * z)
        matrix[1, 1] = 1 - second * (x * x + z * z)
        matrix[2, 2] = 1 - second * (x * x + y * y)
        matrix[0, 1], matrix[1, 0] = second * x * y - first * z, second * x * y + first * z
        matrix[0, 2], matrix[2, 0] = second * x * z + first * y, second * x * z - first * y
        matrix[1, 2], matrix[2, 1] = second * y * z - first * x, second * y * z + first * x


@numba.njit(cache=True, nogil=True)
def _product(a, b, i, c):
    """Return element (i, c) of a b, both (3,3)."""
    return a[i, 0] * b[0, c] + a[i, 1] * b[1, c] + a[i, 2] * b[2, c]


@numba.njit(cache=True, nogil=True)
def _pose(rest, directions, parents, vectors, rotations, offsets, joints, frames, moved):
    """Fill the arrays of :class:`Skeleton`; sums along the tree are in float64.

    Joint j with parent p: R_j = R_p local_j, x_j = x_p + R_p (rest_j - rest_p),
    offset_j = x_j - R_j rest_j. ``frames`` is R_p times the left Jacobian of the axis-angle.
    ``moved`` is d offset_j / d shape = d x_j / d shape - R_j d rest_j / d shape.
    """
    size = directions.shape[2]
    local, jacobian = np.empty((3, 3)), np.empty((3, 3))
    world = np.empty((len(parents), 3, 3))
    placed, at_rest = np.empty((len(parents), 3)), np.empty((len(parents), 3))
    ahead = np.empty((len(parents), 3, size), vectors.dtype)  # d x_j / d shape
    for b in range(len(vectors)):
        x = vectors[b]
        for j in range(len(parents)):
            up = parents[j]
            for i in range(3):
                at_rest[j, i] = rest[j, i]
                for s in range(size):
                    at_rest[j, i] += directions[j, i, s] * x[_SHAPE + s]
            _rodrigues(
                np.float64(x[3 * j]), np.float64(x[3 * j + 1]), np.float64(x[3 * j + 2]),
                local, jacobian,
            )  # fmt: skip
            for i in range(3):
                if up < 0:
                    placed[j, i] = at_rest[j, i] + x[_TRANSL + i]
                else:
                    placed[j, i] = placed[up, i]
                for c in range(3):
                    if up < 0:
                        world[j, i, c] = local[i, c]
                    else:
                        bone = at_rest[j, c] - at_rest[up, c]
                        placed[j, i] += world[up, i, c] * bone
                        world[j, i, c] = _product(world[up], local, i, c)
            for i in range(3):
                joints[b, j, i] = placed[j, i]
                turned = 0.0
                for c in range(3):
                    rotations[b, j, i, c] = world[j, i, c]
                    turned += world[j, i, c] * at_rest[j, c]
                offsets[b, j, i] = placed[j, i] - turned
            if len(frames) == 0:
                continue
            for i in range(3):
                for c in range(3):
                    frames[b, j, i, c] = (
                        jacobian[i, c] if up < 0 else _product(world[up], jacobian, i, c)
                    )
                r = rotations[b, j, i]
                for s in range(size):
                    ahead[j, i, s] = directions[j, i, s]
                if up >= 0:
                    q = rotations[b, up, i]
                    for s in range(size):
                        ahead[j, i, s] = ahead[up, i, s] + (
                            q[0] * (directions[j, 0, s] - directions[up, 0, s])
                            + q[1] * (directions[j, 1, s] - directions[up, 1, s])
                            + q[2] * (directions[j, 2, s] - directions[up, 2, s])
                        )
                for s in range(size):
                    moved[b, j, i, s] = ahead[j, i, s] - (
                        r[0] * directions[j, 0, s]
                        + r[1] * directions[j, 1, s]
                        + r[2] * directions[j, 2, s]
                    )


@numba.njit(cache=True, nogil=True)
def _add_turn(row, place, joint, frame, scale, a, n):
    """Add scale n^T (omega x a) to the row, for the three columns omega of ``frame`` (3,3).

    a (3,): lever arm from the joint to the point, blended. n (3,): direction of the row.
    """
    t0 = scale * (a[1] * n[2] - a[2] * n[1])
    t1 = scale * (a[2] * n[0] - a[0] * n[2])
    t2 = scale * (a[0] * n[1] - a[1] * n[0])
    for d in range(3):
        q = place[3 * joint + d]
        if q >= 0:
            row[q] += frame[0, d] * t0 + frame[1, d] * t1 + frame[2, d] * t2


@numba.njit(cache=True, nogil=True)
def add_point(row, place, shape, c, b, i, scale, n, arms):
    """Add scale n^T d point i / d parameters of body b to the row; return scale n^T point.

    c: :class:`PosedPoints`. shape: indices of the fitted shape components. arms (L,3): scratch, for
    the lever arm from each joint of the point's chain.
    """
    arms[:] = 0
    x = c.rest[b, i]
    along = x[0] * 0
    t0, t1, t2 = along, along, along
    for k in range(c.bones.shape[1]):
        w = c.shares[i, k]
        if w == 0:
            continue
        m = c.bones[i, k]
        r, o, moved = c.rotations[b, m], c.offsets[b, m], c.moved[b, m]
        p0 = r[0, 0] * x[0] + r[0, 1] * x[1] + r[0, 2] * x[2] + o[0]
        p1 = r[1, 0] * x[0] + r[1, 1] * x[1] + r[1, 2] * x[2] + o[1]
        p2 = r[2, 0] * x[0] + r[2, 1] * x[1] + r[2, 2] * x[2] + o[2]
        w *= scale
        along += w * (n[0] * p0 + n[1] * p1 + n[2] * p2)
        t0 += w * (r[0, 0] * n[0] + r[1, 0] * n[1] + r[2, 0] * n[2])
        t1 += w * (r[0, 1] * n[0] + r[1, 1] * n[1] + r[2, 1] * n[2])
        t2 += w * (r[0, 2] * n[0] + r[1, 2] * n[1] + r[2, 2] * n[2])
        for s in shape:
            row[place[_SHAPE + s]] += w * (
                n[0] * moved[0, s] + n[1] * moved[1, s] + n[2] * moved[2, s]
            )
        for j in range(c.chain.shape[1]):
            part = c.below[i, j, k]
            if part != 0:
                at = c.joints[b, c.chain[i, j]]
                arms[j, 0] += part * (p0 - at[0])
                arms[j, 1] += part * (p1 - at[1])
                arms[j, 2] += part * (p2 - at[2])
    for j in range(c.chain.shape[1]):
        joint = c.chain[i, j]
        if arms[j, 0] != 0 or arms[j, 1] != 0 or arms[j, 2] != 0:
            _add_turn(row, place, joint, c.frames[b, joint], scale, arms[j], n)
    for d in range(3):
        if place[_TRANSL + d] >= 0:
            row[place[_TRANSL + d]] += scale * n[d]
    direction = c.directions[i]
    for s in shape:
        row[place[_SHAPE + s]] += t0 * direction[0, s] + t1 * direction[1, s] + t2 * direction[2, s]
    return along


@numba.njit(cache=True, nogil=True)
def project_on_direction(c, b, i, n):
    """Return n . point i of body b."""
    x, along = c.rest[b, i], 0.0
    for k in range(c.bones.shape[1]):
        w = c.shares[i, k]
        if w == 0:
            continue
        r, o = c.rotations[b, c.bones[i, k]], c.offsets[b, c.bones[i, k]]
        for d in range(3):
            along += w * n[d] * (r[d, 0] * x[0] + r[d, 1] * x[1] + r[d, 2] * x[2] + o[d])
    return along
