"""What every layout of a capture's folder has: cameras that write shots, a calibration."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np

from intercap_core.config import StudioCapture, StudioFault
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.studio.alignment import Aligner

SOUND_RATE = 16_000  # samples a second
WRONG_SIZE = 1.5  # of the images that a wrong calibration is for
SWAPPED = (3, 4)  # cameras 4 and 5 of InterCap's release


@dataclass(frozen=True)
class Device:
    """One camera of the rig: ``camera`` as it claims to be, always with depth; ``depth`` says
    whether it records any; ``first_us`` is its first device time; ``sound`` (N,) float32 from its
    first image on, at :data:`SOUND_RATE`, None = it records none."""

    index: int
    camera: Camera
    serial: str
    colour_mode: str
    depth_mode: str
    depth: bool
    fps: int
    first_us: int
    sound: np.ndarray | None = None


@dataclass(frozen=True)
class Shot:
    """What a device delivers of set ``t``: a JPEG, depth (H, W) uint16 mm or None, and inertial
    samples (acceleration, turning rate, device time)."""

    t: int
    time_us: int
    jpeg: bytes
    depth: np.ndarray | None
    inertial: list[tuple[np.ndarray, np.ndarray, int]]


class CameraFiles(ABC):
    """One camera's files, open; use as a context manager."""

    @abstractmethod
    def write(self, shot: Shot) -> None:
        """Add a shot."""

    def close(self) -> None:  # noqa: B027 (folders have nothing to close)
        """Finish the files."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class CaptureFolder(ABC):
    """The files of ``capture`` below ``path``; ``broken``: fault to the camera that has it."""

    calibration: str
    """File or folder of the calibration."""
    own_faults: frozenset[StudioFault]
    """Faults that recordings of this layout can have, beside those that any can."""

    def __init__(self, path: Path, capture: StudioCapture, broken: dict[str, int]) -> None:
        self.path, self.capture, self.broken = path, capture, broken

    @abstractmethod
    def open(self, device: Device) -> CameraFiles:
        """Begin one camera's files."""

    @abstractmethod
    def write_calibration(self, claimed: Rig, fps: int) -> None:
        """Write the calibration as it is claimed to be."""

    def image_number(self, t: int, order: int, fps: int) -> int:
        """What files of keypoints and candidates call the image of set ``t``, the ``order``-th."""
        return order

    def add_keypoints(self, camera: str, t: int, fps: int, content: str) -> None:  # noqa: B027
        """Lay a file of keypoints beside the images, where the layout has them there."""

    def add_masks(  # noqa: B027
        self,
        camera: str,
        t: int,
        fps: int,
        candidates: list[dict[str, Any]],
        label: str,
    ) -> None:
        """The same for masks of the person and of the object, COCO label ``label``."""

    def lenses(self, claimed: Rig) -> list[Intrinsics]:
        """The colour lenses as the calibration has them: wrong where a fault says so."""
        found = [camera.colour for camera in claimed]
        if "swapped_lenses" in self.capture.faults:
            a, b = SWAPPED
            found[a], found[b] = found[b], found[a]
        if "wrong_resolution" in self.broken:
            at = self.broken["wrong_resolution"]
            found[at] = found[at].scaled(WRONG_SIZE)
        return found


class ImageFiles(CameraFiles):
    """Colour and depth as single files; ``aligner`` where depth lies on the colour grid."""

    def __init__(self, aligner: Aligner | None) -> None:
        self._aligner = aligner

    @abstractmethod
    def _paths(self, shot: Shot) -> tuple[Path | None, Path]:
        """Where colour (None: no file of its own) and depth go."""

    def write(self, shot: Shot) -> None:
        colour, depth = self._paths(shot)
        if colour is not None:
            colour.parent.mkdir(parents=True, exist_ok=True)
            colour.write_bytes(shot.jpeg)
        if shot.depth is None:
            return
        image = shot.depth if self._aligner is None else self._aligner.align(shot.depth)
        depth.parent.mkdir(parents=True, exist_ok=True)
        packed = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
        depth.write_bytes(packed.tobytes())
