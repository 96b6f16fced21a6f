"""Base classes of a capture's folder: cameras that write their images, and a calibration."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np

from intercap_core.config import StudioCapture, StudioFault
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.studio.render import Aligner

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
