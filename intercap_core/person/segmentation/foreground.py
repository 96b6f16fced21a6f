"""Depth background of each camera, foreground against it, and removal of false background.

The background of the scene is the farthest depth that a pixel measures repeatedly. It is false if
the pixel never measures the surface behind an object or person. Three tests remove false
background (the pixel's background becomes unknown):

- The pixel sometimes measures something farther, or nothing.
- Another camera sees through the point to its own background, so the point is in free space (space
  carving).
- A small patch lies inside the person's body for much of the recording.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.solve.time_series import sample_evenly
from intercap_core.person.segmentation.person_volume import distance_outside


@dataclass(frozen=True, eq=False)
class DepthBackground:
    """Static scene of one depth camera; all arrays are (H, W) uint16, mm."""

    depth: np.ndarray
    """Depth of the background; 0 = unknown."""
    reach: np.ndarray
    """Depth at which the pixel's ray leaves the evaluated box; 0 = misses it."""
    limit: np.ndarray
    """Depth below which a measurement is foreground."""

    @classmethod
    def of(
        cls, background: np.ndarray, images: list[np.ndarray], reach_mm: np.ndarray
    ) -> DepthBackground:
        """Remove pixels from the scene's background that are not static.

        Args:
            background: (H, W) uint16 mm.
            images: at most 25 samples of the recording, (H, W) uint16 mm.
            reach_mm: (H, W) see :attr:`reach`.
        """
        behind = background + _tolerance(background).astype(np.uint16)
        gone = np.zeros(background.shape, np.uint8)
        for image in images:
            absent = ((image == 0) | (image > behind)).view(np.uint8)
            gone += cv2.medianBlur(absent, 5)  # removes single pixels without a measurement
        # in one image, a pixel may also lack a measurement by chance
        often = (gone >= 2).view(np.uint8)
        # narrow strips are edges of furniture, where measurements often fail: they stay background
        not_static = cv2.morphologyEx(often, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
        depth = np.where(not_static > 0, 0, background).astype(np.uint16)
        near = np.maximum(depth - _tolerance(depth), 0)
        limit = np.where(depth > 0, near, reach_mm)
        return cls(depth, reach_mm, np.minimum(limit, reach_mm).astype(np.uint16))

    def before(self, image: np.ndarray) -> np.ndarray:
        """Flat indices (N,) of the foreground pixels of a depth image (H, W), uint16 mm.

        They include pixels with an unknown background. Flying pixels (mixed measurements at depth
        edges) are left out.
        """
        foreground = (image > 0) & (image < self.limit)
        index = np.flatnonzero(foreground)
        if not len(index):
            return index
        rows = np.flatnonzero(foreground.any(1))
        columns = np.flatnonzero(foreground.any(0))
        window = np.s_[max(rows[0] - 1, 0) : rows[-1] + 2, max(columns[0] - 1, 0) : columns[-1] + 2]
        floats = np.zeros(image.shape, bool)
        floats[window] = _floating(image[window])
        return index[~floats.ravel()[index]]

    def shows(self, image: np.ndarray) -> np.ndarray:
        """Mask (H, W) of the pixels of an image (H, W), uint16 mm, that show the background."""
        away = cv2.absdiff(image, self.depth)
        return (self.depth > 0) & (away <= self._tolerance)

    @cached_property
    def _tolerance(self) -> np.ndarray:
        """Tolerance (H, W) of :attr:`depth` in whole millimetres, rounded down."""
        return _tolerance(self.depth).astype(np.uint16)


def _tolerance(depth: np.ndarray) -> np.ndarray:
    """Largest distance (H, W), mm, of a measurement from a background (H, W), mm, that it shows.

    Five standard deviations of a Kinect's random error and its bias between images (Toelgyessy et
    al., Sensors 21(2):413, 2021).
    """
    return 15.0 + 0.005 * depth


def _floating(image: np.ndarray) -> np.ndarray:
    """Mask (H, W) of flying pixels: more than 3 cm behind one neighbour and before another one."""
    block = np.ones((3, 3), np.uint8)
    values = image.astype(np.float32)
    farthest = cv2.dilate(values, block)
    nearest = cv2.erode(np.where(image == 0, np.float32(65535), values), block)
    return (values - nearest > 30.0) & (farthest - values > 30.0)  # tuned on the studio


def sampled_images(frames: Frames, c: int) -> list[np.ndarray]:
    """At most 25 depth images (H, W), uint16 mm, of camera ``c``, evenly spaced in time."""
    images = (frames.depth(int(t), c) for t in sample_evenly(frames.depth_available[:, c], 25))
    return [image for image in images if image is not None]


@dataclass(frozen=True, eq=False)
class DepthView:
    """Converts a depth camera's pixels to points of a target frame."""

    camera: Camera
    """A camera with depth."""
    bias_m: float
    """Subtracted from its depth, metres."""
    target_from_depth: np.ndarray
    """(4, 4) from the depth camera to the target frame."""

    def points(self, image: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (N, 3) float32, metres, in the target frame and in the depth camera's frame.

        NaN outside the range of the lens calibration.

        Args:
            image: (H, W) uint16 mm.
            index: (N,) flat pixel indices.
        """
        z = image.take(index) * np.float32(1e-3) - np.float32(self.bias_m)
        local = self._rays.take(index, 0) * z[:, None]
        return local @ self._rotation.T + self.target_from_depth[:3, 3].astype(np.float32), local

    def reach_mm(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Depth (H, W) uint16 mm at which each pixel's ray leaves a box; 0 = misses it.

        ``low``, ``high``: (3,) corners of the box in the target frame, metres.
        """
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


def in_box(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Mask (N,) of points (N, 3) between the corners ``low`` and ``high`` (3,) of a box."""
    x, y, z = ((points > low) & (points < high)).T  # a reduction of rows of three is slower
    return x & y & z


def without_free_space(
    views: list[DepthView], backgrounds: list[DepthBackground], low: np.ndarray, high: np.ndarray
) -> list[DepthBackground]:
    """Remove background pixels whose points another camera has seen through.

    A pixel becomes unknown if its point lies clearly before the background of another camera. Holes
    in the resulting mask are closed and patches smaller than 5 x 5 pixels dropped. Only points in
    the box ``low`` to ``high`` (3,), metres, z up, are tested.
    """
    nearest = [cv2.erode(background.depth, np.ones((5, 5), np.uint8)) for background in backgrounds]
    result = []
    for number, (view, background) in enumerate(zip(views, backgrounds, strict=True)):
        index = np.flatnonzero(background.depth)
        points, _ = view.points(background.depth, index)
        inside = in_box(points, low, high)
        index, points = index[inside], points[inside]
        gone: np.ndarray = np.zeros(background.depth.shape, np.uint8)
        for other, far in enumerate(nearest):
            if other != number:
                gone.ravel()[index[_occludes_background(views[other], far, points)]] = 1
        block = np.ones((5, 5), np.uint8)
        closed = cv2.morphologyEx(gone, cv2.MORPH_CLOSE, block)
        whole = cv2.morphologyEx(closed, cv2.MORPH_OPEN, block)
        result.append(_with_unknown(background, whole > 0))
    return result


def without_person_traces(
    view: DepthView, background: DepthBackground, bodies: list[np.ndarray]
) -> DepthBackground:
    """Remove background pixels that are inside the person at more than 40 % of the moments.

    Pixels of large smooth surfaces are kept: connected regions of at least 400 pixels in which
    depth varies by less than 10 cm within 3 x 3 pixels. All thresholds are tuned on the studio.

    ``bodies``: bones (B, 9) of :func:`.person_volume.build_bones` at some moments, in the view's
    frame.
    """
    depth = background.depth
    block = np.ones((3, 3), np.uint8)
    nearest = cv2.erode(depth.astype(np.float32), block)
    farthest = cv2.dilate(depth.astype(np.float32), block)
    smooth = ((nearest > 0) & (farthest - nearest < 100.0)).view(np.uint8)
    _, label, stats, _ = cv2.connectedComponentsWithStats(smooth, connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= 400
    large[0] = False
    surface = cv2.dilate(large[label].view(np.uint8), block) > 0
    index = np.flatnonzero((depth > 0) & ~surface & (depth <= background.reach))
    points, _ = view.points(depth, index)
    inside = np.zeros(len(index))
    for bones in bodies:
        inside += distance_outside(points, bones) < 1.0
    trace = np.zeros(depth.shape, bool)
    trace.ravel()[index[inside > 0.4 * len(bodies)]] = True
    return _with_unknown(background, trace)


def _with_unknown(background: DepthBackground, gone: np.ndarray) -> DepthBackground:
    """The background without the pixels ``gone`` (H, W) bool."""
    removed = gone & (background.depth > 0)
    depth = np.where(removed, np.uint16(0), background.depth)
    limit = np.where(removed, background.reach, background.limit)
    return replace(background, depth=depth, limit=limit)


def _occludes_background(view: DepthView, nearest: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Mask (N,) of points (N, 3) clearly nearer than a view's background ``nearest`` (H, W), mm."""
    lens = view.camera.depth
    assert lens is not None
    local = apply(invert(view.target_from_depth), points)
    seen = lens.sees(local)
    column, row = np.rint(np.where(seen[:, None], lens.project(local), 0)).astype(int).T
    column, row = np.clip(column, 0, lens.width - 1), np.clip(row, 0, lens.height - 1)
    behind = nearest[row, column] * np.float32(1e-3) - view.bias_m
    z = local[:, 2]
    # 5 cm and 1 % of depth, for calibration errors and grazing surfaces; tuned on the studio
    return seen & (nearest[row, column] > 0) & (behind > z + 0.05 + 0.01 * z)
