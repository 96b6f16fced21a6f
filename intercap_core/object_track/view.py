"""The images of a frame set as the tracker uses them: reduced masks and depth of every view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import Renderer, default_renderer
from intercap_core.object_track.reduced_mask import ReducedMask, decode, reduced_lens, remove_person


@dataclass(frozen=True, eq=False)
class DepthImage:
    """A reduced depth image as recorded, read by windows in metres without bias."""

    millimetres: np.ndarray
    """(h, w) uint16, 0 where invalid."""
    bias_m: float
    """Systematic error that is subtracted, metres."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Height and width."""
        return self.millimetres.shape

    def __getitem__(self, window: tuple[slice, slice]) -> np.ndarray:
        """Return depth in a window, float32 metres, 0 where invalid."""
        recorded = self.millimetres[window]
        depth = recorded * np.float32(1e-3) - np.float32(self.bias_m)
        depth[recorded == 0] = 0
        return depth


@dataclass(frozen=True, eq=False)
class ViewGeometry:
    """A camera with its reduced lenses; pixel (i, j) of a reduced image is pixel (i, j) * step."""

    camera: Camera
    """Camera at full resolution."""
    lens: Intrinsics
    """Reduced colour lens."""
    step: int
    """Reduction of the colour image."""
    depth_lens: Intrinsics | None
    """Reduced depth lens; None without a depth camera."""
    depth_step: int
    """Reduction of the depth image."""
    depth_bias_m: float = 0.0
    """Systematic error that is subtracted from the measured depth, metres."""
    time_offset_s: float = 0.0
    """Exposure after the time of the frame set, seconds."""

    @classmethod
    def for_object(
        cls,
        camera: Camera,
        diameter_m: float,
        distance_m: float,
        depth_bias_m: float = 0.0,
        time_offset_s: float = 0.0,
    ) -> ViewGeometry:
        """Choose the reduction by the apparent size of the object.

        The object is compared at about 80 pixels across in colour and 60 in depth. More cost time
        and carry no more information, since neighbouring pixels of an image err together.

        Args:
            camera: the camera.
            diameter_m: diameter of the object, metres.
            distance_m: usual distance of the object from the camera, metres.
            depth_bias_m: as the field.
            time_offset_s: as the field.
        """
        angle = diameter_m / distance_m
        step = _step(camera.colour.fx, angle, 80)
        depth_step = _step(camera.depth.fx, angle, 60) if camera.depth else 1
        return cls(
            camera,
            reduced_lens(camera.colour, step),
            step,
            reduced_lens(camera.depth, depth_step) if camera.depth else None,
            depth_step,
            depth_bias_m,
            time_offset_s,
        )

    def reduced_depth(self, depth_mm: np.ndarray) -> DepthImage:
        """Reduce depth (H, W) uint16 mm."""
        reduced = depth_mm[:: self.depth_step, :: self.depth_step]
        return DepthImage(np.ascontiguousarray(reduced), self.depth_bias_m)

    @cached_property
    def depth_from_colour(self) -> np.ndarray:
        """(4, 4); the camera must have depth. Cached, because fits read it often."""
        return self.camera.depth_from_master @ self.camera.master_from_colour


def camera_distances(cameras: Sequence[Camera], joints: np.ndarray) -> list[float]:
    """Return the median distance of each camera from the person's joints, metres.

    Args:
        cameras: C cameras.
        joints: (T, K, 3) of the person, master frame, NaN where unknown. If no joint is known, all
            distances are 2.5 m, as usual in a capture ring.
    """
    places = joints[np.isfinite(joints).all(-1)]
    if not len(places):
        return [2.5] * len(cameras)
    eyes = [camera.master_from_colour[:3, 3] for camera in cameras]
    return [float(np.median(np.linalg.norm(places - eye, axis=1))) for eye in eyes]


def _step(focal_px: float, angle: float, wanted_px: int) -> int:
    return int(np.clip(round(focal_px * angle / wanted_px), 1, 4))


@dataclass(frozen=True, eq=False)
class MaskCandidate:
    """One segmentation candidate of an image."""

    index: int
    """Index in the detections of the image."""
    label: str
    """Class name, empty if the detector names none."""
    mask: ReducedMask
    """Reduced mask."""


@dataclass(frozen=True, eq=False)
class View:
    """One image of a frame set."""

    geometry: ViewGeometry
    """Camera and reduced lenses."""
    depth: DepthImage | None
    """Depth on the reduced grid; None without depth."""
    person: ReducedMask
    """Mask of the person."""
    candidates: tuple[MaskCandidate, ...]
    """Candidates, each with its reduced mask."""
    detected: bool = True
    """Whether the detector processed this image, so that the absence of candidates is evidence."""
    background: DepthImage | None = None
    """Depth of the empty room in the form of ``depth``; None if unknown."""

    def through(self, geometry: ViewGeometry) -> View:
        """Return the same image with another camera pose, depth bias and time offset."""
        bias = geometry.depth_bias_m
        return replace(
            self,
            geometry=geometry,
            depth=self.depth and replace(self.depth, bias_m=bias),
            background=self.background and replace(self.background, bias_m=bias),
        )

    @property
    def nbytes(self) -> int:
        """Memory of depth and masks, bytes; frames share the background."""
        masks = [self.person, *(candidate.mask for candidate in self.candidates)]
        depth = 0 if self.depth is None else self.depth.millimetres.nbytes
        return depth + sum(mask.mask.nbytes for mask in masks)

    @classmethod
    def build(
        cls,
        geometry: ViewGeometry,
        depth_mm: np.ndarray | None,
        person_rle: bytes,
        candidates: list[tuple[int, str, bytes]],
        detected: bool = True,
        background: DepthImage | None = None,
    ) -> View:
        """Reduce one image.

        A candidate that contains the person and something else is added a second time without the
        person. Raises ValueError if a mask does not fit the image.

        Args:
            depth_mm: (H, W) uint16 mm; None without a depth image.
            person_rle: mask of the person, COCO compressed RLE.
            candidates: (index, label, RLE) of each candidate.
            geometry, detected, background: as the fields.
        """
        depth = None if depth_mm is None else geometry.reduced_depth(depth_mm)
        colour, step = geometry.camera.colour, geometry.step
        whole = tuple(
            MaskCandidate(index, label, decode(rle, colour, step))
            for index, label, rle in candidates
        )
        person = decode(person_rle, colour, step)
        parts = tuple(
            replace(candidate, mask=part)
            for candidate in whole
            if (part := remove_person(candidate.mask, person, step)) is not None
        )
        return cls(geometry, depth, person, whole + parts, detected, background)


@dataclass(frozen=True)
class FitContext:
    """Object and settings that are the same in all fits and comparisons of one recording."""

    mesh: ObjectMesh
    """Mesh that is rendered."""
    labels: tuple[str, ...] = ()
    """Detector classes of the object; empty: any but a person."""
    min_overlap: float = 0.3
    """Smallest IoU with the render at which a fit uses a candidate."""
    background_term: bool = True
    """Whether fits penalise rendered pixels over known background (beyond the paper)."""
    renderer: Renderer = field(default_factory=default_renderer)
    """Draws the mesh, and runs the views in parallel."""
