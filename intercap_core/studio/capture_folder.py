"""Base classes of a capture's folder: cameras that write their images, and a calibration.

Also aligns depth to the colour camera's pixel grid, as the Azure Kinect SDK does."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import cv2
import numba
import numpy as np

from intercap_core.config import StudioCapture, StudioFault
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera, Rig


class Aligner:
    """Aligns depth images of one device by its own calibration."""

    def __init__(self, camera: Camera) -> None:
        if camera.depth is None or camera.colour_from_depth is None:
            raise ValueError(f"camera {camera.name} has no depth")
        self._lens, pose = camera.colour, camera.colour_from_depth
        rays = camera.depth.rays
        ahead = np.ones((*rays.shape[:2], 1))
        self._direction = np.concatenate([rays, ahead], -1) @ pose[:3, :3].T
        self._shift = pose[:3, 3]
        self._usable = np.isfinite(rays[..., 0])

    def align(self, depth: np.ndarray) -> np.ndarray:
        """Depth (H, W) uint16 mm to the colour grid (Hc, Wc) uint16 mm, z of the colour camera.

        The depth image is treated as a mesh of two triangles between four neighbouring pixels.
        The nearest surface wins; surfaces that only the colour camera sees stay 0.
        """
        known = (depth > 0) & self._usable
        points = self._direction[known] * (depth[known] * 1e-3)[:, None] + self._shift
        pixels = np.full((*depth.shape, 2), np.nan, np.float32)
        z = np.zeros(depth.shape, np.float32)
        pixels[known], z[known] = self._lens.project(points), points[:, 2]
        aligned = np.full((self._lens.height, self._lens.width), np.inf, np.float32)
        _warp(pixels, z, aligned)
        return np.where(np.isfinite(aligned), np.rint(aligned * 1000), 0).astype(np.uint16)


# Corners of a triangle belong to one surface if they differ by less than this share of their depth.
# Neighbouring pixels of the coarsest mode (wide, binned: 0.23 degrees) differ by as much on a
# surface whose normal is 85 degrees off the ray.
STEEPEST = 0.0469


@numba.njit(cache=True)
def _warp(pixels, z, aligned):
    """Draw the mesh of a depth image into ``aligned`` (Hc, Wc).

    Args:
        pixels: (H, W, 2) in the colour image.
        z: (H, W) metres in the colour camera, 0 = unknown.
    """
    for v in range(z.shape[0] - 1):
        for u in range(z.shape[1] - 1):
            for second in range(2):
                # corners of the triangle, clockwise in the image
                va, ua = v + second, u + second
                vb, ub = (v + 1, u) if second else (v, u + 1)
                vc, uc = (v, u + 1) if second else (v + 1, u)
                za, zb, zc = z[va, ua], z[vb, ub], z[vc, uc]
                least = min(za, zb, zc)
                if least <= 0 or max(za, zb, zc) - least > STEEPEST * least:
                    continue
                _triangle(pixels[va, ua], pixels[vb, ub], pixels[vc, uc], za, zb, zc, aligned)


@numba.njit(cache=True)
def _triangle(a, b, c, za, zb, zc, aligned):
    """Draw a triangle with corners (2,) px and depths, metres; the nearest depth of a pixel stays.

    A pixel's weights wa, wb, wc are its barycentric coordinates times twice the triangle's area.
    """
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    if area <= 0:  # seen from behind: something nearer hides it
        return
    height, width = aligned.shape
    left = max(int(np.ceil(min(a[0], b[0], c[0]))), 0)
    right = min(int(np.floor(max(a[0], b[0], c[0]))), width - 1)
    top = max(int(np.ceil(min(a[1], b[1], c[1]))), 0)
    bottom = min(int(np.floor(max(a[1], b[1], c[1]))), height - 1)
    for y in range(top, bottom + 1):
        for x in range(left, right + 1):
            wa = (b[0] - x) * (c[1] - y) - (b[1] - y) * (c[0] - x)
            wb = (c[0] - x) * (a[1] - y) - (c[1] - y) * (a[0] - x)
            wc = area - wa - wb
            if wa < 0 or wb < 0 or wc < 0:
                continue
            depth = (wa * za + wb * zb + wc * zc) / area
            if depth < aligned[y, x]:
                aligned[y, x] = depth


SOUND_RATE = 16_000  # samples a second
# Cameras whose focal lengths and principal points the fault "swapped_lenses" exchanges: 4 and 5 of
# InterCap's release
SWAPPED = (3, 4)


@dataclass(frozen=True)
class Device:
    """One camera of the rig."""

    index: int
    """Position in the rig; 0 = master."""
    camera: Camera
    """As calibrated (with errors), always with depth."""
    serial: str
    colour_mode: str
    depth_mode: str
    depth: bool
    """Whether the device records depth."""
    fps: int
    first_us: int
    """Its first device time, microseconds."""
    sound: np.ndarray | None = None
    """(N,) float32 from its first image on at :data:`SOUND_RATE`, None without sound."""


@dataclass(frozen=True)
class DeviceFrame:
    """Data of one device for frame set ``t``."""

    t: int
    time_us: int
    jpeg: bytes
    depth: np.ndarray | None
    """(H, W) uint16 mm, or None."""
    inertial: list[tuple[np.ndarray, np.ndarray, int]]
    """Acceleration (3,), m/s^2, turning rate (3,), rad/s, and device time, microseconds."""


class CameraFiles(ABC):
    """Open files of one camera; a context manager."""

    @abstractmethod
    def write(self, frame: DeviceFrame) -> None:
        """Add the data of one frame set."""

    def close(self) -> None:  # noqa: B027 (folders have nothing to close)
        """Finish the files."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class CaptureFolder(ABC):
    """Files of a capture below ``path``; ``broken`` maps each fault to its camera."""

    calibration: str
    """File or folder of the calibration."""
    own_faults: frozenset[StudioFault]
    """Faults that only recordings of this layout can have."""

    def __init__(self, path: Path, capture: StudioCapture, broken: dict[str, int]) -> None:
        self.path, self.capture, self.broken = path, capture, broken

    @abstractmethod
    def open(self, device: Device) -> CameraFiles:
        """Open the files of a camera."""

    @abstractmethod
    def write_calibration(self, claimed: Rig, fps: int) -> None:
        """Write the calibration with its errors, ``claimed``."""

    def image_number(self, t: int, order: int, fps: int) -> int:
        """Return the number of an image in the files of detections.

        The image is that of set ``t`` and the ``order``-th image of its camera.
        """
        return order

    def add_keypoints(self, camera: str, t: int, fps: int, content: str) -> None:  # noqa: B027
        """Also write keypoints next to the images, if the layout has them there."""

    def add_masks(  # noqa: B027
        self, camera: str, t: int, fps: int, candidates: list[dict[str, Any]], label: str
    ) -> None:
        """Also write masks of person and object, COCO label ``label``, next to the images."""

    def lenses(self, claimed: Rig) -> list[Intrinsics]:
        """Return the colour lenses of the calibration, with the faults of the capture."""
        lenses = [camera.colour for camera in claimed]
        if "swapped_lenses" in self.capture.faults:
            for own, other in (SWAPPED, SWAPPED[::-1]):
                theirs = claimed[other].colour
                lenses[own] = replace(
                    lenses[own], fx=theirs.fx, fy=theirs.fy, cx=theirs.cx, cy=theirs.cy
                )
        if "wrong_resolution" in self.broken:
            at = self.broken["wrong_resolution"]
            lenses[at] = lenses[at].scaled(1.5)
        return lenses


class ImageFiles(CameraFiles):
    """Colour and depth as single files.

    Args:
        paths: returns the files of colour (None: no file) and depth.
        aligner: maps depth to the colour grid; None keeps it in the depth camera's lens.
    """

    def __init__(
        self,
        paths: Callable[[DeviceFrame], tuple[Path | None, Path]],
        aligner: Aligner | None = None,
    ) -> None:
        self._paths, self._aligner = paths, aligner

    def write(self, frame: DeviceFrame) -> None:
        colour, depth = self._paths(frame)
        if colour is not None:
            colour.parent.mkdir(parents=True, exist_ok=True)
            colour.write_bytes(frame.jpeg)
        if frame.depth is None:
            return
        image = frame.depth if self._aligner is None else self._aligner.align(frame.depth)
        depth.parent.mkdir(parents=True, exist_ok=True)
        packed = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
        depth.write_bytes(packed.tobytes())
