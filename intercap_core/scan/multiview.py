"""Multiview registration: poses of several clouds that align all of them with each other.

Pulli (3DIM 1999) with the distances along the normals (Chen and Medioni 1992): the distances
between each pair of clouds with a common view are minimised over all poses. Pairs to which a motion
returns close the loop, which removes the drift of frame-to-model tracking.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from intercap_core.geometry.camera.transforms import apply, invert, rigid, rotation_exp
from intercap_core.progress import Progress
from intercap_core.scan.alignment import FACING, NOISE_M, Cloud, Registration, track_from

NEIGHBOURS = 3  # clouds that each one is paired with before and after it
ROUNDS = 14
UNDETERMINED = 1e-3 / NOISE_M**2  # precision of a cloud that no pair determines
# Of the frame sets of a turned object
ALIGNED_SETS, SAMPLES = 30, 800  # frame sets, and points of each
# From the drift of the tracking (4 cm at the ends of a racquet) to three times the noise
OBJECT_REACH_M = (0.06, 3 * NOISE_M)
SAME_SIDES_DEG = 35.0  # turn of an object of which cameras around it still see common sides

log = logging.getLogger(__name__)


def balanced(cloud: Cloud, count: int) -> Cloud:
    """At most ``count`` points, evenly over 24 directions of the normals.

    Small surfaces of rare directions determine the pose as much as the floor (Rusinkiewicz and
    Levoy, 3DIM 2001).
    """
    axis = np.abs(cloud.normals).argmax(1)
    octant = (cloud.normals > 0) @ np.array([1, 2, 4])
    direction = 8 * axis + octant
    share = count // len(np.unique(direction))
    chosen = []
    for value in np.unique(direction):
        index = np.flatnonzero(direction == value)
        chosen.append(index[np.linspace(0, len(index) - 1, min(share, len(index))).astype(int)])
    return cloud.subset(np.concatenate(chosen))


def are_apart(first: np.ndarray, second: np.ndarray, degrees: float, metres: float) -> bool:
    """Whether two poses (4, 4) differ by more than an angle or a distance."""
    between = invert(first) @ second
    turned = np.degrees(np.arccos(np.clip((np.trace(between[:3, :3]) - 1) / 2, -1, 1)))
    return bool(turned > degrees or np.linalg.norm(between[:3, 3]) > metres)


def align_together(
    clouds: Sequence[Cloud],
    samples: Sequence[Cloud],
    poses: np.ndarray,
    *,
    reach_m: tuple[float, float],
    view_deg: float,
    view_m: float = np.inf,
) -> np.ndarray:
    """Poses (K, 4, 4) world_from_cloud that align K clouds with each other; the first is fixed.

    Gauss-Newton with Geman-McClure weights.

    Args:
        clouds: points, each in a frame of its own.
        samples: some points of each cloud, which are compared with the other clouds.
        poses: (K, 4, 4) world_from_cloud with drift.
        reach_m: largest distance of corresponding points in the first and last round, metres.
        view_deg: largest angle between the poses of two clouds with a common view, degrees.
        view_m: largest distance between them, metres.
    """
    count = len(clouds)
    pairs = [
        (i, j)
        for i in range(count)
        for j in range(count)
        if i != j
        and (abs(i - j) <= NEIGHBOURS or not are_apart(poses[i], poses[j], view_deg, view_m))
    ]
    trees = [cKDTree(cloud.points) for cloud in clouds]
    progress = Progress(log, "aligned", ROUNDS, "rounds")
    for reach in np.geomspace(*reach_m, ROUNDS):
        matrix, right = np.zeros((count, 6, count, 6)), np.zeros((count, 6))
        about = poses[:, :3, 3].mean(0)
        for i, j in pairs:
            source = samples[i].moved(invert(poses[j]) @ poses[i])
            matched = _matched(source, clouds[j], trees[j], reach)
            points = apply(poses[j], matched.points) - about
            normals = matched.normals @ poses[j][:3, :3].T
            jacobian = np.concatenate([np.cross(points, normals), normals], 1)
            weighted = jacobian * matched.weight[:, None]
            block, vector = weighted.T @ jacobian, weighted.T @ matched.residual
            for one, other in ((i, j), (j, i)):  # the distance depends on the relative motion
                matrix[one, :, one] += block
                matrix[one, :, other] -= block
            right[i] += vector
            right[j] -= vector
        free = matrix.reshape(6 * count, 6 * count)[6:, 6:]
        free[np.diag_indices_from(free)] += UNDETERMINED
        change = np.zeros((count, 6))
        if count > 1:
            change[1:] = -np.linalg.solve(free, right.ravel()[6:]).reshape(-1, 6)
        turns = rotation_exp(change[:, :3])
        poses = rigid(turns, about + change[:, 3:] - turns @ about) @ poses
        progress.step()
    return poses


def register_turned(
    clouds: Mapping[int, Cloud], seed: int, cell_m: float
) -> dict[int, Registration]:
    """Poses of a turned object in at most ``ALIGNED_SETS`` frame sets around one of them.

    Args:
        clouds: points that show the object by frame set, master frame.
        seed: frame set whose pose is kept as :func:`.track_from` defines it.
        cell_m: cell of the points, metres.

    Returns:
        Registrations by frame set, with the standard deviations of :func:`.track_from`.
    """
    tracked = track_from(clouds, seed, cell_m)
    sets = sorted(tracked)
    step = -(-len(sets) // ALIGNED_SETS)
    first = sets.index(seed)
    sets = sets[first % step :: step]
    poses = align_together(
        [clouds[t].thinned(cell_m) for t in sets],
        [balanced(clouds[t], SAMPLES) for t in sets],
        np.stack([invert(tracked[t].pose) for t in sets]),
        reach_m=OBJECT_REACH_M,
        view_deg=SAME_SIDES_DEG,
    )
    kept = poses[sets.index(seed)] @ tracked[seed].pose
    return {
        t: replace(tracked[t], pose=invert(pose) @ kept)
        for t, pose in zip(sets, poses, strict=True)
    }


class _Matches(NamedTuple):
    """Points that correspond to those of a cloud, in its frame. M points."""

    points: np.ndarray
    """(M, 3)."""
    normals: np.ndarray
    """(M, 3) of the cloud's surface."""
    residual: np.ndarray
    """(M,) distance along the normal, metres."""
    weight: np.ndarray
    """(M,) robust weight over the variance."""


def _matched(source: Cloud, target: Cloud, tree: cKDTree, reach: float) -> _Matches:
    """The points of ``source`` within ``reach`` of ``target``, both in one frame."""
    distance, near = tree.query(source.points, distance_upper_bound=reach)
    found = np.isfinite(distance)
    points, near = source.points[found], near[found]
    agree = (source.normals[found] * target.normals[near]).sum(1) > FACING
    points, near = points[agree], near[agree]
    normals = target.normals[near]
    residual = (normals * (points - target.points[near])).sum(1)
    scale = max(NOISE_M, reach / 6)
    weight = (scale / (scale**2 + residual**2)) ** 2  # Geman-McClure
    return _Matches(points, normals, residual, weight)
