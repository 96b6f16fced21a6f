"""All cameras of a rig brought together on the surfaces that several of them see.

Point-to-plane residuals of every overlapping pair and every camera's motion in one robust
Gauss-Newton problem, with the master fixed, a weak prior on the start, and body keypoints as
further constraints (:mod:`.body_constraints`): a bare floor alone leaves three motions free.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from intercap_core.camera.rig import Rig
from intercap_core.camera.transforms import apply, invert
from intercap_core.scene.surface import Surface

MIN_AGREE_COSINE = 0.85  # normals of one surface, seen by two cameras
MIN_PAIR_POINTS = 60  # fewer correspondences are chance
PAIR_QUERIES = 2500  # points of one camera sought in another one
HELD_OUT_EVERY = 4  # of each surface's cells
GATES_M = (0.08, 0.05, 0.03, 0.02, 0.02, 0.015, 0.015, 0.015)  # distance to the plane, annealed
SEARCH_M = 0.12  # distance to the nearest cell
# Neighbouring residuals err together (lens, multipath, bias), so a pair never counts as more than
# this many independent measurements of this standard deviation.
EFFECTIVE_POINTS = 30.0
SIGMA_FLOOR_M = 0.003
# Weak prior on the start: what a careful calibration is wrong by.
PRIOR_TRANSLATION_M = 0.01
PRIOR_ROTATION_RAD = np.radians(0.5)
PRIOR_BIAS_M = 0.003  # the depth's systematic error is up to 11 mm + 0.1 % (device data sheet)
FREEDOMS = 7  # rotation, translation, depth bias

# Adds a group's normal equations: (poses (C, 4, 4)) -> matrix (6C, 6C), gradient (6C,)
Constraint = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass
class Estimate:
    """Poses ``master_from_colour`` (C, 4, 4) and depth bias (C,), metres to subtract."""

    poses: np.ndarray
    bias: np.ndarray


@dataclass
class PairResiduals:
    """``pairs`` (P, 2); ``count`` (P,) held-out correspondences; ``median`` (P,) metres."""

    pairs: np.ndarray
    count: np.ndarray
    median: np.ndarray


@dataclass(frozen=True)
class _Pair:
    """``source``'s cells sought in ``target``'s surface; both are camera indices."""

    source: int
    target: int
    queries: Surface
    held_out: Surface


class Registration:
    """Holds the surfaces and their search trees; estimates poses of a rig from them.

    ``surfaces`` by camera index, in the depth camera's frame; ``master`` is the camera that stays.
    """

    def __init__(self, rig: Rig, surfaces: dict[int, Surface], master: int) -> None:
        self.rig = rig
        self._master = master
        self._surfaces = {c: surface for c, surface in sorted(surfaces.items()) if len(surface)}
        self._trees = {
            c: cKDTree(surface.points, balanced_tree=False) for c, surface in self._surfaces.items()
        }
        parts = {c: _split(surface) for c, surface in self._surfaces.items()}
        self._pairs = [_Pair(a, b, *parts[a]) for a in parts for b in parts if a != b]

    def solve(self, start: Estimate, constraints: list[Constraint]) -> Estimate:
        """Refine ``start``; ``constraints`` add normal equations of the poses."""
        current = Estimate(start.poses.copy(), start.bias.copy())
        count = len(self.rig)
        for gate in GATES_M:
            matrix = np.zeros((count, FREEDOMS, count, FREEDOMS))
            gradient = np.zeros((count, FREEDOMS))
            self._add_surfaces(matrix, gradient, current, gate)
            for constraint in constraints:
                block, slope = constraint(current.poses)
                matrix[:, :6, :, :6] += block.reshape(count, 6, count, 6)
                gradient[:, :6] += slope.reshape(count, 6)
            self._add_prior(matrix, gradient, current, start)
            current = self._stepped(current, matrix, gradient)
        return current

    def residuals(self, at: Estimate) -> PairResiduals:
        """Median |point to plane| of every pair of cameras over the held-out points."""
        by_pair: dict[tuple[int, int], list[np.ndarray]] = {}
        for pair in self._pairs:
            distances = self._correspond(pair, pair.held_out, at, SEARCH_M)[0]
            first, second = sorted((pair.source, pair.target))
            by_pair.setdefault((first, second), []).append(np.abs(distances))
        values = {k: np.concatenate(v) for k, v in sorted(by_pair.items())}
        values = {k: v for k, v in values.items() if len(v) >= MIN_PAIR_POINTS / HELD_OUT_EVERY}
        return PairResiduals(
            pairs=np.array(list(values), np.int32).reshape(-1, 2),
            count=np.array([len(v) for v in values.values()], np.int64),
            median=np.array([np.median(v) for v in values.values()], np.float64),
        )

    def _master_from_depth(self, at: Estimate, camera: int) -> np.ndarray:
        between = self.rig[camera].colour_from_depth
        assert between is not None
        return at.poses[camera] @ between

    def _correspond(
        self, pair: _Pair, queries: Surface, at: Estimate, gate: float
    ) -> tuple[np.ndarray, ...]:
        """Signed distances (n,) to the planes, points (n, 3), normals (n, 3), and the depth
        directions of both cameras (n, 3), all in the master frame, of correspondences in reach."""
        source = self._master_from_depth(at, pair.source)
        target = self._master_from_depth(at, pair.target)
        shifted = queries.points - at.bias[pair.source] * queries.rays
        points = apply(source, shifted)
        # The tree holds the target's points as measured: its bias is undone for the search.
        in_target = apply(invert(target), points)
        depth = np.maximum(in_target[:, 2:], 0.1)
        sought = in_target * (1 + at.bias[pair.target] / depth)
        distance, nearest = self._trees[pair.target].query(sought, distance_upper_bound=SEARCH_M)
        hit = np.isfinite(distance)
        nearest = np.where(hit, nearest, 0)
        other = self._surfaces[pair.target]
        normals = other.normals[nearest] @ target[:3, :3].T
        own_normals = queries.normals @ source[:3, :3].T
        on_target = apply(
            target, other.points[nearest] - at.bias[pair.target] * other.rays[nearest]
        )
        residual = (normals * (points - on_target)).sum(1)
        hit &= (normals * own_normals).sum(1) >= MIN_AGREE_COSINE
        hit &= np.abs(residual) <= gate
        own_ray = queries.rays @ source[:3, :3].T
        other_ray = other.rays[nearest] @ target[:3, :3].T
        return residual[hit], points[hit], normals[hit], own_ray[hit], other_ray[hit]

    def _add_surfaces(
        self, matrix: np.ndarray, gradient: np.ndarray, at: Estimate, gate: float
    ) -> None:
        centres = at.poses[:, :3, 3]
        for pair in self._pairs:
            residual, points, normals, own_ray, other_ray = self._correspond(
                pair, pair.queries, at, gate
            )
            if len(residual) < MIN_PAIR_POINTS:
                continue
            a, b = pair.source, pair.target
            sigma = max(SIGMA_FLOOR_M, 1.4826 * float(np.median(np.abs(residual))))
            weight = (1 - np.minimum(np.abs(residual) / gate, 1) ** 2) ** 2  # Tukey's biweight
            weight /= sigma**2 * max(1.0, len(residual) / EFFECTIVE_POINTS)
            # r = n . (p - q). Turning the target about its centre moves n and q: together that is
            # minus the source's derivative, taken at p with the target's centre.
            rows_a = np.column_stack(
                [np.cross(points - centres[a], normals), normals, -(normals * own_ray).sum(1)]
            )
            rows_b = np.column_stack(
                [-np.cross(points - centres[b], normals), -normals, (normals * other_ray).sum(1)]
            )
            for i, rows_i in ((a, rows_a), (b, rows_b)):
                weighted = rows_i * weight[:, None]
                gradient[i] += weighted.T @ residual
                for j, rows_j in ((a, rows_a), (b, rows_b)):
                    matrix[i, :, j] += weighted.T @ rows_j

    def _add_prior(
        self, matrix: np.ndarray, gradient: np.ndarray, at: Estimate, start: Estimate
    ) -> None:
        precision = np.r_[
            np.full(3, PRIOR_ROTATION_RAD**-2.0),
            np.full(3, PRIOR_TRANSLATION_M**-2.0),
            PRIOR_BIAS_M**-2.0,
        ]
        for c in range(len(self.rig)):
            turned = at.poses[c, :3, :3] @ start.poses[c, :3, :3].T
            offset = np.r_[
                Rotation.from_matrix(turned).as_rotvec(),
                at.poses[c, :3, 3] - start.poses[c, :3, 3],
                at.bias[c],
            ]
            matrix[c, :, c] += np.diag(precision)
            gradient[c] += precision * offset

    def _stepped(self, at: Estimate, matrix: np.ndarray, gradient: np.ndarray) -> Estimate:
        count = len(self.rig)
        free = np.ones((count, FREEDOMS), bool)
        free[self._master, :6] = False
        rows = np.flatnonzero(free.ravel())
        whole = matrix.reshape(count * FREEDOMS, -1)
        flat = np.zeros(count * FREEDOMS)
        flat[rows] = -np.linalg.solve(whole[np.ix_(rows, rows)], gradient.ravel()[rows])
        step = flat.reshape(count, FREEDOMS)
        poses = at.poses.copy()
        poses[:, :3, :3] = Rotation.from_rotvec(step[:, :3]).as_matrix() @ poses[:, :3, :3]
        poses[:, :3, 3] += step[:, 3:6]
        return Estimate(poses, at.bias + step[:, 6])


def _split(surface: Surface) -> tuple[Surface, Surface]:
    """Queries and held-out points: every fourth cell is held out, both thinned evenly."""
    order = np.random.default_rng(0).permutation(len(surface))
    held_out = order[::HELD_OUT_EVERY][: PAIR_QUERIES // HELD_OUT_EVERY]
    rest = np.delete(order, np.s_[::HELD_OUT_EVERY])[:PAIR_QUERIES]
    return surface.subset(rest), surface.subset(held_out)
