"""What one frame set shows of the object: reduced masks and depth of every view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera
from intercap_core.object_track.blobs import without_person
from intercap_core.object_track.constants import (
    MAX_REDUCTION,
    REDUCED_DEPTH_PX,
    REDUCED_SILHOUETTE_PX,
    TYPICAL_DISTANCE_M,
)
from intercap_core.object_track.reduced_mask import EMPTY, ReducedMask, decode, reduced_lens


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
        distance_m: float = TYPICAL_DISTANCE_M,
    ) -> ViewGeometry:
        """Choose the reduction by how large the object appears where it mostly is.

        Metres: ``diameter_m`` of the object, ``distance_m`` of it from the camera.
        """
        angle = diameter_m / distance_m
        step = _step(camera.colour.fx, angle, REDUCED_SILHOUETTE_PX)
        depth_step = _step(camera.depth.fx, angle, REDUCED_DEPTH_PX) if camera.depth else 1
        return cls(
            camera,
            reduced_lens(camera.colour, step),
            step,
            reduced_lens(camera.depth, depth_step) if camera.depth else None,
            depth_step,
            depth_bias_m,
            time_offset_s,
        )

    def corrected(self, camera: Camera, depth_bias_m: float, time_offset_s: float) -> ViewGeometry:
        """The same lenses at the pose of ``camera``, with another depth bias and exposure."""
        return replace(self, camera=camera, depth_bias_m=depth_bias_m, time_offset_s=time_offset_s)

    def reduced_depth(self, depth_mm: np.ndarray) -> np.ndarray:
        """Depth (H, W) uint16 mm on the reduced grid: float32 metres, bias removed, 0 invalid."""
        raw = depth_mm[:: self.depth_step, :: self.depth_step]
        depth = raw * np.float32(1e-3) - np.float32(self.depth_bias_m)
        depth[raw == 0] = 0
        return depth

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


def distances(cameras: Sequence[Camera], joints: np.ndarray) -> list[float]:
    """How far (metres) each camera is from what happens: from the person's joints (T, K, 3),
    master frame, NaN where unknown; :data:`TYPICAL_DISTANCE_M` where no joint is known."""
    places = joints[np.isfinite(joints).all(-1)]
    if not len(places):
        return [TYPICAL_DISTANCE_M] * len(cameras)
    eyes = [camera.master_from_colour[:3, 3] for camera in cameras]
    return [float(np.median(np.linalg.norm(places - eye, axis=1))) for eye in eyes]


def _step(focal_px: float, angle: float, wanted_px: int) -> int:
    return int(np.clip(round(focal_px * angle / wanted_px), 1, MAX_REDUCTION))


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
    where there is no depth image. ``background`` the same of the empty room, (0, 0) where that is
    not known. ``detected``: whether candidates are known for this image.
    """

    geometry: ViewGeometry
    depth: np.ndarray | None
    person: ReducedMask
    candidates: tuple[Candidate, ...]
    detected: bool = True
    background: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.float32))

    def through(self, geometry: ViewGeometry) -> View:
        """The same image through :meth:`ViewGeometry.corrected` geometry."""

        def nearer(depth: np.ndarray) -> np.ndarray:
            by = np.float32(geometry.depth_bias_m - self.geometry.depth_bias_m)
            return np.where(depth > 0, depth - by, 0) if by else depth

        return replace(
            self,
            geometry=geometry,
            depth=None if self.depth is None else nearer(self.depth),
            background=nearer(self.background),
        )

    @property
    def nbytes(self) -> int:
        """Memory of the images."""
        masks = [self.person, *(candidate.mask for candidate in self.candidates)]
        depth = 0 if self.depth is None else self.depth.nbytes
        return depth + sum(mask.mask.nbytes for mask in masks)

    @classmethod
    def build(
        cls,
        geometry: ViewGeometry,
        depth_mm: np.ndarray | None,
        person_rle: bytes,
        candidates: list[tuple[int, str, float, bytes]],
        detected: bool = True,
        background: np.ndarray | None = None,
    ) -> View:
        """Reduce one image's depth (H, W) uint16 mm, person mask and candidates.

        A candidate is (index, label, score, RLE); one that holds the person beside something else
        is there a second time without the person. ``background`` (h, w) is reduced already
        (:meth:`ViewGeometry.reduced_depth`). Raises ValueError where a mask does not fit the image.
        """
        depth = None if depth_mm is None else geometry.reduced_depth(depth_mm)
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
        room = np.zeros((0, 0), np.float32) if background is None else background
        return cls(geometry, depth, person, found + parts, detected, room)
