"""All cameras of a rig brought together on the surfaces that several of them see.

Point-to-plane residuals of every overlapping pair and every camera's motion in one robust
Gauss-Newton problem, with the master fixed, a weak prior on the start, and body keypoints as
further constraints (:mod:`.body_constraints`): a bare floor alone leaves three motions free.
Surfaces that move tell the cameras' exposure times as well.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from intercap_core.camera.rig import Rig
from intercap_core.camera.transforms import apply, invert
from intercap_core.scene.surface import Surface

MIN_AGREE_COSINE = 0.85  # normals of one surface, seen by two cameras
MIN_PAIR_POINTS = 60  # fewer correspondences are chance
HELD_OUT_EVERY = 4  # of each surface's cells
GATES_M = (0.08, 0.05, 0.03, 0.02, 0.02, 0.015, 0.015, 0.015)  # distance to the plane, annealed
SEARCH_M = 0.12  # distance to the nearest cell
SIGMA_FLOOR_M = 0.003
# Weak prior on the start: what a careful calibration is wrong by.
PRIOR_TRANSLATION_M = 0.01
PRIOR_ROTATION_RAD = np.radians(0.5)
PRIOR_BIAS_M = 0.003  # the depth's systematic error is up to 11 mm + 0.1 % (device data sheet)
PRIOR_OFFSET_S = 0.01  # synchronised devices expose within a third of a period
ROTATION, TRANSLATION, BIAS, OFFSET = slice(0, 3), slice(3, 6), 6, 7
FREEDOMS = 8  # of a camera
LEVER_M = 2.5  # from a camera to what it looks at, in a ring

# Adds a group's normal equations: (poses (C, 4, 4), offset (C,)) -> matrix (C, 6, C, 6), gradient
# (C, 6) of rotation and translation
Constraint = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Kind:
    """How much surfaces of one kind tell. Neighbouring residuals err together (lens, multipath,
    bias), so a pair of cameras never counts as more than ``effective_points`` independent
    measurements each way; ``queries`` points of one camera are sought in another one, over all
    layers. Of ``rounded`` surfaces two cameras see different flanks, whose points lie inside or
    outside each other's planes by a constant that is nobody's motion: it is taken off each pair.
    """

    effective_points: float
    queries: int
    rounded: bool


STATIC = Kind(effective_points=10.0, queries=2500, rounded=False)
MOVING = Kind(effective_points=50.0, queries=2500, rounded=True)


@dataclass(frozen=True)
class Layer:
    """What the cameras see at one moment: surfaces by camera index, depth camera's frame."""

    surfaces: dict[int, Surface]
    kind: Kind


@dataclass
class Estimate:
    """Poses ``master_from_colour`` (C, 4, 4), depth bias (C,), metres to subtract, and time offset
    (C,), seconds by which each camera exposes after the set's time."""

    poses: np.ndarray
    bias: np.ndarray
    offset: np.ndarray

    @classmethod
    def start(cls, rig: Rig) -> Estimate:
        """The rig as given."""
        none = np.zeros(len(rig))
        return cls(rig.master_from_colour.copy(), none, none.copy())


@dataclass(frozen=True)
class Solution:
    """An estimate, its covariance (C, 8, C, 8) of rotation about the camera's centre, translation,
    bias and offset (0 for what was held), and how far the last step moved a point, metres."""

    estimate: Estimate
    covariance: np.ndarray
    last_step_m: float


@dataclass(frozen=True)
class OffsetInformation:
    """What is known of the offsets: ``information`` (C, C) 1/s^2 times them = ``vector`` (C,)."""

    information: np.ndarray
    vector: np.ndarray


@dataclass
class PairResiduals:
    """``pairs`` (P, 2); ``count`` (P,) held-out correspondences; ``median`` (P,) metres."""

    pairs: np.ndarray
    count: np.ndarray
    median: np.ndarray


@dataclass(frozen=True)
class _Sought:
    """``queries`` and ``held_out`` cells of one camera, to be sought in another one's surface."""

    queries: Surface
    held_out: Surface
    target: Surface
    tree: cKDTree


@dataclass(frozen=True)
class _Match:
    """Correspondences of ``source`` with ``target``: distances (n,) to the planes, points and
    normals (n, 3), both depth directions (n, 3), master frame, and the speed (n,)."""

    residual: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    own_ray: np.ndarray
    other_ray: np.ndarray
    speed: np.ndarray

    @classmethod
    def joined(cls, parts: Sequence[_Match]) -> _Match:
        names = ("residual", "points", "normals", "own_ray", "other_ray", "speed")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


class Registration:
    """Holds the surfaces and their search trees; estimates a rig from them.

    ``master`` is the camera that stays, in place and in time.
    """

    def __init__(self, rig: Rig, layers: Sequence[Layer], master: int) -> None:
        self.rig = rig
        self._master = master
        self._sought: dict[tuple[Kind, int, int], list[_Sought]] = {}
        kinds = [layer.kind for layer in layers]
        for layer in layers:
            share = 1 / kinds.count(layer.kind)
            seen = {c: surface for c, surface in sorted(layer.surfaces.items()) if len(surface)}
            trees = {c: cKDTree(s.points, balanced_tree=False) for c, s in seen.items()}
            parts = {c: _split(s, round(share * layer.kind.queries)) for c, s in seen.items()}
            for a in seen:
                for b in seen:
                    if a != b:
                        pair = _Sought(*parts[a], seen[b], trees[b])
                        self._sought.setdefault((layer.kind, a, b), []).append(pair)

    def solve(
        self,
        start: Estimate,
        constraints: Sequence[Constraint] = (),
        timing: OffsetInformation | None = None,
        *,
        free_poses: bool = True,
    ) -> Solution:
        """Refine ``start``; ``constraints`` add normal equations of the poses, ``timing`` those of
        the offsets.

        Without ``free_poses`` the bias and the offsets alone are estimated.
        """
        current = Estimate(start.poses.copy(), start.bias.copy(), start.offset.copy())
        count = len(self.rig)
        rows = self._free_rows(free_poses)
        for gate in GATES_M:
            matrix = np.zeros((count, FREEDOMS, count, FREEDOMS))
            gradient = np.zeros((count, FREEDOMS))
            self._add_surfaces(matrix, gradient, current, gate)
            for constraint in constraints:
                block, slope = constraint(current.poses, current.offset)
                matrix[:, :6, :, :6] += block
                gradient[:, :6] += slope
            if timing is not None:
                matrix[:, OFFSET, :, OFFSET] += timing.information
                gradient[:, OFFSET] += timing.information @ current.offset - timing.vector
            self._add_prior(matrix, gradient, current, start)
            step = np.zeros(count * FREEDOMS)
            system = matrix.reshape(count * FREEDOMS, -1)[np.ix_(rows, rows)]
            step[rows] = -np.linalg.solve(system, gradient.ravel()[rows])
            current = _stepped(current, step.reshape(count, FREEDOMS))
        covariance = np.zeros((count * FREEDOMS, count * FREEDOMS))
        covariance[np.ix_(rows, rows)] = np.linalg.inv(system)
        last = np.abs(step.reshape(count, FREEDOMS))
        moved = LEVER_M * last[:, ROTATION].max(1) + last[:, TRANSLATION].max(1)
        return Solution(
            current, covariance.reshape(count, FREEDOMS, count, FREEDOMS), float(moved.max())
        )

    def residuals(self, at: Estimate, kind: Kind) -> PairResiduals:
        """Median |point to plane| of every pair of cameras over the held-out points."""
        by_pair: dict[tuple[int, int], list[np.ndarray]] = {}
        for (of, a, b), layers in self._sought.items():
            if of == kind:
                found = [self._match(a, b, s, s.held_out, at, SEARCH_M) for s in layers]
                distances = np.abs(_Match.joined(found).residual)
                by_pair.setdefault((min(a, b), max(a, b)), []).append(distances)
        values = {k: np.concatenate(v) for k, v in sorted(by_pair.items())}
        values = {k: v for k, v in values.items() if len(v) >= MIN_PAIR_POINTS / HELD_OUT_EVERY}
        return PairResiduals(
            pairs=np.array(list(values), np.int32).reshape(-1, 2),
            count=np.array([len(v) for v in values.values()], np.int64),
            median=np.array([np.median(v) for v in values.values()], np.float64),
        )

    def _match(
        self, a: int, b: int, sought: _Sought, queries: Surface, at: Estimate, gate: float
    ) -> _Match:
        """Correspondences within reach of camera a's ``queries`` on camera b's surface."""
        source, target = (at.poses[c] @ self._colour_from_depth(c) for c in (a, b))
        other = sought.target
        points = apply(source, queries.points - at.bias[a] * queries.rays)
        # The tree holds the target's points as measured: its bias is undone for the search.
        in_target = apply(invert(target), points)
        depth = np.maximum(in_target[:, 2:], 0.1)
        distance, nearest = sought.tree.query(
            in_target * (1 + at.bias[b] / depth), distance_upper_bound=SEARCH_M
        )
        hit = np.flatnonzero(np.isfinite(distance))
        nearest, points = nearest[hit], points[hit]
        normals = other.normals[nearest] @ target[:3, :3].T
        own_normals = queries.normals[hit] @ source[:3, :3].T
        on_target = apply(target, other.points[nearest] - at.bias[b] * other.rays[nearest])
        speed = (queries.speed[hit] + other.speed[nearest]) / 2
        good = (normals * own_normals).sum(1) >= MIN_AGREE_COSINE
        # The mean normal: two points of one circle are then at distance 0, however far apart
        # (Rusinkiewicz, A symmetric objective function for ICP, 2019).
        normals = normals + own_normals
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        residual = (normals * (points - on_target)).sum(1)
        residual = residual - (at.offset[a] - at.offset[b]) * speed
        good &= np.abs(residual) <= gate
        return _Match(
            residual[good],
            points[good],
            normals[good],
            queries.rays[hit[good]] @ source[:3, :3].T,
            other.rays[nearest[good]] @ target[:3, :3].T,
            speed[good],
        )

    def _colour_from_depth(self, camera: int) -> np.ndarray:
        between = self.rig[camera].colour_from_depth
        assert between is not None
        return between

    def _add_surfaces(
        self, matrix: np.ndarray, gradient: np.ndarray, at: Estimate, gate: float
    ) -> None:
        for (kind, a, b), forth in self._sought.items():
            if a > b:
                continue
            back = self._sought[kind, b, a]
            found = [
                _Match.joined([self._match(i, j, s, s.queries, at, gate) for s in layers])
                for i, j, layers in ((a, b, forth), (b, a, back))
            ]
            residual = np.concatenate([match.residual for match in found])
            if len(residual) < 2 * MIN_PAIR_POINTS:
                continue
            (first_a, first_b), (second_b, second_a) = (
                _derivatives(found[0], at, a, b),
                _derivatives(found[1], at, b, a),
            )
            rows = np.stack([np.vstack([first_a, second_a]), np.vstack([first_b, second_b])])
            weight = (1 - np.minimum(np.abs(residual) / gate, 1) ** 2) ** 2  # Tukey's biweight
            if kind.rounded:
                share = weight / max(weight.sum(), 1e-9)
                residual = residual - share @ residual
                rows = rows - np.einsum("n,knf->kf", share, rows)[:, None]
            sigma = max(SIGMA_FLOOR_M, 1.4826 * float(np.median(np.abs(residual))))
            weight /= sigma**2 * max(1.0, len(residual) / (2 * kind.effective_points))
            weighted = rows * weight[:, None]
            gradient[[a, b]] += np.einsum("knf,n->kf", weighted, residual)
            matrix[np.ix_([a, b], range(FREEDOMS), [a, b], range(FREEDOMS))] += np.einsum(
                "knf,lng->kflg", weighted, rows, optimize=True
            )

    def _add_prior(
        self, matrix: np.ndarray, gradient: np.ndarray, at: Estimate, start: Estimate
    ) -> None:
        precision = np.r_[
            np.full(3, PRIOR_ROTATION_RAD**-2.0),
            np.full(3, PRIOR_TRANSLATION_M**-2.0),
            PRIOR_BIAS_M**-2.0,
            PRIOR_OFFSET_S**-2.0,
        ]
        for c in range(len(self.rig)):
            turned = at.poses[c, :3, :3] @ start.poses[c, :3, :3].T
            away = np.r_[
                Rotation.from_matrix(turned).as_rotvec(),
                at.poses[c, :3, 3] - start.poses[c, :3, 3],
                at.bias[c],
                at.offset[c],
            ]
            matrix[c, :, c] += np.diag(precision)
            gradient[c] += precision * away

    def _free_rows(self, free_poses: bool) -> np.ndarray:
        free = np.ones((len(self.rig), FREEDOMS), bool)
        free[:, :6] = free_poses
        free[self._master] = False
        free[self._master, BIAS] = True
        return np.flatnonzero(free.ravel())


def _derivatives(m: _Match, at: Estimate, a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives (n, 8) of r = n . (p - q) - (offset_a - offset_b) speed by the cameras' freedoms.

    Turning the target about its centre moves n and q: together that is minus the source's
    derivative, taken at p with the target's centre.
    """
    centres = at.poses[:, :3, 3]

    def rows(centre: np.ndarray, ray: np.ndarray) -> np.ndarray:
        turning = np.cross(m.points - centre, m.normals)
        return np.column_stack([turning, m.normals, -(m.normals * ray).sum(1), -m.speed])

    return rows(centres[a], m.own_ray), -rows(centres[b], m.other_ray)


def _stepped(at: Estimate, step: np.ndarray) -> Estimate:
    poses = at.poses.copy()
    poses[:, :3, :3] = Rotation.from_rotvec(step[:, ROTATION]).as_matrix() @ poses[:, :3, :3]
    poses[:, :3, 3] += step[:, TRANSLATION]
    return Estimate(poses, at.bias + step[:, BIAS], at.offset + step[:, OFFSET])


def _split(surface: Surface, queries: int) -> tuple[Surface, Surface]:
    """Queries and held-out points: every fourth cell is held out, both thinned evenly."""
    order = np.random.default_rng(0).permutation(len(surface))
    held_out = order[::HELD_OUT_EVERY][: max(1, queries // HELD_OUT_EVERY)]
    rest = np.delete(order, np.s_[::HELD_OUT_EVERY])[:queries]
    return surface.subset(rest), surface.subset(held_out)
