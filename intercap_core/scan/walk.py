"""Poses of one depth camera that is carried through a scene at rest.

Each frame set is registered to the last keyframes: frame-to-model tracking as in
:mod:`.alignment`, on all surfaces in view. The drift is removed by multiview registration (Pulli,
3DIM 1999): the distances along the normals (Chen and Medioni 1992) between each pair of keyframes
with a common view are minimised over the poses of all keyframes. Pairs to which the walk returns
close the loop.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial import cKDTree

from intercap_core.errors import UserError
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply, invert, rigid, rotation_exp
from intercap_core.progress import Progress
from intercap_core.scan.alignment import FACING, NOISE_M, Cloud, Model
from intercap_core.scan.surfaces import DepthImages, floating

FARTHEST_M = 3.5  # points beyond are left out: their noise exceeds 7 mm (Tolgyessy et al. 2021)
NORMAL_PX = 3  # half the side of the neighbourhood of a normal: 2 cm at 1.5 m
STEP_M = 0.015  # difference of depth from the mean of both sides at a step, at up to 1 m
STRIDE_PX = 3  # of the depth pixels that are registered
CELL_M = 0.010  # of the keyframes' points
SAMPLES = 3000  # points of a frame set in its registration
PREDICTED_M = 0.08  # largest distance from the predicted place: 1 m/s and 60 degrees/s change
REACH_M = 0.02  # of corresponding points in the end: distance of depth pixels at 3 m
NEAR_M, MIN_NEAR = 0.05, 0.5  # distance of points from the model that it shows; least share of them
FOLLOWED = 0.85  # least share of these on the model's surface
LOST_S = 1.0  # longest time without registration
KEY_DEG, KEY_M = 7.0, 0.10  # motion from one keyframe to the next
LOCAL = 8  # keyframes in the model that is tracked
PAIR_DEG, PAIR_M = 35.0, 0.45  # largest difference of the poses of a pair with a common view
NEIGHBOURS = 3  # keyframes that each one is paired with before and after it
DRIFT_M = 0.12  # reach of the first correspondences of all keyframes together
ROUNDS = 14
CHANGED_MM = 40.0  # change of a depth pixel that is no noise
UNDETERMINED = 1e-3 / NOISE_M**2  # precision of a keyframe that no pair determines

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A registered frame set."""

    t: int
    cloud: Cloud
    """Points of the camera's frame, metres."""
    sample: Cloud
    """Some of them, evenly over the directions of the normals."""


@dataclass(frozen=True, eq=False)
class Walk:
    """The camera's way."""

    camera: Camera
    keyframes: Sequence[Keyframe]
    poses: np.ndarray
    """(K, 4, 4) world_from_camera; the world is the frame of the first keyframe."""

    @property
    def rig(self) -> Rig:
        """A camera at each of the poses."""
        return Rig(tuple(self.camera.moved(pose) for pose in self.poses))

    def cloud(self) -> Cloud:
        """The points of all keyframes in the world."""
        views = zip(self.keyframes, self.poses, strict=True)
        return Cloud.joined([key.cloud.moved(pose) for key, pose in views])


class HandHeld(DepthImages):
    """Depth images of a camera that moves. The master frame is that of the camera at the time."""

    def __init__(self, frames: Frames) -> None:
        """Raises UserError unless the recording is of one camera with depth."""
        names = frames.rig.names
        if len(names) != 1 or frames.rig[0].depth is None:
            has = "depth" if frames.rig[0].depth else "no depth"
            raise UserError(
                f"sequence {frames.sequence}: has {len(names)} camera(s) ({', '.join(names)}; "
                f"{has} in the first), expected one hand-held camera with depth; leave out "
                "--hand-held for a rig"
            )
        rig = Rig((frames.rig[0].moved(np.eye(4)),))
        super().__init__(frames, rig, [0], np.zeros(1))

    def oriented(self, t: int) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Pixels (N,), points (N, 3) and unit normals (N, 3) of a frame set, camera's frame.

        None without depth. Pixels at depth edges are left out.
        """
        image, depth, lens = self.frames.depth(t, 0), self.depth(t, 0), self.rig[0].depth
        if image is None or depth is None or lens is None:
            return None
        depth = cv2.bilateralFilter(depth, 5, 0.015, 2.0)
        depth[floating(image) | (depth > FARTHEST_M)] = 0
        grid = np.concatenate([lens.rays, np.ones((*depth.shape, 1), np.float32)], 2)
        grid = np.where((depth > 0)[..., None], grid * depth[..., None], np.nan)
        normals = _normals(grid)
        known = np.isfinite(normals).all(2) & np.isfinite(grid).all(2)
        pixels = np.flatnonzero(known)
        pose = self.rig[0].master_from_depth
        points = apply(pose, grid.reshape(-1, 3)[pixels].astype(float))
        return pixels, points, normals.reshape(-1, 3)[pixels] @ pose[:3, :3].T

    def keyframe(self, t: int) -> Keyframe | None:
        """The points of a frame set that are registered; None without depth."""
        seen = self.oriented(t)
        assert self.rig[0].depth is not None
        row, column = np.divmod(
            np.zeros(0, int) if seen is None else seen[0], self.rig[0].depth.width
        )
        kept = (row % STRIDE_PX == 0) & (column % STRIDE_PX == 0)
        if seen is None or kept.sum() < SAMPLES // 10:
            return None
        cloud = Cloud(seen[1][kept], seen[2][kept])
        return Keyframe(t, cloud, balanced(cloud))


def _normals(grid: np.ndarray) -> np.ndarray:
    """Unit normals (H, W, 3) of points (H, W, 3), towards the camera; NaN = unknown or at a step.

    Normals across a step would belong to no surface, and move with the camera.
    """
    n = NORMAL_PX
    left, right = grid[n:-n, : -2 * n], grid[n:-n, 2 * n :]
    above, below = grid[: -2 * n, n:-n], grid[2 * n :, n:-n]
    inner = np.cross(below - above, right - left)
    inner /= np.linalg.norm(inner, axis=2, keepdims=True)
    middle = grid[n:-n, n:-n, 2]
    bend = np.maximum(
        np.abs(left[..., 2] + right[..., 2] - 2 * middle),
        np.abs(above[..., 2] + below[..., 2] - 2 * middle),
    )
    inner[bend > STEP_M * np.maximum(1.0, middle)] = np.nan
    normals = np.full(grid.shape, np.nan, np.float32)
    normals[n:-n, n:-n] = inner
    return normals


def camera_moves(frames: Frames) -> bool:
    """Whether the only camera of a recording moves: most depth pixels change, not only a person."""
    shown = np.linspace(0, frames.num_sets - 1, 9).astype(int)
    images = [image for t in shown if (image := frames.depth(int(t), 0)) is not None]
    if len(frames.rig) != 1 or len(images) < 2:
        return False
    first, *others = (image.astype(np.float32) for image in images)
    changed = [
        float((np.abs(image - first) > CHANGED_MM)[(image > 0) & (first > 0)].mean())
        for image in others
        if ((image > 0) & (first > 0)).any()
    ]
    return bool(changed) and float(np.median(changed)) > 0.5


def balanced(cloud: Cloud, count: int = SAMPLES) -> Cloud:
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


def follow(images: HandHeld) -> Walk:
    """Poses of the keyframes of a recording.

    Raises UserError if the camera cannot be followed for ``LOST_S``.
    """
    keyframes: list[Keyframe] = []
    poses: list[np.ndarray] = []
    pose, step, model, lost = np.eye(4), np.eye(4), None, 0
    for t in range(images.frames.num_sets):
        seen = images.keyframe(t)
        share = 0.0
        if seen is not None and model is not None:
            predicted = pose @ step
            camera_from_world, _ = model.register(
                seen.sample, invert(predicted), PREDICTED_M, REACH_M
            )
            near, share = model.overlap(seen.sample, camera_from_world, NEAR_M)
        elif seen is not None:
            camera_from_world, near, share = np.eye(4), 1.0, 1.0
        if seen is None or near < MIN_NEAR or share < FOLLOWED:
            lost += 1
            if model is not None:
                pose = pose @ step
            if lost > LOST_S * images.frames.fps:
                raise _lost(images, t - lost + 1, share)
            continue
        lost = 0
        step = invert(pose) @ invert(camera_from_world) if model is not None else np.eye(4)
        pose = invert(camera_from_world)
        if not poses or _apart(poses[-1], pose, KEY_DEG, KEY_M):
            thinned = Keyframe(t, seen.cloud.thinned(CELL_M), seen.sample)
            keyframes.append(thinned)
            poses.append(pose)
            local = zip(keyframes[-LOCAL:], poses[-LOCAL:], strict=True)
            model = Model(Cloud.joined([k.cloud.moved(p) for k, p in local]).thinned(CELL_M))
    if not keyframes:
        raise UserError(
            f"sequence {images.frames.sequence}: no frame set has depth within {FARTHEST_M} m; "
            "keep the object 0.5 to 1.5 m in front of the camera"
        )
    return Walk(images.rig[0], keyframes, aligned_together(keyframes, np.stack(poses)))


def _lost(images: HandHeld, t: int, share: float) -> UserError:
    return UserError(
        f"sequence {images.frames.sequence}, frame {t} ({images.frames.time_s[t]:.1f} s): the "
        f"camera cannot be followed for {LOST_S:.0f} s; {share:.0%} of the depth fits the frames "
        f"before, expected {FOLLOWED:.0%}. Walk more slowly, keep the object and what stands "
        "around it in view, and let nothing else move"
    )


def _apart(first: np.ndarray, second: np.ndarray, degrees: float, metres: float) -> bool:
    """Whether two poses (4, 4) differ by more than an angle or a distance."""
    between = invert(first) @ second
    turned = np.degrees(np.arccos(np.clip((np.trace(between[:3, :3]) - 1) / 2, -1, 1)))
    return bool(turned > degrees or np.linalg.norm(between[:3, 3]) > metres)


def aligned_together(keyframes: Sequence[Keyframe], poses: np.ndarray) -> np.ndarray:
    """Poses (K, 4, 4) that align all keyframes with each other.

    Gauss-Newton with Geman-McClure weights; the first pose is fixed. Correspondences are the
    nearest points within a reach that shrinks from ``DRIFT_M`` to ``REACH_M``.

    Args:
        poses: (K, 4, 4) world_from_camera with drift.
    """
    count = len(keyframes)
    pairs = [
        (i, j)
        for i in range(count)
        for j in range(count)
        if i != j and (abs(i - j) <= NEIGHBOURS or not _apart(poses[i], poses[j], PAIR_DEG, PAIR_M))
    ]
    trees = [cKDTree(key.cloud.points) for key in keyframes]
    progress = Progress(log, "aligned", ROUNDS, "rounds")
    for reach in np.geomspace(DRIFT_M, REACH_M, ROUNDS):
        matrix, right = np.zeros((count, 6, count, 6)), np.zeros((count, 6))
        about = poses[:, :3, 3].mean(0)
        for i, j in pairs:
            source = keyframes[i].sample.moved(invert(poses[j]) @ poses[i])
            matched = _matched(source, keyframes[j].cloud, trees[j], reach)
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


class _Matches(NamedTuple):
    """Points that correspond to a keyframe's, in its frame. M points."""

    points: np.ndarray
    """(M, 3)."""
    normals: np.ndarray
    """(M, 3) of the keyframe's surface."""
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
