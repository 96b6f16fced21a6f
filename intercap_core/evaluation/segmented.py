"""Depth points of one frame that the segmentation assigns to the person or the object."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numba
import numpy as np

from intercap_core import artefacts
from intercap_core.evaluation.proximity import DEEPEST_M
from intercap_core.formats.detections.read import Detections
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.mask_pixels import mask_pixels, mask_window
from intercap_core.geometry.camera.masks import Runs
from intercap_core.geometry.camera.projection import MIN_DEPTH_M
from intercap_core.geometry.camera.projection_kernels import project_point
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.schemas import OBJECT_TRACK, PERSON


def segmented_points(
    depth: np.ndarray, camera: Camera, masks: Sequence[Runs | None], near: np.ndarray, bias_m: float
) -> list[np.ndarray]:
    """Points (N, 3) float32 of each mask, master frame, metres.

    A depth point belongs to a mask if the mask covers its projection into the colour image. Only
    depth pixels are used that lie within :data:`DEEPEST_M` of the box, in image and depth, of the
    points ``near``.

    Args:
        depth: (H, W) uint16 depth image, millimetres.
        masks: masks of the colour image; None = no points.
        near: (M, 3) mesh points, master frame.
        bias_m: subtracted from the depth along the ray.
    """
    points = [np.empty((0, 3), np.float32) for _ in masks]
    lens = camera.depth
    if lens is None:
        return points
    least, most = _extent(
        np.asarray(near, np.float64), camera.depth_from_master, tuple(lens.parameters.tolist())
    )
    if not np.isfinite(least[2]):  # the camera sees none of the points
        return points
    margin = lens.fx * DEEPEST_M / max(float(least[2]), DEEPEST_M)
    low, high = np.floor(least[:2] - margin), np.ceil(most[:2] + margin) + 1
    for place, runs in enumerate(masks):
        window = None if runs is None else mask_window(depth, camera, runs)
        if runs is None or window is None:
            continue
        points[place] = _placed(
            depth,
            mask_pixels(depth, camera, runs, window),
            lens.rays,
            (int(low[0]), int(low[1])),
            (int(high[0]), int(high[1])),
            1e3 * max(float(least[2]) - DEEPEST_M, 0.0),
            1e3 * (float(most[2]) + DEEPEST_M),
            camera.master_from_depth.astype(np.float32),
            np.float32(bias_m),
        )
    return points


def read_person_masks(person: Path) -> list[list[bytes]]:
    """Person masks (T, C) as COCO RLE bytes; empty if an image has none."""
    with artefacts.read(person, PERSON) as people:
        masks = artefacts.unpack_ragged(people["mask_offsets"], people["mask_rle"])
        sets, cameras = people["person"].shape
    return [masks[t * cameras : (t + 1) * cameras] for t in range(sets)]


class SegmentedClouds:
    """Points of person and object in every frame, over all views.

    Args:
        frames: images by the moment that they show (:meth:`Frames.showing`).
        person_masks: (T, C) COCO RLE bytes, empty = no mask.
        candidate_masks: (T, C) masks of the candidates that the object's track kept; None if the
            object's points are not needed.
        depth_bias: (C,) depth bias of each camera, metres.
    """

    def __init__(
        self,
        frames: Frames,
        rig: Rig,
        person_masks: list[list[bytes]],
        candidate_masks: list[list[bytes]] | None,
        depth_bias: np.ndarray,
    ) -> None:
        self._frames = frames
        self._rig = rig
        self._masks = (person_masks, candidate_masks)
        self._bias = depth_bias

    def at(self, t: int, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (N, 3) of the person and of the object in frame ``t``, master frame, metres.

        ``near``: (M, 3) mesh points; see :func:`segmented_points`.
        """
        person, object_ = [], []
        for c, camera in enumerate(self._rig):
            depth = self._frames.depth(t, c)
            if depth is None:
                continue
            colour = camera.colour
            runs = [
                Runs(masks[t][c], colour.height, colour.width) if masks and masks[t][c] else None
                for masks in self._masks
            ]
            found = segmented_points(depth, camera, runs, near, float(self._bias[c]))
            person.append(found[0])
            object_.append(found[1])
        if not person:
            return np.empty((0, 3), np.float32), np.empty((0, 3), np.float32)
        return np.concatenate(person), np.concatenate(object_)


def read_clouds(
    images: Frames,
    rig: Rig,
    depth_bias: np.ndarray,
    image_of: np.ndarray,
    *,
    detections: Path,
    person: Path,
    object_track: Path,
) -> SegmentedClouds:
    """Segmented clouds of a sequence, from its detections, person and object track.

    Args:
        images: colour and depth, ordered by the moment that they show.
        depth_bias: (C,) metres.
        image_of: (T, C) frame set whose image shows each moment; -1 = none.
        detections, person, object_track: artefacts of the sequence.
    """
    found = Detections.load(detections).showing(image_of).with_candidates_of(person)
    with artefacts.read(object_track, OBJECT_TRACK) as track:
        kept = track["candidate"]
    total, cameras = kept.shape
    candidates = [
        [found.candidates(t, c)[kept[t, c]].rle if kept[t, c] >= 0 else b"" for c in range(cameras)]
        for t in range(total)
    ]
    return SegmentedClouds(images, rig, read_person_masks(person), candidates, depth_bias)


@numba.njit(cache=True, nogil=True)
def _extent(points, pose, lens):
    """Range (2,3) of the projected points: minimum and maximum of column, row and depth (metres).

    Points behind the camera or outside the lens calibration are ignored; without others the minimum
    is infinite. All arrays are float64.

    Args:
        points: (M,3).
        pose: (4,4) camera_from_points.
        lens: (13,) lens parameters; the last one is the largest calibrated radius at z = 1.
    """
    found = np.empty((2, 3))
    found[0], found[1] = np.inf, -np.inf
    limit = lens[12]
    place = np.empty(3)
    for point in points:
        for k in range(3):
            place[k] = pose[k, 3]
            for m in range(3):
                place[k] += pose[k, m] * point[m]
        x, y, z = place
        if not (z > MIN_DEPTH_M and x * x + y * y <= (limit * z) ** 2):
            continue
        u, v = project_point(x, y, z, lens)
        for k, value in enumerate((u, v, z)):
            found[0, k], found[1, k] = min(found[0, k], value), max(found[1, k], value)
    return found


@numba.njit(cache=True, nogil=True)
def _placed(depth, index, rays, low, high, nearest, farthest, pose, bias):
    """Points (N,3) float32 of the pixels within a window and a range of depths.

    Args:
        depth: (H,W) uint16, millimetres.
        index: (M,) flat pixel indices.
        rays: (H,W,2) ray directions; pixels without a finite ray are skipped.
        low, high: first column and row, and column and row after the last.
        nearest, farthest: range of depths, exclusive, millimetres.
        pose: (4,4) float32, points_from_camera.
        bias: metres, subtracted from the depth along the ray.
    """
    width = depth.shape[1]
    points = np.empty((len(index), 3), np.float32)
    count = 0
    for flat in index:
        row, column = flat // width, flat % width
        if not (low[0] <= column < high[0] and low[1] <= row < high[1]):
            continue
        measured = depth[row, column]
        if not nearest < measured < farthest:
            continue
        across, down = rays[row, column]
        if not np.isfinite(across):
            continue
        z = np.float32(measured) * np.float32(1e-3)
        z *= np.float32(1) - bias / z
        x, y = across * z, down * z
        for k in range(3):
            points[count, k] = pose[k, 0] * x + pose[k, 1] * y + pose[k, 2] * z + pose[k, 3]
        count += 1
    return points[:count].copy()
