"""Depth points of one frame that the segmentation assigns to the person or the object."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.evaluation.proximity import DEEPEST_M
from intercap_core.formats.detections.read import Detections
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.mask_pixels import mask_pixels, mask_window
from intercap_core.geometry.camera.masks import Runs
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply
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
    local = apply(camera.depth_from_master, np.asarray(near, np.float64))
    local = local[lens.inside_model(local)]
    if not len(local):  # the camera sees none of the points
        return points
    pixels, (nearest, farthest) = lens.project(local), (local[:, 2].min(), local[:, 2].max())
    margin = lens.fx * DEEPEST_M / max(nearest, DEEPEST_M)
    low, high = np.floor(pixels.min(0) - margin), np.ceil(pixels.max(0) + margin)
    for place, runs in enumerate(masks):
        window = None if runs is None else mask_window(depth, camera, runs)
        if runs is None or window is None:
            continue
        index = mask_pixels(depth, camera, runs, window)
        row, column = np.divmod(index, depth.shape[1])
        around = (low[0] <= column) & (column <= high[0]) & (low[1] <= row) & (row <= high[1])
        index = index[around]
        z = depth.ravel()[index]
        near_enough = (z > 1e3 * max(nearest - DEEPEST_M, 0.0)) & (z < 1e3 * (farthest + DEEPEST_M))
        points[place] = _placed(camera, lens, index[near_enough], z[near_enough], bias_m)
    return points


def _placed(
    camera: Camera, lens: Intrinsics, index: np.ndarray, depth: np.ndarray, bias_m: float
) -> np.ndarray:
    """Points (N, 3) float32, master frame, of flat pixels ``index`` (M,) with ``depth`` (M,) mm.

    Pixels whose ray is unknown have none.
    """
    z = depth * np.float32(1e-3)
    z *= 1 - np.float32(bias_m) / z
    x, y = (lens.rays.reshape(-1, 2)[index] * z[:, None]).T
    pose = camera.master_from_depth[:3].astype(np.float32)
    return np.stack([a * x + b * y + c * z + d for a, b, c, d in pose], 1)[np.isfinite(x)]


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
