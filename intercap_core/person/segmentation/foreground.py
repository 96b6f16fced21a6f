"""Background subtraction in depth images: foreground, and the background it is measured against.

The scene's background is the farthest depth that a pixel holds steadily. Where nothing behind can
be measured, or a thing leaves its place for a short while only, that depth is of the thing itself:
the pixel then sometimes shows something farther, or nothing at all. Such pixels are taken out of
the background.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Camera
from intercap_core.person.segmentation.constants import (
    BEFORE_MM,
    BEFORE_PER_DEPTH,
    EDGE_PX,
    FLOATING_MM,
    GONE_SHARE,
    MAX_DEPTH_SAMPLES,
)

_NO_DEPTH = np.float32(65535)


@dataclass(frozen=True, eq=False)
class DepthBackground:
    """The static scene of one depth camera.

    ``depth`` (H, W) uint16 mm of the background, 0 = unknown; ``reach`` (H, W) uint16 mm, the
    farthest that is of interest; ``limit`` (H, W) uint16 mm: what is measured nearer stands before
    the background.
    """

    depth: np.ndarray
    reach: np.ndarray
    limit: np.ndarray

    @classmethod
    def of(
        cls, background: np.ndarray, images: list[np.ndarray], reach_mm: np.ndarray
    ) -> DepthBackground:
        """From the scene's ``background`` (H, W) uint16 mm and samples of the recording.

        ``reach_mm`` (H, W): nothing farther is of interest.
        """
        tolerance = (BEFORE_MM + BEFORE_PER_DEPTH * background).astype(np.uint16)
        behind = background + tolerance
        gone = np.zeros(background.shape, np.uint8)
        for image in images:
            absent = ((image == 0) | (image > behind)).view(np.uint8)
            gone += cv2.medianBlur(absent, 5)  # single pixels fail now and then
        often = (gone >= max(2, GONE_SHARE * len(images))).view(np.uint8)
        # along the edges of furniture, pixels fail for most of a recording
        not_static = cv2.morphologyEx(often, cv2.MORPH_OPEN, np.ones((EDGE_PX, EDGE_PX), np.uint8))
        depth = np.where(not_static > 0, 0, background).astype(np.uint16)
        near = np.maximum(depth - (BEFORE_MM + BEFORE_PER_DEPTH * depth), 0)
        limit = np.where(depth > 0, near, reach_mm)
        return cls(depth, reach_mm, np.minimum(limit, reach_mm).astype(np.uint16))

    def before(self, image: np.ndarray) -> np.ndarray:
        """Flat pixels (N,) of a depth image (H, W) uint16 mm that stand before the background.

        Also those whose background nobody knows. Pixels that float at an edge are left out.
        """
        found = (image > 0) & (image < self.limit)
        index = np.flatnonzero(found)
        if not len(index):
            return index
        rows = np.flatnonzero(found.any(1))
        columns = np.flatnonzero(found.any(0))
        window = np.s_[max(rows[0] - 1, 0) : rows[-1] + 2, max(columns[0] - 1, 0) : columns[-1] + 2]
        floats = np.zeros(image.shape, bool)
        floats[window] = _floating(image[window])
        return index[~floats.ravel()[index]]

    def shows(self, image: np.ndarray) -> np.ndarray:
        """Pixels (H, W) bool in which the image (H, W) uint16 mm shows the background."""
        away = cv2.absdiff(image, self.depth)
        return (self.depth > 0) & (away <= BEFORE_MM + BEFORE_PER_DEPTH * self.depth)


def _floating(image: np.ndarray) -> np.ndarray:
    block = np.ones((3, 3), np.uint8)
    values = image.astype(np.float32)
    farthest = cv2.dilate(values, block)
    nearest = cv2.erode(np.where(image == 0, _NO_DEPTH, values), block)
    return (values - nearest > FLOATING_MM) & (farthest - values > FLOATING_MM)


def sampled_images(frames: Frames, c: int) -> list[np.ndarray]:
    """Evenly spread depth images (H, W) uint16 mm of camera ``c``, at most MAX_DEPTH_SAMPLES."""
    sets = np.flatnonzero(frames.depth_available[:, c])
    if len(sets) > MAX_DEPTH_SAMPLES:
        sets = sets[np.linspace(0, len(sets) - 1, MAX_DEPTH_SAMPLES).round().astype(int)]
    images = (frames.depth(int(t), c) for t in sets)
    return [image for image in images if image is not None]


@dataclass(frozen=True, eq=False)
class DepthView:
    """A depth camera's pixels as points of a given frame.

    ``camera``; ``bias_m`` is subtracted from its depth; ``target_from_depth`` (4, 4).
    """

    camera: Camera
    bias_m: float
    target_from_depth: np.ndarray

    def points(self, image: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (N, 3) float32 of flat pixels: in the target frame, and in the depth camera's.

        NaN where the lens' calibration does not hold.
        """
        z = image.ravel()[index] * np.float32(1e-3) - np.float32(self.bias_m)
        local = self._rays[index] * z[:, None]
        return local @ self._rotation.T + self.target_from_depth[:3, 3].astype(np.float32), local

    def reach_mm(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Depth (H, W) uint16 at which each pixel's ray leaves a box of the target frame, 0 = it
        misses the box; ``low``, ``high`` (3,) metres."""
        lens = self.camera.depth
        assert lens is not None
        along = self._rays @ self._rotation.T
        eye = self.target_from_depth[:3, 3]
        enters = np.zeros(len(along), np.float32)
        leaves = np.full(len(along), np.inf, np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            for axis in range(3):
                one = np.float32(low[axis] - eye[axis]) / along[:, axis]
                other = np.float32(high[axis] - eye[axis]) / along[:, axis]
                np.maximum(enters, np.minimum(one, other), out=enters)
                np.minimum(leaves, np.maximum(one, other), out=leaves)
        reach = np.where(leaves > enters, 1e3 * (leaves + self.bias_m), 0)  # False for NaN
        return np.minimum(reach, 65535).astype(np.uint16).reshape(lens.height, lens.width)

    @cached_property
    def _rotation(self) -> np.ndarray:
        return self.target_from_depth[:3, :3].astype(np.float32)

    @cached_property
    def _rays(self) -> np.ndarray:
        """(H * W, 3) float32, z = 1."""
        assert self.camera.depth is not None
        rays = self.camera.depth.rays.reshape(-1, 2)
        return np.concatenate([rays, np.ones((len(rays), 1), np.float32)], 1)
