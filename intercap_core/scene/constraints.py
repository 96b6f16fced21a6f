"""Further terms of the registration of a rig: body keypoints and one common floor.

Each constraint returns the normal equations of its residuals with respect to the cameras' poses:
the matrix J' W J (C, 6, C, 6) and the gradient J' W r (C, 6). A pose has 6 parameters: rotation
vector about the camera's centre, applied on the left, rad, and translation of
``master_from_colour``, metres. The constraint's own unknowns (points of the body, the plane) are
eliminated by the Schur complement, so the camera system stays small.

- :class:`BodyConstraint`: bundle adjustment of the subject's keypoints.
- :class:`FloorConstraint`: all cameras see the same plane. It fixes height and tilt of cameras that
  see no common part of the floor.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

import numpy as np

from intercap_core.body.keypoints import NUM_KEYPOINTS
from intercap_core.geometry.camera import projection
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.solve.robust import geman_mcclure_weight
from intercap_core.person.sides import BODY_POINTS
from intercap_core.scene.ground import FLOOR_COSINE, GroundPlane
from intercap_core.scene.subject_views import SubjectViews
from intercap_core.scene.surfaces import DepthSurface

ROBUST_SIGMA = 3.0  # scale of Geman and McClure's function, standard deviations; tuned
KEYPOINT_ERROR_TIME_S = 0.5  # how long an error at one joint lasts; tuned on the studio


@dataclass(frozen=True, eq=False)
class BodyViews:
    """Body keypoints of the subject in all views. A point n is one joint in one set."""

    pixels: np.ndarray
    """(N, C, 2) detected pixels."""
    weights: np.ndarray
    """(N, C) weight of each detection; 0 = not seen or outlier. The confidence is multiplied by the
    interval of sets over :data:`KEYPOINT_ERROR_TIME_S`, because successive detections of one joint
    share an error."""
    points: np.ndarray
    """(N, 3) points triangulated at the given poses, metres."""
    velocity: np.ndarray
    """(N, 3) m/s, by central differences; 0 = unknown."""
    unit: np.ndarray
    """(N,) number of joint and time span: ``NUM_KEYPOINTS`` * span + keypoint index. Spans last
    :data:`KEYPOINT_ERROR_TIME_S`, so the points of one unit share one detector error."""

    @property
    def suffice(self) -> bool:
        """Whether the points constrain a rig: 50 or more, as two sets of the body have."""
        return len(self.points) >= 50

    def subset(self, rows: np.ndarray) -> BodyViews:
        """The points of a mask (N,)."""
        fields = (self.pixels, self.weights, self.points, self.velocity, self.unit)
        return BodyViews(*(field[rows] for field in fields))

    def halves(self) -> tuple[BodyViews, BodyViews]:
        """The points of the even time spans, and those of the odd ones."""
        odd = self.unit // NUM_KEYPOINTS % 2 == 1
        return self.subset(~odd), self.subset(odd)


def body_views(subject: SubjectViews, times: np.ndarray) -> BodyViews:
    """Keypoints of the body on which enough views agree. ``times``: (T,) seconds."""
    views = subject.keypoints.shape[1]
    by_point = np.swapaxes(subject.keypoints[:, :, BODY_POINTS], 1, 2).reshape(-1, views, 3)
    inlier = np.swapaxes(subject.inlier[:, :, BODY_POINTS], 1, 2).reshape(-1, views)
    points = subject.joints[:, BODY_POINTS].reshape(-1, 3)
    # In rigs of three and more, points of only two views are left out: they hardly constrain the
    # relative pose. A rig of two must use them; they determine five of six parameters of the
    # relative pose, and the prior of the registration its scale.
    enough = min(3, views)
    good = (subject.views[:, BODY_POINTS].ravel() >= enough) & np.isfinite(points[:, 0])
    gap = float(np.median(np.diff(times))) if len(times) > 1 else KEYPOINT_ERROR_TIME_S
    weights = by_point[..., 2] * inlier * min(1.0, gap / KEYPOINT_ERROR_TIME_S)
    velocity: np.ndarray = np.zeros((len(times), len(BODY_POINTS), 3))
    if len(times) > 2:
        change = subject.joints[2:, BODY_POINTS] - subject.joints[:-2, BODY_POINTS]
        velocity[1:-1] = np.nan_to_num(change / (times[2:] - times[:-2])[:, None, None])
    velocity = velocity.reshape(-1, 3)
    joint = np.arange(NUM_KEYPOINTS)[BODY_POINTS]
    span = np.floor(times / KEYPOINT_ERROR_TIME_S).astype(np.int64)
    unit = (NUM_KEYPOINTS * span[:, None] + joint).ravel()
    return BodyViews(by_point[good, :, :2], weights[good], points[good], velocity[good], unit[good])


class BodyConstraint:
    """Normal equations of the keypoints' reprojection errors.

    The object keeps the 3D points between calls: each call starts from the last points.
    """

    def __init__(self, views: BodyViews, rig: Rig) -> None:
        self._views = views
        self._lenses = rig.colour_parameters
        self._points = views.points.copy()

    def __call__(self, poses: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Matrix (C, 6, C, 6) and gradient (C, 6) with the points eliminated.

        The points are first adapted to the poses by two Gauss-Newton steps.

        Args:
            poses: (C, 4, 4) master_from_colour.
            offset: (C,) seconds by which each camera exposes after the set's time.
        """
        for _ in range(2):  # Gauss-Newton steps of the points at fixed poses
            residual, by_point, weight, _ = self._linearised(poses, offset)
            normal, slope = _normal_of_points(residual, by_point, weight)
            self._points -= np.linalg.solve(normal, slope[..., None])[..., 0]
        residual, by_point, weight, by_pose = self._linearised(poses, offset)
        normal, slope = _normal_of_points(residual, by_point, weight)
        count, views = weight.shape
        weighted = by_pose * weight[..., None, None]
        matrix = np.zeros((views, 6, views, 6))
        own = np.einsum("ncij,ncik->cjk", weighted, by_pose)
        matrix[np.arange(views), :, np.arange(views)] = own
        gradient = np.einsum("ncij,nci->cj", weighted, residual)
        # Schur complement: eliminate the points
        cross = np.einsum("ncij,ncik->njck", by_point, weighted).reshape(count, 3, -1)
        solved = np.linalg.solve(normal, cross)
        matrix -= np.einsum("njk,njl->kl", cross, solved).reshape(matrix.shape)
        gradient -= np.einsum("njk,nj->k", solved, slope).reshape(gradient.shape)
        return matrix, gradient

    def unit_errors(
        self, poses: np.ndarray, offset: np.ndarray, camera: int
    ) -> dict[Hashable, float]:
        """Mean reprojection error, px, of each unit (see :class:`BodyViews`).

        Only points that ``camera`` sees count, each with its mean error over all views. The points
        are first adapted to the poses.
        """
        self(poses, offset)
        residual, _, _, _ = self._linearised(poses, offset)
        known = self._views.weights > 0
        error = np.where(known, np.linalg.norm(residual, axis=-1), 0.0).sum(1)
        error /= np.maximum(known.sum(1), 1)
        result: dict[Hashable, float] = {}
        for unit in np.unique(self._views.unit[known[:, camera]]):
            own = error[known[:, camera] & (self._views.unit == unit)]
            result[int(unit)] = float(own.mean())
        return result

    def median_error(self, poses: np.ndarray, offset: np.ndarray) -> float:
        """Median reprojection error, px, with the points adapted to the poses."""
        self(poses, offset)
        residual, _, weight, _ = self._linearised(poses, offset)
        return float(np.median(np.linalg.norm(residual, axis=-1)[weight > 0]))

    def _linearised(
        self, poses: np.ndarray, offset: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Linearise the reprojection errors.

        Returns:
            Residual (N, C, 2), expected minus detected pixel.
            Its derivatives by the point (N, C, 2, 3).
            Weights (N, C): detection weight times robust weight over variance.
            Derivatives by the camera's pose (N, C, 2, 6).
        """
        colour_from_master = invert(poses)
        velocity = self._views.velocity[:, None]
        seen = self._points[:, None] + offset[:, None] * velocity  # (N, C, 3), at the exposure
        in_camera = np.einsum("cij,ncj->nci", colour_from_master[:, :3, :3], seen)
        in_camera += colour_from_master[:, :3, 3]
        pixels, by_camera = projection.project_with_jacobian(in_camera, self._lenses)
        by_point = by_camera @ colour_from_master[:, :3, :3]
        arm = seen - poses[:, :3, 3]
        # x_c = R' (X - t): turning R by w changes x_c by R' [X - t]x w, moving t by v by -R' v.
        by_pose = np.concatenate([by_point @ cross_matrix(arm), -by_point], -1)
        residual = pixels - self._views.pixels
        size = np.linalg.norm(residual, axis=-1)
        known = self._views.weights > 0
        # The length of a 2D Gaussian error has the median 1.177 sigma (Rayleigh). At least 3 px,
        # for the detector's bias at each joint; tuned on the studio.
        sigma = max(3.0, float(np.median(size[known])) / 1.177)
        robust = geman_mcclure_weight(size**2, ROBUST_SIGMA * sigma)
        return residual, by_point, self._views.weights * robust / sigma**2, by_pose


def _normal_of_points(
    residual: np.ndarray, by_point: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrix (N, 3, 3), slightly damped, and gradient (N, 3) of each point."""
    weighted = by_point * weight[..., None, None]
    normal = np.einsum("ncij,ncik->njk", weighted, by_point)
    damping = 1e-6 * np.trace(normal, axis1=1, axis2=2) + 1e-9
    normal += damping[:, None, None] * np.eye(3)
    return normal, np.einsum("ncij,nci->nj", weighted, residual)


def cross_matrix(vectors: np.ndarray) -> np.ndarray:
    """[v]x (..., 3, 3) of vectors (..., 3)."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    rows = [np.stack(r, -1) for r in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return np.stack(rows, -2)


class FloorConstraint:
    """Normal equations of one common floor: distances of floor points from the plane that fits
    the points of all cameras best."""

    def __init__(self, rig: Rig, points: dict[int, np.ndarray], up: np.ndarray) -> None:
        """
        Args:
            points: (n, 3) floor points by camera, in its depth frame, metres.
            up: (3,) approximate normal of the floor, master frame.
        """
        self._rig = rig
        self._points = points
        self._up = up

    @property
    def cameras(self) -> frozenset[int]:
        """Cameras with floor points."""
        return frozenset(self._points)

    @classmethod
    def of(
        cls, rig: Rig, surfaces: dict[int, DepthSurface], ground: GroundPlane
    ) -> FloorConstraint | None:
        """Select the points of ``surfaces`` that lie on the plane ``ground`` at the given poses.

        Returns None without a floor, or if fewer than two cameras have enough points on it.
        """
        if not ground.found:
            return None
        points = {}
        for c, surface in surfaces.items():
            pose = rig[c].master_from_depth
            height = (apply(pose, surface.points) - ground.point) @ ground.normal
            facing = surface.normals @ pose[:3, :3].T @ ground.normal
            # within 6 cm, because poses are not refined yet; tuned on the studio
            rows = np.flatnonzero((np.abs(height) < 0.06) & (facing > FLOOR_COSINE))
            if len(rows) >= 200:  # cells of 3 cm: a fifth of a square metre
                rows = np.random.default_rng(0).permutation(rows)[:1000]  # bounds the time
                points[c] = surface.points[rows]
        return cls(rig, points, ground.normal) if len(points) >= 2 else None

    def __call__(self, poses: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Matrix (C, 6, C, 6) and gradient (C, 6) at ``poses`` (C, 4, 4), plane eliminated.

        The plane is fitted to all points by least squares. Its three unknowns are two tilts about
        the centroid and the height. ``offset`` is unused.
        """
        count = len(self._rig)
        moved = self._rig.moved(poses)
        own = {c: apply(moved[c].master_from_depth, points) for c, points in self._points.items()}
        # standard deviation of floor points from the plane, metres: floors are not flat, depth is
        # biased
        sigma = 0.005
        everything = np.concatenate(list(own.values()))
        middle = everything.mean(0)
        axes = np.linalg.svd(everything - middle, full_matrices=False)[2]
        normal = axes[2] * np.sign(axes[2] @ self._up)
        matrix = np.zeros((count * 6, count * 6))
        gradient = np.zeros(count * 6)
        by_plane = np.zeros((3, 3))
        cross = np.zeros((3, count * 6))
        slope = np.zeros(3)
        for c, points in own.items():
            residual = (points - middle) @ normal
            robust = geman_mcclure_weight(residual**2, ROBUST_SIGMA * sigma)
            # ten independent points per camera: errors of lens and bias are shared
            weight = robust * min(1.0, 10.0 / len(points)) / sigma**2
            arm = points - poses[c, :3, 3]
            by_pose = np.column_stack(
                [np.cross(arm, normal), np.broadcast_to(normal, points.shape)]
            )
            # derivatives of the residual by two tilts about the centroid and the height
            plane = np.column_stack(
                [(points - middle) @ axes[0], (points - middle) @ axes[1], -np.ones(len(points))]
            )
            at = slice(6 * c, 6 * c + 6)
            weighted = by_pose * weight[:, None]
            matrix[at, at] += weighted.T @ by_pose
            gradient[at] += weighted.T @ residual
            cross[:, at] += plane.T @ weighted
            by_plane += plane.T @ (plane * weight[:, None])
            slope += plane.T @ (weight * residual)
        solved = np.linalg.solve(by_plane, np.column_stack([cross, slope]))
        matrix -= cross.T @ solved[:, :-1]
        gradient -= cross.T @ solved[:, -1]
        return matrix.reshape(count, 6, count, 6), gradient.reshape(count, 6)
