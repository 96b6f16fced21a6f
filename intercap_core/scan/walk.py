"""Poses of one depth camera that is carried through a scene at rest.

Each frame set is registered to the last keyframes: frame-to-model tracking as in
:mod:`.alignment`, on all surfaces in view. :mod:`.multiview` removes the drift.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.scan.alignment import Cloud, Model
from intercap_core.scan.multiview import align_together, are_apart, balanced
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
DRIFT_M = 0.12  # reach of the first correspondences of all keyframes together
CHANGED_MM = 40.0  # change of a depth pixel that is no noise


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
        return Keyframe(t, cloud, balanced(cloud, SAMPLES))


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
            camera_from_world = model.register(
                seen.sample, invert(predicted), PREDICTED_M, REACH_M
            ).pose
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
        if not poses or are_apart(poses[-1], pose, KEY_DEG, KEY_M):
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
    together = align_together(
        [key.cloud for key in keyframes], [key.sample for key in keyframes], np.stack(poses),
        reach_m=(DRIFT_M, REACH_M), view_deg=PAIR_DEG, view_m=PAIR_M,
    )  # fmt: skip
    return Walk(images.rig[0], keyframes, together)


def _lost(images: HandHeld, t: int, share: float) -> UserError:
    return UserError(
        f"sequence {images.frames.sequence}, frame {t} ({images.frames.time_s[t]:.1f} s): the "
        f"camera cannot be followed for {LOST_S:.0f} s; {share:.0%} of the depth fits the frames "
        f"before, expected {FOLLOWED:.0%}. Walk more slowly, keep the object and what stands "
        "around it in view, and let nothing else move"
    )
