"""Poses of an object of unknown shape: registration of each frame set to a model of the others.

Frame-to-model tracking (KinectFusion, ISMAR 2011) on points: the model is the mean of all points
registered so far, in cells of the object's frame. A frame set is registered by point-to-plane ICP
(Chen and Medioni, 1992) with a robust weight. These poses serve a first, rough mesh; the object's
tracker finds the poses of all frame sets with it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.transforms import apply, invert, rigid, rotation_exp

REACH_M = 0.03  # largest distance of corresponding points in tracking: motion between frame sets
NOISE_M = 0.003  # scale of the robust weight: noise of depth and of the rig's poses (data sheet)
FACING = 0.5  # least cosine between corresponding normals: the two sides of a plate do not match
# Standard deviations of the motion between frame sets, rad and metres. Weaker than 30 points, but
# they determine turns about an axis of symmetry.
PRIOR = np.array([0.2, 0.2, 0.2, 0.05, 0.05, 0.05])
MAX_POINTS = 3000  # of a frame set in its registration
GOOD_SHARE = 0.85  # least share of points near the model, of a registered frame set
# Neighbouring points that share one error of depth or of the rig's poses. With 30, the estimated
# deviation of a turned stool agrees with its true errors of 1.7 to 2.2 mm (bench/RESULTS.md).
SHARED_ERROR = 30.0
STEPS = 30


@dataclass(frozen=True, eq=False)
class Cloud:
    """Oriented points: (N, 3) each, metres."""

    points: np.ndarray
    normals: np.ndarray

    @classmethod
    def joined(cls, parts: Sequence[Cloud]) -> Cloud:
        """All points of several clouds."""
        return cls(*(np.concatenate([getattr(p, n) for p in parts]) for n in ("points", "normals")))

    def moved(self, target_from_source: np.ndarray) -> Cloud:
        """The cloud in another frame, by a transform (4, 4)."""
        rotated = self.normals @ target_from_source[:3, :3].T
        return Cloud(apply(target_from_source, self.points), rotated)

    def subset(self, index: np.ndarray) -> Cloud:
        """The points of indices or of a mask."""
        return Cloud(self.points[index], self.normals[index])

    def thinned(self, cell_m: float) -> Cloud:
        """Mean point and normal of each cell. Opposite surfaces in a cell are kept apart."""
        octants = (self.normals > 0) @ np.array([1, 2, 4])
        cells = np.floor(self.points / cell_m).astype(np.int64)
        x, y, z = (cells - cells.min(0)).T
        keys = ((x * (y.max() + 1) + y) * (z.max() + 1) + z) * 8 + octants
        _, cell, count = np.unique(keys, return_inverse=True, return_counts=True)
        points, normals = (
            np.stack([np.bincount(cell, values[:, k]) for k in range(3)], 1) / count[:, None]
            for values in (self.points, self.normals)
        )
        length = np.linalg.norm(normals, axis=1)
        kept = length > 0.3  # of a cell whose normals agree
        return Cloud(points[kept], normals[kept] / length[kept, None])


@dataclass(frozen=True, eq=False)
class Registration:
    """A registered cloud."""

    pose: np.ndarray
    """(4, 4) master_from_object."""
    share: float
    """Share of the points within three times :data:`NOISE_M` of the model. Normals do not count,
    because those of rods are noise."""
    sigma_m: float
    """RMS standard deviation of the cloud's points relative to the model, metres. It leaves out the
    drift of the model, and is too small about an axis of symmetry, where normals are noise."""


class Model:
    """Nearest neighbours in the cloud of an object, in its frame."""

    def __init__(self, cloud: Cloud) -> None:
        self.cloud = cloud
        self._tree = cKDTree(cloud.points)

    def register(
        self,
        cloud: Cloud,
        start: np.ndarray,
        reach_m: float = REACH_M,
        finest_m: float = 3 * NOISE_M,
    ) -> Registration:
        """Align a cloud in the master frame with the model.

        Args:
            cloud: points that show the object, master frame.
            start: (4, 4) master_from_object.
            reach_m: largest distance of corresponding points in the first step.
            finest_m: to which it shrinks.
        """
        object_from_master = invert(start)
        about = apply(object_from_master, cloud.points.mean(0)[None])[0]
        precision = np.diag(PRIOR**-2)
        moved_by = np.zeros(6)
        share, information = 0.0, np.zeros((6, 6))
        for step in range(STEPS):
            reach = max(reach_m * 0.8**step, finest_m)
            own = cloud.moved(object_from_master)
            distance, near = self._tree.query(own.points, distance_upper_bound=reach)
            near[~np.isfinite(distance)] = 0
            normals = self.cloud.normals[near]
            agree = np.isfinite(distance) & ((own.normals * normals).sum(1) > FACING)
            share = float((distance < 3 * NOISE_M).mean())
            if agree.sum() < 20:
                break
            points, normals = own.points[agree], normals[agree]
            residual = (normals * (points - self.cloud.points[near[agree]])).sum(1)
            scale = max(NOISE_M, reach / 6)
            weight = (scale / (scale**2 + residual**2)) ** 2  # Geman-McClure, over the variance
            jacobian = np.concatenate([np.cross(points - about, normals), normals], 1)
            information = (jacobian * weight[:, None]).T @ jacobian
            gradient = jacobian.T @ (weight * residual) + precision @ moved_by
            change = -np.linalg.solve(information + precision, gradient)
            moved_by = moved_by + change
            turn = rotation_exp(change[:3])
            step_about = rigid(turn, about + change[3:] - turn @ about)
            object_from_master = step_about @ object_from_master
            if step > 5 and np.abs(change).max() < 1e-5:
                break
        # products of rounded rotations would leave the rotations, faster with each frame
        rotation = Rotation.from_matrix(object_from_master[:3, :3]).as_matrix()
        pose = invert(rigid(rotation, object_from_master[:3, 3]))
        arms = apply(object_from_master, cloud.points) - about
        return Registration(pose, share, _spread(arms, information / SHARED_ERROR + precision))

    def overlap(self, cloud: Cloud, pose: np.ndarray, reach_m: float) -> tuple[float, float]:
        """Share of the points of a cloud near the model, and share of these on its surface.

        Args:
            cloud: points in the master frame.
            pose: (4, 4) master_from_object.
            reach_m: distance of points that are near; on the surface are those within three times
                :data:`NOISE_M` along the normal.
        """
        own = cloud.moved(invert(pose))
        distance, near = self._tree.query(own.points, distance_upper_bound=reach_m)
        found = np.isfinite(distance)
        if not found.any():
            return 0.0, 0.0
        points, normals = own.points[found], self.cloud.normals[near[found]]
        off = np.abs((normals * (points - self.cloud.points[near[found]])).sum(1))
        agree = (own.normals[found] * normals).sum(1) > FACING
        return float(found.mean()), float((agree & (off < 3 * NOISE_M)).mean())


def _spread(points: np.ndarray, precision: np.ndarray) -> float:
    """RMS standard deviation of points (N, 3) that a twist of a ``precision`` (6, 6) moves."""
    covariance = np.linalg.inv(precision)
    turned = np.cross(np.eye(3)[:, None], points).transpose(1, 2, 0)  # (N, 3, 3) by unit turns
    moved_by = np.concatenate([turned, np.broadcast_to(np.eye(3), turned.shape)], 2)
    return float(np.sqrt(np.einsum("nij,jk,nik->n", moved_by, covariance, moved_by).mean()))


def some(cloud: Cloud, count: int = MAX_POINTS) -> Cloud:
    """At most ``count`` points, evenly over the order of the points."""
    if len(cloud.points) <= count:
        return cloud
    return cloud.subset(np.linspace(0, len(cloud.points) - 1, count).astype(int))


def track_from(clouds: Mapping[int, Cloud], seed: int, cell_m: float) -> dict[int, Registration]:
    """Register the frame sets around one of them, as long as the registration is good.

    The object's frame has the master's axes. Its origin is the mean of the points at the seed. Each
    registration starts with the motion between the two frame sets before it.

    Args:
        clouds: points that show the object by frame set, master frame.
        seed: frame set that defines the object's frame.
        cell_m: cell of the model, metres.

    Returns:
        Registrations by frame set.
    """
    first = rigid(np.eye(3), clouds[seed].points.mean(0))
    result = {seed: Registration(first, 1.0, 0.0)}
    model = Model(clouds[seed].moved(invert(first)).thinned(cell_m))
    order = sorted(clouds)
    at = order.index(seed)
    for way in (order[at + 1 :], order[:at][::-1]):
        last, motion = first, np.eye(4)
        for t in way:
            found = model.register(some(clouds[t]), motion @ last)
            if found.share < GOOD_SHARE:
                break
            result[t] = found
            last, motion = found.pose, found.pose @ invert(last)
            own = clouds[t].moved(invert(found.pose))
            model = Model(Cloud.joined([model.cloud, own]).thinned(cell_m))
    return result
