"""Compiled kernels for the pose blend shapes of chosen points and their exact gradient.

A point x at rest moves by P vec(R - I), with the 54 local rotations R below the root. vec(R - I),
486 numbers, is the "feature" of a pose. Each term of the energy E uses the moved points and writes
its gradient p = dE / dx by each point at rest. Then dE / dR = P^T p. The gradient by the parameters
follows with dR / d theta_c = skew(J_l e_c) R, the left Jacobian J_l and the unit vector e_c.

The gradient is exact, the Gauss-Newton matrices are approximate. Those of keypoints and cloud
contain the derivatives of a point's blend shapes only by the joints of its own limb
(:class:`.selection.Limbs`). That of self-penetration contains none. Exact matrices would couple
every point with every joint, although the additional derivatives are only millimetres per radian.
Their assembly would take 2 times as long for the body alone, 3.5 times with hands and face. The
minima do not change, since the gradient is exact.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import NUM_POSE, POSE_COLUMNS
from intercap_core.body.selection import Selection
from intercap_core.body.skeleton_kernel import _rodrigues, rest_points

NUM_FEATURES = 486  # nine numbers of each of the 54 rotations below the root (SMPL-X)
# Column of the first joint below the root in the parameter vector.
_FIRST = POSE_COLUMNS["body_pose"].start

# Number of points that are processed for all bodies in turn: their tables, 6 kB each, then stay in
# the cache of a core.
_TOGETHER = 16


class Correctives(NamedTuple):
    """Pose blend shapes of N points."""

    ids: np.ndarray
    """(n,) indices of the points with a nonzero table."""
    tables: np.ndarray
    """(N, 3, 486) P of each point: metres per unit of the feature."""

    @classmethod
    def of(cls, tables: np.ndarray) -> Correctives:
        return cls(np.flatnonzero(tables.any((1, 2))), np.ascontiguousarray(tables))


class RestPoints(NamedTuple):
    """N points of b bodies at rest, which pose blend shapes move in place."""

    points: np.ndarray
    """(b, N, 3) metres."""
    correctives: Correctives | None
    """None without pose blend shapes."""
    gradient: np.ndarray
    """(b, N, 3) gradient of the energy by these points, filled in by the terms; b = 0 if it is not
    needed."""

    @classmethod
    def of(
        cls, points: np.ndarray, correctives: Correctives | None, derivatives: bool
    ) -> RestPoints:
        needed = derivatives and correctives is not None
        gradient = np.zeros(points.shape if needed else (0, 0, 3), points.dtype)
        return cls(points, correctives, gradient)

    @property
    def tables(self) -> np.ndarray:
        """(N, 3, 486); N = 0 without pose blend shapes."""
        empty = np.empty((0, 3, NUM_FEATURES), self.points.dtype)
        return empty if self.correctives is None else self.correctives.tables

    def move(self, feature: np.ndarray, at: slice, used: np.ndarray) -> None:
        """Move points by their pose blend shapes, in place.

        Args:
            feature: (B, 486) vec(R - I).
            at: slice of ``points`` that holds the B bodies.
            used: (B, N) bool, points that are moved.
        """
        move(self.correctives, feature, used, self.points[at])


class PointSource(NamedTuple):
    """Chosen vertices of a body, from which a term makes its points at rest."""

    selection: Selection
    correctives: Correctives | None

    @classmethod
    def of(cls, model: BodyModel, vertices: np.ndarray) -> PointSource:
        selection = model.select(vertices)
        posedirs = selection.posedirs
        return cls(selection, None if posedirs is None else Correctives.of(posedirs.numpy()))

    def at_rest(self, shape: np.ndarray, derivatives: bool) -> RestPoints:
        """Return the points of bodies of shape (b, S)."""
        template, directions = self.selection.template, self.selection.directions
        points = rest_points(template.numpy(), directions.numpy(), shape)
        return RestPoints.of(points, self.correctives, derivatives)


@numba.njit(cache=True, nogil=True)
def features(vectors):
    """Return vec(R - I) (B,486) of parameter vectors (B,P)."""
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
def move(correctives, feature, used, rest):
    """Add P feature to the points at rest (B,N,3) that are ``used`` (B,N) bool; feature (B,486).

    The loops replace a BLAS product, which would start its own threads and whose rounding would
    depend on the number of bodies.
    """
    ids, tables = correctives
    for first in range(0, len(ids), _TOGETHER):
        for b in range(len(rest)):
            by = feature[b]
            for i in range(first, min(first + _TOGETHER, len(ids))):
                if not used[b, ids[i]]:
                    continue
                t0, t1, t2 = tables[ids[i], 0], tables[ids[i], 1], tables[ids[i], 2]
                x = y = z = by[0] * np.float32(0)  # zeros of the feature's type
                for k in range(NUM_FEATURES):
                    x += t0[k] * by[k]
                    y += t1[k] * by[k]
                    z += t2[k] * by[k]
                rest[b, ids[i], 0] += x
                rest[b, ids[i], 1] += y
                rest[b, ids[i], 2] += z


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def gather(correctives, rest_gradient, by_feature):
    """Add P^T p of all points to by_feature (B,486), with p = rest_gradient (B,N,3)."""
    ids, tables = correctives
    for first in range(0, len(ids), _TOGETHER):
        for b in range(len(rest_gradient)):
            by = by_feature[b]
            for i in range(first, min(first + _TOGETHER, len(ids))):
                x, y, z = (
                    rest_gradient[b, ids[i], 0],
                    rest_gradient[b, ids[i], 1],
                    rest_gradient[b, ids[i], 2],
                )
                if x == 0 and y == 0 and z == 0:
                    continue
                t0, t1, t2 = tables[ids[i], 0], tables[ids[i], 1], tables[ids[i], 2]
                for k in range(NUM_FEATURES):
                    by[k] += x * t0[k] + y * t1[k] + z * t2[k]


@numba.njit(cache=True, nogil=True)
def rotation_derivatives(vectors):
    """Return d R / d theta (B,54,3,9) at parameters (B,P): joint, axis of theta, entry of R."""
    out = np.empty((len(vectors), NUM_FEATURES // 9, 3, 9), vectors.dtype)
    local, jacobian = np.empty((3, 3)), np.empty((3, 3))
    for b in range(len(vectors)):
        x = vectors[b]
        for joint in range(out.shape[1]):
            p = _FIRST + 3 * joint
            _rodrigues(
                np.float64(x[p]), np.float64(x[p + 1]), np.float64(x[p + 2]), local, jacobian
            )
            for d in range(3):
                w0, w1, w2 = jacobian[0, d], jacobian[1, d], jacobian[2, d]
                for c in range(3):
                    out[b, joint, d, c] = w1 * local[2, c] - w2 * local[1, c]
                    out[b, joint, d, 3 + c] = w2 * local[0, c] - w0 * local[2, c]
                    out[b, joint, d, 6 + c] = w0 * local[1, c] - w1 * local[0, c]
    return out


@numba.njit(cache=True, nogil=True)
def add_gradient(by_pose, by_feature, place, gradient):
    """Convert a gradient by the feature to one by the parameters, and add it.

    by_pose (B,54,3,9): :func:`rotation_derivatives`.
    by_feature (B,486): gradient by the feature.
    place (P,): column of each parameter, -1 = fixed.
    gradient (B,n): gradient by the parameters, filled in place.
    """
    for b in range(len(by_pose)):
        for joint in range(by_pose.shape[1]):
            for d in range(3):
                q = place[_FIRST + 3 * joint + d]
                if q >= 0:
                    for k in range(9):
                        gradient[b, q] += by_pose[b, joint, d, k] * by_feature[b, 9 * joint + k]


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def add_to_row(row, local, joints, t, table, by_pose):
    """Add the derivatives of a point's blend shapes by ``joints`` to a row n^T dx of the Jacobian.

    local (P,): column of each parameter in the row, -1 = none.
    joints: numbers of joints below the root.
    t (3,): R^T n, the row's direction n rotated to the rest pose.
    table (3,486): P of the point.
    by_pose (54,3,9): :func:`rotation_derivatives` of the body.
    """
    for joint in joints:
        first, by = 9 * (joint - 1), by_pose[joint - 1]
        s0 = s1 = s2 = t[0] * np.float32(0)  # zeros of the type of t
        for k in range(9):
            along = (
                t[0] * table[0, first + k] + t[1] * table[1, first + k] + t[2] * table[2, first + k]
            )
            s0 += along * by[0, k]
            s1 += along * by[1, k]
            s2 += along * by[2, k]
        p = 3 * joint
        if local[p] >= 0:
            row[local[p]] += s0
        if local[p + 1] >= 0:
            row[local[p + 1]] += s1
        if local[p + 2] >= 0:
            row[local[p + 2]] += s2
