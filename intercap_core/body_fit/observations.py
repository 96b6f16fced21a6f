"""Observations of the person: keypoints of all frames, and the fused cloud of each frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from intercap_core import artefacts
from intercap_core.artefacts import unpack_ragged
from intercap_core.body.keypoints import BODY, KEYPOINT_INDEX
from intercap_core.body_fit.free_space import DepthWindow
from intercap_core.body_fit.outlines import MaskRim, trace_outline
from intercap_core.errors import UserError
from intercap_core.formats.detections.read import FROM_DETECTOR
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.mask_pixels import mask_pixels, mask_window
from intercap_core.geometry.camera.masks import Runs
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.solve.thread_pool import ThreadPool, threads_of_job
from intercap_core.schemas import PERSON, SCENE

# Keypoints that place the trunk.
TRUNK_KEYPOINTS = [
    KEYPOINT_INDEX[name]
    for name in ("neck", "right_shoulder", "left_shoulder", "mid_hip", "right_hip", "left_hip")
]


@dataclass(frozen=True, eq=False)
class Observations:
    """Observations in T frames and C cameras, with K = 135 keypoints."""

    sequence: str
    rig: Rig
    keypoints: np.ndarray
    """(T, C, K, 2) px."""
    confidence: np.ndarray
    """(T, C, K), 0 = not detected."""
    joints: np.ndarray
    """(T, K, 3) triangulated keypoints, master frame, metres, NaN = unknown."""
    joint_views: np.ndarray
    """(T, K) number of views of each triangulated keypoint."""
    masks: list[bytes]
    """RLE of the person's mask in each of T * C images (index t C + c), empty = none."""
    mask_source: np.ndarray
    """(T, C) source of each mask: 0 none, 1 detector, 2 foreground segmentation."""
    other_masks: list[bytes]
    """RLE of other detected objects in each of T * C images, empty = none."""
    background: list[np.ndarray | None]
    """Depth image of the empty room in each camera, mm; None = unknown."""
    depth_bias: np.ndarray
    """(C,) excess of the depth that each camera measures, metres."""
    image_of: np.ndarray
    """(T, C) index of the recorded frame set whose image of camera c was exposed at the time of
    frame t, -1 = none."""
    time_offset: np.ndarray
    """(C,) delay of each camera's exposure after the time of the frame, seconds."""
    times: np.ndarray
    """(T,) time of each frame, seconds."""

    @property
    def num_frames(self) -> int:
        return len(self.times)

    @property
    def placed(self) -> np.ndarray:
        """(T,) bool: three keypoints of the trunk are triangulated, enough to place a body."""
        trunk = self.joints[:, TRUNK_KEYPOINTS]
        return np.isfinite(trunk).all(2).sum(1) >= 3

    @property
    def usable(self) -> np.ndarray:
        """(T,) bool: frames that are fitted.

        A frame is usable if a body can be placed (:attr:`placed`). It also is if six body keypoints
        are triangulated and a body can be placed in a frame within 1 s: a single view from the side
        or over a table may see only one shoulder. Both numbers are tuned on the studio.
        """
        placed = self.placed
        if not placed.any():
            return placed
        near = self.times[placed]
        after = np.searchsorted(near, self.times).clip(1, max(len(near) - 1, 1))
        gap = np.abs(self.times - near[np.stack([after - 1, after % len(near)])]).min(0)
        known = np.isfinite(self.joints[:, BODY]).all(2).sum(1)
        return placed | ((gap <= 1.0) & (known >= 6))

    def window(self, frames: slice) -> Observations:
        """Return the observations of some frames."""
        cameras = len(self.rig)
        images = slice(frames.start * cameras, frames.stop * cameras)
        by_frame = ("keypoints", "confidence", "joints", "joint_views", "mask_source")
        return replace(
            self,
            masks=self.masks[images],
            other_masks=self.other_masks[images],
            **{name: getattr(self, name)[frames] for name in (*by_frame, "image_of", "times")},
        )


def read_observations(scene: Path, person: Path) -> Observations:
    """Read the observations. Raises UserError if the artefacts do not belong together."""
    with artefacts.read(scene, SCENE) as read:
        rig = Rig.from_artefact(read)
        sequence = str(read.attributes["sequence"])
        times = read["times"]
        image_of, time_offset = read["image_of"], read["time_offset"]
        depth_bias = read["depth_bias"]
        keys = set(read.keys("cameras/"))
        background = [
            read[f"cameras/{name}/background"] if f"cameras/{name}/background" in keys else None
            for name in rig.names
        ]
    with artefacts.read(person, PERSON) as read:
        names = tuple(read.text("camera_names"))
        if names != rig.names or len(read["missing"]) != len(times):
            raise UserError(
                f"{person}: has {len(read['missing'])} frames of cameras {', '.join(names)}, "
                f"expected {len(times)} of {', '.join(rig.names)} as in {scene}; re-run stage "
                "'person' for this sequence"
            )
        keypoints = read["keypoints"].astype(np.float64)
        joints, views = read["joints"].astype(np.float64), read["joint_views"]
        inlier = read["inlier"]
        masks, source = unpack_ragged(read["mask_offsets"], read["mask_rle"]), read["mask_source"]
        others = [b""] * len(masks)
        if "beside_offsets" in read:
            others = unpack_ragged(read["beside_offsets"], read["beside_rle"])
    confidence = np.clip(np.nan_to_num(keypoints[..., 2]), 0.0, 1.0)
    # keypoints of a view that disagree with the triangulated point lose most of their confidence;
    # the factor is tuned on the studio
    outlier = (views >= 2)[:, None] & ~inlier
    confidence = np.where(outlier, 0.2 * confidence, confidence)
    confidence[~np.isfinite(keypoints[..., :2]).all(-1)] = 0
    return Observations(
        sequence=sequence,
        rig=rig,
        keypoints=np.nan_to_num(keypoints[..., :2]),
        confidence=confidence,
        joints=joints,
        joint_views=views,
        masks=masks,
        mask_source=source,
        other_masks=others,
        background=background,
        depth_bias=depth_bias,
        image_of=image_of,
        time_offset=time_offset,
        times=times,
    )


@dataclass(frozen=True, eq=False)
class PersonCloud:
    """Depth points of the person in one frame, from all views, in the master frame."""

    points: Tensor
    """(M, 3) float32, metres."""
    normals: Tensor
    """(M, 3) float32 unit normals, towards the camera."""
    trust: Tensor
    """(M,) weight in (0, 1], lower at depth edges."""
    view: Tensor
    """(M,) camera index."""
    windows: tuple[DepthWindow, ...] = ()
    """Depth around the person, by camera."""
    outlines: tuple[MaskRim, ...] = ()
    """Rims of the person's masks, by camera."""

    def of_view(self, view: int) -> PersonCloud:
        """Return the part of camera ``view``."""
        mine = self.view == view
        return PersonCloud(
            self.points[mine],
            self.normals[mine],
            self.trust[mine],
            self.view[mine],
            tuple(window for window in self.windows if window.view == view),
            tuple(rim for rim in self.outlines if rim.view == view),
        )

    def through(
        self, rig: Rig, bias: np.ndarray, before: Rig, bias_before: np.ndarray
    ) -> PersonCloud:
        """Return the same pixels, back-projected with other camera poses and depth biases.

        Args:
            rig: new camera poses.
            bias: (C,) new depth biases, metres.
            before: camera poses of this cloud.
            bias_before: (C,) depth biases of this cloud, metres.
        """
        points, normals = self.points.clone(), self.normals.clone()
        for view in np.unique(self.view.numpy()):
            mine = self.view == int(view)
            old, new = before[view].depth_from_master, rig[view].master_from_depth
            measured = apply(old, points[mine].double().numpy())
            measured -= (bias[view] - bias_before[view]) * measured / measured[:, 2:]
            turn = new[:3, :3] @ old[:3, :3]
            points[mine] = torch.as_tensor(apply(new, measured)).to(points)
            normals[mine] = normals[mine] @ torch.as_tensor(turn.T).to(normals)
        return replace(self, points=points, normals=normals)


def person_clouds(
    frames: Path, observations: Observations, count: int, moments: slice = slice(None)
) -> list[PersonCloud | None]:
    """Return the clouds of the frames ``moments``, of about ``count`` points each.

    None = no usable mask.
    """
    with Frames.open(frames) as reader:
        reader = reader.showing(observations.image_of)
        return ThreadPool(threads_of_job()).map(
            lambda t: _fuse(reader, observations, t, count),
            range(observations.num_frames)[moments],
        )


def _fuse(reader: Frames, observations: Observations, t: int, count: int) -> PersonCloud | None:
    """Return the depth points of frame t within the person's masks, and the rims of the masks."""
    seen_by: list[tuple[int, np.ndarray, np.ndarray]] = []  # camera, depth image, pixels
    windows, outlines = [], []
    for c, camera in enumerate(observations.rig):
        at = t * len(observations.rig) + c
        mask = _runs(observations.masks[at], camera)
        if mask is None:
            continue
        depth = None if camera.depth is None else reader.depth(t, c)
        # The rim of a detector's mask is used. That of a foreground segmentation is used only if
        # there is no depth, and if masks of other objects tell where they cover the person.
        if observations.mask_source[t, c] == FROM_DETECTOR or (
            depth is None and observations.other_masks[at]
        ):
            rim = trace_outline(mask, _runs(observations.other_masks[at], camera), camera.colour, c)
            outlines += [] if rim is None else [rim]
        if depth is None:
            continue
        window = mask_window(depth, camera, mask)
        if window is None:
            continue
        # pixels in front of the background are the person or an occluder
        index = mask_pixels(
            depth,
            camera,
            mask,
            window,
            background=observations.background[c],
            before_m=0.04,  # of the background; tuned on the studio
            every=2,  # neighbouring rows and columns are redundant
        )
        if len(index):
            seen_by.append((c, depth, index))
            rows, columns = window
            corner = (rows.start, columns.start)
            windows.append(DepthWindow(c, corner, depth[rows, columns].copy()))
    if not seen_by and not outlines:
        return None
    # every n-th point: pixels are in scan order, so this spreads over the surface
    first = np.cumsum([0, *(len(index) for _, _, index in seen_by)])
    pick = np.unique(np.linspace(0, first[-1] - 1, min(count, first[-1])).astype(np.int64))
    none = np.zeros(0)
    parts: list[tuple[np.ndarray, ...]] = [(none.reshape(0, 3), none.reshape(0, 3), none, none)]
    for (c, depth, index), start in zip(seen_by, first[:-1], strict=True):
        chosen = index[pick[(pick >= start) & (pick < start + len(index))] - start]
        in_master = _place_pixels(depth, observations.rig[c], chosen, observations.depth_bias[c])
        parts.append((*in_master, np.full(len(chosen), c)))
    points, normals, trust, view = (np.concatenate(p) for p in zip(*parts, strict=True))
    return PersonCloud(
        torch.as_tensor(points, dtype=torch.float32),
        torch.as_tensor(normals, dtype=torch.float32),
        torch.as_tensor(trust, dtype=torch.float32),
        torch.as_tensor(view, dtype=torch.int64),
        tuple(windows),
        tuple(outlines),
    )


def _runs(rle: bytes, camera: Camera) -> Runs | None:
    return Runs(rle, camera.colour.height, camera.colour.width) if rle else None


def _place_pixels(
    depth: np.ndarray, camera: Camera, index: np.ndarray, depth_bias: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points and normals (M, 3), master frame, and trust (M,) of flat depth pixels (M,)."""
    points, normals, edge = _measure_normals(depth, camera, index)
    if depth_bias:
        points = points - depth_bias * points / points[:, 2:]
    master = camera.master_from_depth
    rotation = master[:3, :3].astype(np.float32)
    return apply(master, points), normals @ rotation.T, np.where(edge, 0.3, 1.0)


def _measure_normals(
    depth: np.ndarray, camera: Camera, index: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Measure surface normals by differences of depth along rows and columns.

    Returns:
        (M, 3) points, depth camera's frame, metres.
        (M, 3) unit normals towards the camera.
        (M,) bool: the pixel is at a depth edge.
    """
    assert camera.depth is not None
    base = 3  # px, half the distance over which a normal is measured; tuned on the studio
    edge_m = 0.04  # a larger change of depth within ``base`` px is an edge; tuned on the studio
    height, width = depth.shape
    rays = camera.depth.rays
    row, column = np.divmod(index, width)
    z = depth[row, column].astype(np.float32) * np.float32(1e-3)

    def at(r: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points (M, 3) at rows r, columns c, and whether they continue the surface."""
        r, c = np.clip(r, 0, height - 1), np.clip(c, 0, width - 1)
        there = depth[r, c].astype(np.float32) * np.float32(1e-3)
        ray = rays[r, c]
        good = (there > 0) & (np.abs(there - z) < edge_m) & np.isfinite(ray[:, 0])
        ray = np.where(good[:, None], ray, 0)
        return np.concatenate([ray * there[:, None], there[:, None]], 1), good

    ray = np.nan_to_num(rays[row, column])
    here = np.concatenate([ray * z[:, None], z[:, None]], 1)
    spans, smooth = [], np.ones(len(index), bool)
    for dr, dc in ((0, base), (base, 0)):
        ahead, a = at(row + dr, column + dc)
        back, b = at(row - dr, column - dc)
        # one-sided if the other side is another surface
        span = np.where(a[:, None], ahead, here) - np.where(b[:, None], back, here)
        spans.append(span)
        smooth &= a & b
    normals = np.cross(spans[1], spans[0])
    length = np.linalg.norm(normals, axis=1)
    flat = length < 1e-9
    facing = -here / np.maximum(np.linalg.norm(here, axis=1, keepdims=True), 1e-9)
    normals = np.where(flat[:, None], facing, normals / np.maximum(length, 1e-9)[:, None])
    normals *= np.where((normals * here).sum(1) > 0, -1.0, 1.0)[:, None]
    return here, normals.astype(np.float32), ~smooth
