"""Depth background of each camera, foreground against it, and removal of false background.

The background of the scene is the farthest depth that a pixel measures repeatedly. If nothing
behind is measured, or an object leaves its place only briefly, this depth belongs to the object.
False background is removed by three tests:

- The pixel sometimes measures something farther, or nothing.
- Another camera measures its background farther along the same line of sight, so that it has seen
  free space there (space carving).
- Small patches lie inside the person's body for much of the recording.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.person.segmentation.person_volume import distance_outside

# Nearer than the background by this stands before it: five standard deviations of the sensor's
# random error and its bias between images (Toelgyessy et al., Sensors 21(2):413, 2021).
BEFORE_MM, BEFORE_PER_DEPTH = 15.0, 0.005
FLOATING_MM = (
    30.0  # a pixel so far from nearer and from farther neighbours is a flying pixel; tuned
)
EDGE_PX = 5  # background that is lost in narrower strips is an edge that measures badly; tuned
GONE_SHARE = 0.08  # of images in which a pixel shows something else: it is not background; tuned
# The other camera's background is farther by this: calibration and the slope of grazing surfaces.
BEHIND_M, BEHIND_PER_DEPTH = 0.05, 0.01  # metres, share of depth; tuned on the studio
BEHIND_AROUND_PX = 5  # pixels all of which must be so far: edges of the background are uncertain
MIN_HOLE_PX = 5  # across, of what is taken out of a background; tuned on the studio
MIN_SURFACE_PX = 400  # smooth surfaces of at least so many pixels are no traces of a person; tuned
SMOOTH_MM = 100.0  # range of depth in 3 x 3 pixels of a smooth surface; tuned on the studio
TRACE_MARGINS, TRACE_SHARE = 1.0, 0.4  # within the person, at this share of moments: a trace; tuned
MAX_DEPTH_SAMPLES = 25  # images looked at for what leaves its place


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


_UNKNOWN = np.uint16(0)


def without_free_space(
    views: list[DepthView],
    backgrounds: list[DepthBackground],
    low: np.ndarray,
    high: np.ndarray,
) -> list[DepthBackground]:
    """The backgrounds without pixels whose points lie in free space of another camera.

    Only points in the box ``low`` to ``high`` (3,), metres, z up, are tested. A pixel becomes
    unknown where the point lies clearly before the other background, in patches of several pixels.
    """
    nearest = [
        cv2.erode(background.depth, np.ones((BEHIND_AROUND_PX, BEHIND_AROUND_PX), np.uint8))
        for background in backgrounds
    ]
    result = []
    for number, (view, background) in enumerate(zip(views, backgrounds, strict=True)):
        index = np.flatnonzero(background.depth)
        points, _ = view.points(background.depth, index)
        inside = ((points > low) & (points < high)).all(1)
        index, points = index[inside], points[inside]
        gone: np.ndarray = np.zeros(background.depth.shape, np.uint8)
        for other, far in enumerate(nearest):
            if other != number:
                gone.ravel()[index[_occludes_background(views[other], far, points)]] = 1
        block = np.ones((MIN_HOLE_PX, MIN_HOLE_PX), np.uint8)
        closed = cv2.morphologyEx(gone, cv2.MORPH_CLOSE, block)
        whole = cv2.morphologyEx(closed, cv2.MORPH_OPEN, block)
        result.append(_with_unknown(background, whole > 0))
    return result


def without_person_traces(
    view: DepthView, background: DepthBackground, bodies: list[np.ndarray]
) -> DepthBackground:
    """The background without small patches that lay inside the person for much of the time.

    ``bodies``: bones (B, 9) of :func:`.person_volume.bones_of` at some moments, view's frame.
    """
    depth = background.depth
    block = np.ones((3, 3), np.uint8)
    nearest = cv2.erode(depth.astype(np.float32), block)
    farthest = cv2.dilate(depth.astype(np.float32), block)
    smooth = ((nearest > 0) & (farthest - nearest < SMOOTH_MM)).view(np.uint8)
    _, label, stats, _ = cv2.connectedComponentsWithStats(smooth, connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= MIN_SURFACE_PX
    large[0] = False
    surface = cv2.dilate(large[label].view(np.uint8), block) > 0
    index = np.flatnonzero((depth > 0) & ~surface & (depth <= background.reach))
    points, _ = view.points(depth, index)
    inside = np.zeros(len(index))
    for bones in bodies:
        inside += distance_outside(points, bones) < TRACE_MARGINS
    trace = np.zeros(depth.shape, bool)
    trace.ravel()[index[inside > TRACE_SHARE * len(bodies)]] = True
    return _with_unknown(background, trace)


def _with_unknown(background: DepthBackground, gone: np.ndarray) -> DepthBackground:
    taken = gone & (background.depth > 0)
    depth = np.where(taken, _UNKNOWN, background.depth)
    limit = np.where(taken, background.reach, background.limit)
    return replace(background, depth=depth, limit=limit)


def _occludes_background(view: DepthView, nearest: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether points (N, 3) lie clearly nearer than the background ``nearest`` (H, W) mm of a view:
    (N,) bool."""
    lens = view.camera.depth
    assert lens is not None
    local = apply(invert(view.target_from_depth), points)
    seen = lens.sees(local)
    column, row = np.rint(np.where(seen[:, None], lens.project(local), 0)).astype(int).T
    column, row = np.clip(column, 0, lens.width - 1), np.clip(row, 0, lens.height - 1)
    behind = nearest[row, column] * np.float32(1e-3) - view.bias_m
    z = local[:, 2]
    return seen & (nearest[row, column] > 0) & (behind > z + BEHIND_M + BEHIND_PER_DEPTH * z)
