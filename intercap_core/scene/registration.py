"""Joint registration of all cameras of a rig on the surfaces that several of them see.

Point-to-plane ICP over all pairs of cameras at once, solved by robust Gauss-Newton iterations.

- Residuals: distances between the surfaces of every overlapping pair, along the surface normal.
- Unknowns of each camera: rotation, translation, depth bias and time offset. Pose and time of the
  master are fixed. A weak prior keeps the others near the start.
- Moving surfaces also determine the time offsets, through their speed.
- Further terms on the poses (:mod:`.constraints`) are passed in, because surfaces alone may not
  suffice: a bare floor leaves three degrees of freedom undetermined.

A quarter of the points is held out: the fit does not match them, and they serve to compare poses.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.solve.robust import SIGMA_PER_MAD
from intercap_core.scene.surfaces import DepthSurface, NearestPoints, balance_directions

# Smallest standard deviation assumed for point-to-plane residuals; tuned on the studio.
SURFACE_SIGMA_FLOOR_M = 0.003
PRIOR_TRANSLATION_M = 0.01  # error of a careful calibration; tuned on the studio
PRIOR_ROTATION_RAD = np.radians(0.5)  # error of a careful calibration; tuned on the studio
# Largest distance of a point to the nearest point of the other surface: 1.5 times the widest gate.
# Tuned on the studio.
SURFACE_SEARCH_M = 0.12

# Unknowns of a camera: 0:3 rotation vector about the camera's centre, applied on the left, rad;
# 3:6 translation, metres; 6 depth bias, metres; 7 time offset, seconds
BIAS = 6
OFFSET = 7
FREEDOMS = 8

# Returns the normal equations of further residuals at poses (C, 4, 4) and time offsets (C,): matrix
# (C, 6, C, 6) and gradient (C, 6) of rotation and translation
Constraint = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class SurfaceKind:
    """How surfaces of one kind, background or foreground, enter the registration."""

    effective_points: float
    """Largest number of independent measurements that the points of one camera on another count
    for. Neighbouring residuals are correlated (lens, multipath, bias)."""
    rounded: bool
    """Subtract each pair's weighted mean residual. Two cameras see different sides of a rounded
    body; the points of one lie off the tangent planes of the other even with correct poses."""


# Numbers of points tuned on the studio; moving surfaces are seen at many moments and places.
STATIC = SurfaceKind(effective_points=10.0, rounded=False)
MOVING = SurfaceKind(effective_points=50.0, rounded=True)

Layers = Mapping[SurfaceKind, Sequence[dict[int, DepthSurface]]]
"""Surfaces by kind: a list over moments of dictionaries by camera index, depth camera's frame."""


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
        """The given poses, no bias, and ``offset`` (C,) seconds; None = 0."""
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
    """Largest displacement of a point 2.5 m from its camera by the last iteration, metres."""


@dataclass(frozen=True)
class _Seen:
    """Surfaces of one kind of one camera at all moments, with a search structure."""

    surface: DepthSurface
    """All N points."""
    nearest: NearestPoints
    """Search among the points; its layers are the moments."""
    queries: tuple[DepthSurface, np.ndarray]
    """Points that are matched for the fit, and their moments."""
    held_out: tuple[DepthSurface, np.ndarray]
    """The same for points that are matched for evaluation only."""

    @classmethod
    def of(cls, surfaces: Sequence[tuple[int, DepthSurface]]) -> _Seen:
        """Join (moment, surface) pairs.

        A random quarter of the points is held out. At most 2500 points are matched for the fit and
        625 are held out, which bounds the run time. Both stay in the order of the surface, because
        successive searches are faster for neighbouring points.
        """
        surface = DepthSurface.joined([surface for _, surface in surfaces])
        moment = np.repeat([at for at, _ in surfaces], [len(s) for _, s in surfaces])
        nearest = NearestPoints(surface.points, moment, SURFACE_SEARCH_M)
        order = np.random.default_rng(0).permutation(len(surface))
        queries, held_out = (
            (surface.subset(rows), moment[rows])
            for rows in (np.sort(np.delete(order, np.s_[::4])[:2500]), np.sort(order[::4][:625]))
        )
        return cls(surface, nearest, queries, held_out)


@dataclass(frozen=True)
class _Match:
    """Correspondences of one camera's points with another's surface, master frame."""

    residual: np.ndarray
    """(n,) signed distance to the plane, corrected for motion between the exposures, metres."""
    points: np.ndarray
    """(n, 3) metres."""
    normals: np.ndarray
    """(n, 3) unit."""
    own_ray: np.ndarray
    """(n, 3) displacement of the point per metre of its own depth."""
    other_ray: np.ndarray
    """(n, 3) displacement of the matched point per metre of the other camera's depth."""
    speed: np.ndarray
    """(n,) speed of the surface along the normal, m/s."""


class Registration:
    """Estimates a rig from surfaces; the pose and time of the master are fixed."""

    def __init__(
        self,
        rig: Rig,
        layers: Layers,
        master: int,
        offset_sigma: np.ndarray | None = None,
        prior: tuple[float, float] = (PRIOR_ROTATION_RAD, PRIOR_TRANSLATION_M),
    ) -> None:
        """
        Args:
            rig: cameras as given.
            layers: surfaces by kind and moment.
            master: index of the master.
            offset_sigma: (C,) prior standard deviation of the given offsets, seconds; None = 1 s,
                practically no prior.
            prior: standard deviations of the start's rotations, rad, and translations, metres.
        """
        self.rig = rig
        # the depth bias deviates by 3 mm, about a quarter of the largest systematic error, 11 mm +
        # 0.1 % of depth (Azure Kinect DK data sheet)
        diagonal = np.r_[np.repeat(np.square(prior), 3) ** -1.0, 0.003**-2.0]
        precision = np.diag(np.tile(diagonal, len(rig))).reshape(len(rig), 7, len(rig), 7)
        self.prior_precision = precision  # of the start
        self._offset_sigma = np.ones(len(rig)) if offset_sigma is None else offset_sigma
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
            free_poses: whether poses are estimated, one bool for all cameras or a mask (C,).
        """
        current = RigEstimate(start.poses.copy(), start.bias.copy(), start.offset.copy())
        count = len(self.rig)
        free = np.ones((count, FREEDOMS), bool)
        free[:, :6] = np.broadcast_to(free_poses, count)[:, None]
        free[self._master] = False
        free[self._master, BIAS] = True
        rows = np.flatnonzero(free.ravel())
        # Largest distance of a match to the plane, metres, in each iteration; tuned on the studio.
        # Three iterations suffice if all poses are fixed.
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
            change = step.reshape(count, FREEDOMS)
            turn = Rotation.from_rotvec(change[:, :3]).as_matrix()
            current.poses[:, :3, :3] = turn @ current.poses[:, :3, :3]
            current.poses[:, :3, 3] += change[:, 3:6]
            current.bias = current.bias + change[:, BIAS]
            current.offset = current.offset + change[:, OFFSET]
        covariance = np.zeros((count * FREEDOMS, count * FREEDOMS))
        covariance[np.ix_(rows, rows)] = np.linalg.inv(system)
        last = np.abs(change)
        # points are about 2.5 m from the cameras of a ring
        moved = 2.5 * last[:, :3].max(1) + last[:, 3:6].max(1)
        return RigSolution(
            current, covariance.reshape(count, FREEDOMS, count, FREEDOMS), float(moved.max())
        )

    def residuals(
        self, at: RigEstimate, kind: SurfaceKind, camera: int | None = None
    ) -> dict[tuple[int, int], np.ndarray]:
        """Absolute distances (n,) of held-out points to the other surface, metres, by camera pair.

        ``camera``: only pairs with this camera; None = all pairs. Pairs with fewer than 15
        correspondences are left out.
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
            if len(distances) >= 15:
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
        """Match the points of camera a with the nearest points of camera b.

        A match needs normals within 32 degrees and a residual of at most ``gate``, metres.
        """
        source, target = (self.rig[c].moved(at.poses[c]).master_from_depth for c in (a, b))
        own, other = self._seen[kind][a], self._seen[kind][b]
        (queries, moment), surface = own.held_out if held_out else own.queries, other.surface
        points = apply(source, queries.points - at.bias[a] * queries.rays)
        # b's points are searched with their depth bias, so the query points get the same bias
        in_target = apply(invert(target), points)
        depth = np.maximum(in_target[:, 2:], 0.1)
        nearest = other.nearest.query(in_target * (1 + at.bias[b] / depth), moment)
        hit = np.flatnonzero(nearest >= 0)
        queries, matched, points = queries.subset(hit), surface.subset(nearest[hit]), points[hit]
        normals = matched.normals @ target[:3, :3].T
        own_normals = queries.normals @ source[:3, :3].T
        on_target = apply(target, matched.points - at.bias[b] * matched.rays)
        speed = (queries.speed + matched.speed) / 2
        good = _dot(normals, own_normals) >= 0.85  # 32 degrees; tuned on the studio
        # Mean of both normals: the residual of two points on one circle is then 0 (Rusinkiewicz, A
        # symmetric objective function for ICP, 2019).
        normals = normals + own_normals
        normals /= np.maximum(np.sqrt(_dot(normals, normals)), 1e-9)[:, None]
        residual = _dot(normals, points - on_target)
        residual = residual - (at.offset[a] - at.offset[b]) * speed
        good &= np.abs(residual) <= gate
        return _Match(
            residual[good],
            points[good],
            normals[good],
            queries.rays[good] @ source[:3, :3].T,
            matched.rays[good] @ target[:3, :3].T,
            speed[good],
        )

    def _add_surfaces(
        self, matrix: np.ndarray, gradient: np.ndarray, at: RigEstimate, gate: float
    ) -> None:
        """Add the residuals of all pairs and kinds to the normal equations, in place."""
        pairs = [
            (kind, *pair) for kind, seen in self._seen.items() for pair in combinations(seen, 2)
        ]
        for kind, a, b in pairs:
            forth, back = self._match(kind, a, b, at, gate), self._match(kind, b, a, at, gate)
            residual = np.concatenate([forth.residual, back.residual])
            if len(residual) < 120:  # a pair without overlap has a few chance matches
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
        """Add the prior around ``start`` to the normal equations, in place."""
        away = np.column_stack([pose_differences(at.poses, start.poses), at.bias - start.bias])
        matrix[:, :OFFSET, :, :OFFSET] += self.prior_precision
        gradient[:, :OFFSET] += np.einsum("cfdg,dg->cf", self.prior_precision, away)
        every, precision = np.arange(len(self.rig)), self._offset_sigma**-2.0
        matrix[every, OFFSET, every, OFFSET] += precision
        gradient[:, OFFSET] += precision * (at.offset - start.offset)


def pose_differences(poses: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Rotation vectors, rad, and translations, metres, (C, 6) from ``start`` to ``poses``."""
    turned = poses[:, :3, :3] @ start[:, :3, :3].transpose(0, 2, 1)
    return np.hstack([Rotation.from_matrix(turned).as_rotvec(), poses[:, :3, 3] - start[:, :3, 3]])


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products (N,) of the vectors ``a`` and ``b`` (N, 3); faster than a sum over rows of three."""
    return np.einsum("ni,ni->n", a, b)


def _derivatives(m: _Match, at: RigEstimate, a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives (n, 8) of the residuals by the unknowns of camera a, and of camera b.

    The residual is r = n . (p - q) - (offset_a - offset_b) * speed for a point p of camera a, a
    point q of camera b and a normal n. A rotation of camera b moves both q and n. Its derivative is
    that of camera a with opposite sign, if the lever arm is p minus the centre of b.
    """
    centres = at.poses[:, :3, 3]

    def rows(centre: np.ndarray, ray: np.ndarray) -> np.ndarray:
        turning = np.cross(m.points - centre, m.normals)
        return np.column_stack([turning, m.normals, -_dot(m.normals, ray), -m.speed])

    return rows(centres[a], m.own_ray), -rows(centres[b], m.other_ray)
