"""What one frame set shows of the object: reduced masks and depth of every view."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from intercap_core.camera.intrinsics import Intrinsics
from intercap_core.camera.rig import Camera
from intercap_core.tracking.blobs import without_person
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

    # Computed once: a fit asks for them thousands of times.

    @cached_property
    def colour_from_master(self) -> np.ndarray:
        """(4, 4) of the camera."""
        return np.ascontiguousarray(self.camera.colour_from_master)

    @cached_property
    def master_from_colour(self) -> np.ndarray:
        """(4, 4) of the camera."""
        return np.ascontiguousarray(self.camera.master_from_colour)

    @cached_property
    def master_from_depth(self) -> np.ndarray:
        """(4, 4) of the camera, which has depth."""
        return np.ascontiguousarray(self.camera.master_from_depth)

    @cached_property
    def depth_from_master(self) -> np.ndarray:
        """(4, 4) of the camera, which has depth."""
        return np.ascontiguousarray(self.camera.depth_from_master)

    @cached_property
    def depth_from_colour(self) -> np.ndarray:
        """(4, 4) of the camera, which has depth."""
        return self.depth_from_master @ self.master_from_colour


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

        A candidate is (index, label, score, RLE); one that holds the person beside something else
        is there a second time without the person. Raises ValueError where a mask does not fit the
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
        parts = tuple(
            replace(candidate, mask=part)
            for candidate in found
            if (part := without_person(candidate.mask, person, step)) is not None
        )
        return cls(geometry, depth, person, found + parts, detected)
