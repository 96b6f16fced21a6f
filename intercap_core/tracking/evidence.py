"""What one frame set shows of the object: reduced masks and depth of every view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.camera.intrinsics import Intrinsics
from intercap_core.camera.rig import Camera
from intercap_core.camera.transforms import apply
from intercap_core.tracking.reduced_mask import EMPTY, ReducedMask, decode, reduced_lens

# The object is compared at about this many pixels: more cost time and carry no more information,
# since neighbouring pixels of a mask or a depth image err together.
SILHOUETTE_PX = 110
DEPTH_PX = 80
TYPICAL_DISTANCE_M = 2.5  # of the object from a camera of a capture ring
MAX_STEP = 4


@dataclass(frozen=True, eq=False)
class ViewGeometry:
    """A camera with its reduced lenses; pixel (i, j) of a reduced image is (i, j) * step.

    It exposes ``time_offset_s`` later than the frame set's time.
    """

    camera: Camera
    lens: Intrinsics
    step: int
    depth_lens: Intrinsics | None
    depth_step: int
    depth_bias_m: float = 0.0
    time_offset_s: float = 0.0

    @classmethod
    def for_object(
        cls,
        camera: Camera,
        diameter_m: float,
        depth_bias_m: float = 0.0,
        time_offset_s: float = 0.0,
    ) -> ViewGeometry:
        """Choose the reduction by how large the object appears at a typical distance."""
        step = _step(camera.colour.fx, diameter_m, SILHOUETTE_PX)
        depth_step = _step(camera.depth.fx, diameter_m, DEPTH_PX) if camera.depth else 1
        return cls(
            camera,
            reduced_lens(camera.colour, step),
            step,
            reduced_lens(camera.depth, depth_step) if camera.depth else None,
            depth_step,
            depth_bias_m,
            time_offset_s,
        )


def _step(focal_px: float, diameter_m: float, wanted_px: int) -> int:
    return int(np.clip(round(focal_px * diameter_m / TYPICAL_DISTANCE_M / wanted_px), 1, MAX_STEP))


@dataclass(frozen=True, eq=False)
class Candidate:
    """One segmentation candidate of an image; ``index`` is its place in the detections."""

    index: int
    label: str
    score: float
    mask: ReducedMask


@dataclass(frozen=True, eq=False)
class View:
    """One image of a frame set: what the tracker uses of it.

    ``depth`` (h, w) float32 metres on the reduced depth grid, bias removed, 0 where invalid; None
    where there is no depth image. ``detected``: whether candidates are known for this image.
    """

    geometry: ViewGeometry
    depth: np.ndarray | None
    person: ReducedMask
    candidates: tuple[Candidate, ...]
    detected: bool = True

    @classmethod
    def build(
        cls,
        geometry: ViewGeometry,
        depth_mm: np.ndarray | None,
        person_rle: bytes,
        candidates: list[tuple[int, str, float, bytes]],
        detected: bool = True,
    ) -> View:
        """Reduce one image's depth (H, W) uint16 mm, person mask and candidates.

        A candidate is (index, label, score, RLE). Raises ValueError where a mask does not fit the
        image.
        """
        depth = None
        if depth_mm is not None:
            step = geometry.depth_step
            raw = depth_mm[::step, ::step]
            depth = raw * np.float32(1e-3) - np.float32(geometry.depth_bias_m)
            depth[raw == 0] = 0
        colour, step = geometry.camera.colour, geometry.step
        found = tuple(
            Candidate(index, label, score, decode(rle, colour, step))
            for index, label, score, rle in candidates
        )
        person = decode(person_rle, colour, step) if person_rle else EMPTY
        return cls(geometry, depth, person, found, detected)


@dataclass(frozen=True, eq=False)
class DepthPatch:
    """Measured points around the object in one view, on a window of the reduced depth grid.

    ``depth`` (h, w) metres, 0 invalid; ``points`` (h, w, 3) float32, master frame; ``pixel``
    (h, w, 2) int64, the reduced colour pixel (x, y) that shows the point, far outside where none.
    """

    x0: int
    y0: int
    depth: np.ndarray
    points: np.ndarray
    pixel: np.ndarray

    @classmethod
    def cut(cls, view: View, x0: int, y0: int, x1: int, y1: int) -> DepthPatch | None:
        """Cut reduced depth pixels [x0, x1) x [y0, y1); None where none is in the image."""
        geometry = view.geometry
        lens = geometry.depth_lens
        if view.depth is None or lens is None:
            return None
        height, width = view.depth.shape
        x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, width), min(y1, height)
        if x0 >= x1 or y0 >= y1:
            return None
        depth = view.depth[y0:y1, x0:x1]
        rays = lens.rays[y0:y1, x0:x1]
        depth = np.where(np.isfinite(rays[..., 0]), depth, 0)
        local = np.empty((*depth.shape, 3), np.float32)
        local[..., :2] = np.where(depth[..., None] > 0, rays, 0) * depth[..., None]
        local[..., 2] = depth
        camera = geometry.camera
        assert camera.colour_from_depth is not None
        in_colour = apply(camera.colour_from_depth, local.reshape(-1, 3))
        pixel = np.rint(geometry.lens.project(in_colour)).astype(np.int64)
        pixel[depth.ravel() <= 0] = -(1 << 20)
        points = apply(camera.master_from_depth, local.reshape(-1, 3))
        return cls(x0, y0, depth, points.reshape(*depth.shape, 3), pixel.reshape(*depth.shape, 2))

    def sample(self, mask: ReducedMask) -> np.ndarray:
        """A colour mask on this window: (h, w) bool."""
        found = mask.sample(self.pixel[..., 0].ravel(), self.pixel[..., 1].ravel())
        return found.reshape(self.depth.shape)
