"""Joint registration of all cameras of a rig on the surfaces that several of them see.

One robust Gauss-Newton problem (point-to-plane ICP over all pairs at once). Residuals: distances
between the surfaces of every overlapping pair. Unknowns of each camera: rotation, translation,
depth bias and time offset; pose and time of the master are fixed, and a weak prior holds the start.
Further terms on the poses (:mod:`.constraints`) are passed in: a bare floor alone leaves three
degrees of freedom undetermined. Moving surfaces also observe the exposure times.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.solve.robust import SIGMA_PER_MAD
from intercap_core.scene.starts import PRIOR_OFFSET_S
from intercap_core.scene.surfaces import DepthSurface

SURFACE_SIGMA_FLOOR_M = 0.003  # of point-to-plane residuals; tuned on the studio
PRIOR_TRANSLATION_M = 0.01  # error of a careful calibration; tuned on the studio
PRIOR_ROTATION_RAD = np.radians(0.5)  # error of a careful calibration; tuned on the studio
HELD_OUT_EVERY = 4  # cells of a surface for each that is held out; untuned
SURFACE_SEARCH_M = 0.12  # to the nearest cell, beyond the widest gate; tuned on the studio
MAX_DIRECTION_SHARE = 0.8  # of a pair's weight, for one direction of normals; tuned on the studio
MAX_DIRECTION_GAIN = 3.0  # factor of the weight of other directions; tuned on the studio
MIN_PAIR_POINTS = 60  # fewer correspondences are chance; tuned on the studio


def balance_directions(weight: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Rescale weights (N,) of points with unit normals (N, 3) so that no direction dominates.

    One direction keeps at most ``MAX_DIRECTION_SHARE`` of the total, which is unchanged. The others
    grow at most by ``MAX_DIRECTION_GAIN``: specks at the edge of a bare floor are no wall.
    """
    total = weight.sum()
    inside = np.ones(len(weight), bool)
    for _ in range(3):  # until the mean of the dominant direction is stable
        mean = weight[inside] @ normals[inside]
        inside = normals @ mean >= 0.94 * np.linalg.norm(mean)  # 20 degrees
    share = weight[inside].sum() / max(total, 1e-9)
    if share <= MAX_DIRECTION_SHARE or share >= 1:
        return weight
    gain = min(MAX_DIRECTION_GAIN, (1 - MAX_DIRECTION_SHARE) / (1 - share))
    return weight * np.where(inside, (1 - (1 - share) * gain) / share, gain)


# Unknowns of a camera: rotation 0:3, translation 3:6, depth bias, time offset
BIAS = 6
OFFSET = 7
FREEDOMS = 8

# Adds a group's normal equations: (poses (C, 4, 4), offset (C,)) -> matrix (C, 6, C, 6), gradient
# (C, 6) of rotation and translation
Constraint = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class SurfaceKind:
    """How surfaces of one kind, background or foreground, enter the registration."""

    effective_points: float
    """Independent measurements of a pair of cameras, each way, at most. Neighbouring residuals are
    correlated (lens, multipath, bias)."""
    rounded: bool
    """Two cameras see different flanks of such a surface. The points of one lie off the tangent
    planes of the other by a constant which is no misalignment, so each pair's weighted mean
    residual is subtracted."""


# Numbers of points tuned on the studio; moving surfaces are seen at many moments and places.
STATIC = SurfaceKind(effective_points=10.0, rounded=False)
MOVING = SurfaceKind(effective_points=50.0, rounded=True)

Layers = Mapping[SurfaceKind, Sequence[dict[int, DepthSurface]]]
"""By kind, the surfaces of each moment by camera index, in the depth camera's frame."""


@dataclass
class RigEstimate:
    """Unknowns of the registration."""

    poses: np.ndarray
    """(C, 4, 4) master_from_colour."""
    bias: np.ndarray
    """(C,) metres to subtract from depth."""
    offset: np.ndarray
    """(C,) seconds by which each camera exposes after the set's time."""

    @classmethod
    def start(cls, rig: Rig, offset: np.ndarray | None = None) -> RigEstimate:
        """The rig as given, exposing ``offset`` (C,) s late."""
        none = np.zeros(len(rig))
        late = none.copy() if offset is None else offset.copy()
        return cls(rig.master_from_colour.copy(), none, late)


@dataclass(frozen=True)
class RigSolution:
    """Result of the registration."""

    estimate: RigEstimate
    """Poses, biases and offsets."""
    covariance: np.ndarray
    """(C, 8, C, 8) of rotation about the camera's centre, translation, bias, offset; 0 = fixed."""
    last_step_m: float
    """Displacement of a viewed point by the last step, metres."""


@dataclass(frozen=True)
class _Seen:
    """Surfaces of one kind of one camera at all moments, with a search tree."""

    surface: DepthSurface
    """All points."""
    moment: np.ndarray
    """(N,) fourth coordinate in the search tree, which separates the moments."""
    tree: cKDTree
    """Of points and moments."""
    queries: np.ndarray
    """Rows that are matched with other cameras."""
    held_out: np.ndarray
    """Rows that are matched for evaluation only."""

    @classmethod
    def of(cls, surfaces: Sequence[tuple[int, DepthSurface]]) -> _Seen:
        """Join ``surfaces`` by moment; at most 2500 points are matched, and 625 held out."""
        surface = DepthSurface.joined([surface for _, surface in surfaces])
        # 10 m: beyond any search radius
        moment = np.repeat([10.0 * at for at, _ in surfaces], [len(s) for _, s in surfaces])
        tree = cKDTree(np.column_stack([surface.points, moment]), balanced_tree=False)
        order = np.random.default_rng(0).permutation(len(surface))
        return cls(
            surface,
            moment,
            tree,
            np.delete(order, np.s_[::HELD_OUT_EVERY])[:2500],
            order[::HELD_OUT_EVERY][: 2500 // HELD_OUT_EVERY],
        )


@dataclass(frozen=True)
class _Match:
    """Correspondences of one camera's points with another's surface, master frame."""

    residual: np.ndarray
    """(n,) distance to the plane, metres."""
    points: np.ndarray
    """(n, 3) metres."""
    normals: np.ndarray
    """(n, 3) unit."""
    own_ray: np.ndarray
    """(n, 3) displacement of the point per metre of its own depth."""
    other_ray: np.ndarray
    """(n, 3) the same for the target."""
    speed: np.ndarray
    """(n,) m/s along the normal."""


class Registration:
    """Estimates a rig from surfaces; the pose and time of the master are fixed."""

    def __init__(
        self, rig: Rig, layers: Layers, master: int, offset_sigma: np.ndarray | None = None
    ) -> None:
        """
        Args:
            rig: cameras as given.
            layers: surfaces by kind and moment.
            master: index of the master.
            offset_sigma: (C,) prior standard deviation of the given offsets, seconds; None = that
                of synchronised devices.
        """
        self.rig = rig
        self._offset_sigma = (
            np.full(len(rig), PRIOR_OFFSET_S) if offset_sigma is None else offset_sigma
        )
        self._master = master
        self._seen: dict[SurfaceKind, dict[int, _Seen]] = {}
        for kind, moments in layers.items():
            by_camera: dict[int, list[tuple[int, DepthSurface]]] = {}
            for moment, surfaces in enumerate(moments):
                for camera, surface in surfaces.items():
                    if len(surface):
                        by_camera.setdefault(camera, []).append((moment, surface))
            self._seen[kind] = {c: _Seen.of(own) for c, own in sorted(by_camera.items())}

    def solve(
        self,
        start: RigEstimate,
        constraints: Sequence[Constraint] = (),
        timing: tuple[np.ndarray, np.ndarray] | None = None,
        *,
        free_poses: bool | np.ndarray = True,
    ) -> RigSolution:
        """Refine ``start``.

        Args:
            start: first estimate, and mean of the prior.
            constraints: further normal equations of the poses.
            timing: normal equations of the offsets from the keypoints: matrix (C, C), 1/s^2, and
                vector (C,), 1/s.
            free_poses: whether poses are estimated, for all cameras or by camera (C,).
        """
        current = RigEstimate(start.poses.copy(), start.bias.copy(), start.offset.copy())
        count = len(self.rig)
        free = np.ones((count, FREEDOMS), bool)
        free[:, :6] = np.broadcast_to(free_poses, count)[:, None]
        free[self._master] = False
        free[self._master, BIAS] = True
        rows = np.flatnonzero(free.ravel())
        # gates on the distance to the plane, metres, one an iteration; tuned on the studio
        gates = (0.08, 0.05, 0.03, 0.02, 0.015, 0.015, 0.015)
        for gate in gates if np.any(free_poses) else (0.08, 0.04, 0.04):
            matrix = np.zeros((count, FREEDOMS, count, FREEDOMS))
            gradient = np.zeros((count, FREEDOMS))
            self._add_surfaces(matrix, gradient, current, gate)
            for constraint in constraints:
                block, slope = constraint(current.poses, current.offset)
                matrix[:, :6, :, :6] += block
                gradient[:, :6] += slope
            if timing is not None:
                information, vector = timing
                matrix[:, OFFSET, :, OFFSET] += information
                gradient[:, OFFSET] += information @ current.offset - vector
            self._add_prior(matrix, gradient, current, start)
            step = np.zeros(count * FREEDOMS)
            system = matrix.reshape(count * FREEDOMS, -1)[np.ix_(rows, rows)]
            step[rows] = -np.linalg.solve(system, gradient.ravel()[rows])
            current = _stepped(current, step.reshape(count, FREEDOMS))
        covariance = np.zeros((count * FREEDOMS, count * FREEDOMS))
        covariance[np.ix_(rows, rows)] = np.linalg.inv(system)
        last = np.abs(step.reshape(count, FREEDOMS))
        # In a ring, a camera is about 2.5 m from the scene.
        moved = 2.5 * last[:, :3].max(1) + last[:, 3:6].max(1)
        return RigSolution(
            current, covariance.reshape(count, FREEDOMS, count, FREEDOMS), float(moved.max())
        )

    def residuals(
        self, at: RigEstimate, kind: SurfaceKind, camera: int | None = None
    ) -> dict[tuple[int, int], np.ndarray]:
        """Distances (n,) of held-out points to the other surface, metres, by pair of cameras.

        Only the pairs with ``camera``, if given.
        """
        result = {}
        for a, b in combinations(self._seen.get(kind, {}), 2):
            if camera is not None and camera not in (a, b):
                continue
            ways = (
                self._match(kind, *way, at, SURFACE_SEARCH_M, held_out=True)
                for way in ((a, b), (b, a))
            )
            distances = np.concatenate([np.abs(match.residual) for match in ways])
            if len(distances) >= MIN_PAIR_POINTS / HELD_OUT_EVERY:
                result[a, b] = distances
        return result

    def median_residuals(
        self, at: RigEstimate, kind: SurfaceKind, camera: int | None = None
    ) -> dict[tuple[int, int], float]:
        """Medians of :meth:`residuals`."""
        residuals = self.residuals(at, kind, camera)
        return {pair: float(np.median(distances)) for pair, distances in residuals.items()}

    def _match(
        self,
        kind: SurfaceKind,
        a: int,
        b: int,
        at: RigEstimate,
        gate: float,
        *,
        held_out: bool = False,
    ) -> _Match:
        """Correspondences within reach of camera a's points on camera b's surface."""
        source, target = (self.rig[c].moved(at.poses[c]).master_from_depth for c in (a, b))
        own, other = self._seen[kind][a], self._seen[kind][b]
        rows = own.held_out if held_out else own.queries
        queries, surface = own.surface.subset(rows), other.surface
        points = apply(source, queries.points - at.bias[a] * queries.rays)
        # The tree holds the target's points as measured: its bias is undone for the search.
        in_target = apply(invert(target), points)
        depth = np.maximum(in_target[:, 2:], 0.1)
        sought = np.column_stack([in_target * (1 + at.bias[b] / depth), own.moment[rows]])
        distance, nearest = other.tree.query(sought, distance_upper_bound=SURFACE_SEARCH_M)
        hit = np.flatnonzero(np.isfinite(distance))
        nearest, points = nearest[hit], points[hit]
        normals = surface.normals[nearest] @ target[:3, :3].T
        own_normals = queries.normals[hit] @ source[:3, :3].T
        on_target = apply(target, surface.points[nearest] - at.bias[b] * surface.rays[nearest])
        speed = (queries.speed[hit] + surface.speed[nearest]) / 2
        good = (normals * own_normals).sum(1) >= 0.85  # 32 degrees; tuned on the studio
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
            surface.rays[nearest[good]] @ target[:3, :3].T,
            speed[good],
        )

    def _add_surfaces(
        self, matrix: np.ndarray, gradient: np.ndarray, at: RigEstimate, gate: float
    ) -> None:
        pairs = [
            (kind, *pair) for kind, seen in self._seen.items() for pair in combinations(seen, 2)
        ]
        for kind, a, b in pairs:
            forth, back = self._match(kind, a, b, at, gate), self._match(kind, b, a, at, gate)
            residual = np.concatenate([forth.residual, back.residual])
            if len(residual) < 2 * MIN_PAIR_POINTS:
                continue
            first_a, first_b = _derivatives(forth, at, a, b)
            second_b, second_a = _derivatives(back, at, b, a)
            rows = np.stack([np.vstack([first_a, second_a]), np.vstack([first_b, second_b])])
            weight = (1 - np.minimum(np.abs(residual) / gate, 1) ** 2) ** 2  # Tukey's biweight
            if kind.rounded:
                share = weight / max(weight.sum(), 1e-9)
                residual = residual - share @ residual
                rows = rows - np.einsum("n,knf->kf", share, rows)[:, None]
            else:
                weight = balance_directions(weight, np.concatenate([forth.normals, back.normals]))
            sigma = max(SURFACE_SIGMA_FLOOR_M, SIGMA_PER_MAD * float(np.median(np.abs(residual))))
            weight /= sigma**2 * max(1.0, len(residual) / (2 * kind.effective_points))
            weighted = rows * weight[:, None]
            gradient[[a, b]] += np.einsum("knf,n->kf", weighted, residual)
            matrix[np.ix_([a, b], range(FREEDOMS), [a, b], range(FREEDOMS))] += np.einsum(
                "knf,lng->kflg", weighted, rows, optimize=True
            )

    def _add_prior(
        self, matrix: np.ndarray, gradient: np.ndarray, at: RigEstimate, start: RigEstimate
    ) -> None:
        precision = np.r_[
            np.full(3, PRIOR_ROTATION_RAD**-2.0),
            np.full(3, PRIOR_TRANSLATION_M**-2.0),
            # the systematic depth error is at most 11 mm + 0.1 % (Azure Kinect DK data sheet)
            0.003**-2.0,
            0.0,
        ]
        for c in range(len(self.rig)):
            precision[OFFSET] = self._offset_sigma[c] ** -2.0
            turned = at.poses[c, :3, :3] @ start.poses[c, :3, :3].T
            away = np.r_[
                Rotation.from_matrix(turned).as_rotvec(),
                at.poses[c, :3, 3] - start.poses[c, :3, 3],
                at.bias[c],
                at.offset[c] - start.offset[c],
            ]
            matrix[c, :, c] += np.diag(precision)
            gradient[c] += precision * away


def _derivatives(m: _Match, at: RigEstimate, a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives (n, 8) of r = n . (p - q) - (offset_a - offset_b) speed by the cameras' unknowns.

    Turning the target about its centre moves n and q: together that is minus the source's
    derivative, taken at p with the target's centre.
    """
    centres = at.poses[:, :3, 3]

    def rows(centre: np.ndarray, ray: np.ndarray) -> np.ndarray:
        turning = np.cross(m.points - centre, m.normals)
        return np.column_stack([turning, m.normals, -(m.normals * ray).sum(1), -m.speed])

    return rows(centres[a], m.own_ray), -rows(centres[b], m.other_ray)


def _stepped(at: RigEstimate, step: np.ndarray) -> RigEstimate:
    poses = at.poses.copy()
    poses[:, :3, :3] = Rotation.from_rotvec(step[:, :3]).as_matrix() @ poses[:, :3, :3]
    poses[:, :3, 3] += step[:, 3:6]
    return RigEstimate(poses, at.bias + step[:, BIAS], at.offset + step[:, OFFSET])
