"""Interface of all layouts of recordings: cameras, their poses, and their images one at a time.

A :class:`RecordingLayout` is made for one sequence and opens a :class:`CameraRecording` for each
camera. To add a layout, derive from both and name it in ``config_types.LayoutName`` and in
:mod:`intercap_core.formats.recordings.layouts`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from intercap_core.entries import SequenceEntry
from intercap_core.formats.calibration.extrinsics import Extrinsics
from intercap_core.geometry.camera.rig import Camera

GRAVITY = 9.80665  # m/s^2, standard (ISO 80000-3)
SOUND_RATE = 8000  # samples a second, that of telephony: steps and voices are within 4 kHz


class RecordingPreview(NamedTuple):
    """Properties of a recording that are known without reading all of it."""

    size: tuple[int, int] | None
    """Width and height of the first colour image; None if none can be read."""
    images: int | None
    """Number of colour images in the file; None = unknown."""
    seconds: float | None
    """Duration from the first image to the last; None = unknown."""
    share: float = 1.0
    """Share of the stated content that the file holds."""
    faults: tuple[str, ...] = ()
    """Other faults; each follows the camera's name in a message."""
    remarks: tuple[str, ...] = ()
    """Changes to images when they are stored; each follows the camera's name in a message."""
    counted: bool = True
    """Whether images were counted; otherwise they follow from duration and rate."""


@dataclass(frozen=True, eq=False)
class Sound:
    """The sound track of a recording."""

    samples: np.ndarray
    """(N,) float32 at :data:`SOUND_RATE`."""
    first_s: float
    """Time of the first sample minus that of the first image on the file's clock, seconds."""


class Image(NamedTuple):
    """One image as recorded."""

    kind: Literal["colour", "depth"]
    """Kind of the image."""
    time_us: int
    """Device time of the camera, microseconds. A depth image's time includes its delay by design
    (``CameraRecording.depth_delay_us``)."""
    content: bytes | np.ndarray
    """Colour: a whole JPEG or PNG file without an orientation. Depth: (H, W) uint16 in the size of
    the depth lens, mm, 0 = invalid."""


class Accelerometer:
    """Sum of the samples of an accelerometer, from which the direction of gravity follows."""

    def __init__(self) -> None:
        self._sum, self._count = np.zeros(3), 0

    def add(self, samples: np.ndarray) -> None:
        """Add accelerations (n, 3), m/s^2."""
        self._sum += samples.sum(axis=0)
        self._count += len(samples)

    def gravity(self, colour_from_sensor: np.ndarray) -> tuple[np.ndarray, str]:
        """Direction down (3,), unit, in the frame that ``colour_from_sensor`` (3, 3) rotates to.

        NaN and a note if the mean is not gravity, as of drivers that subtract it; the note follows
        the camera's name. At rest an accelerometer measures the floor's reaction, which is up.
        """
        length = float(np.linalg.norm(self._sum)) / max(self._count, 1)
        if self._count and abs(length / GRAVITY - 1) < 0.2:  # devices in use are within 3 %
            return colour_from_sensor @ (-self._sum / np.linalg.norm(self._sum)), ""
        note = f"its accelerometer measures {length:.2g} m/s^2 in the mean, expected {GRAVITY:.1f}"
        return np.full(3, np.nan), f"{note}: gravity is not used" if self._count else ""


class ClosedOnExit(AbstractContextManager[Any]):
    """A context manager that calls ``close`` at the end of the ``with`` block."""

    def close(self) -> None:
        """Release the files."""

    def __exit__(self, *error: object) -> None:
        self.close()


class CameraRecording(ClosedOnExit, ABC):
    """One camera's open recording; use as a context manager.

    The constructor reads the head of the file and raises UserError, naming the file, if nothing of
    the recording can be used.
    """

    source: Path
    """The file or folder."""
    camera: Camera
    """Lenses, and the pose that the layout's extrinsics give; ``depth`` is None without depth."""
    fps: float
    """Nominal images a second."""
    serial: str
    """The device's serial number, "" = not known."""
    depth_delay_us: int
    """Device time of a depth image minus that of its colour image, by design, microseconds."""
    timing: str
    """Source of the images' times, such as "by number"; "" = the device's or the file's clock."""
    truncated: bool
    """The recording was cut off. Final after :meth:`images`."""
    notes: list[str]
    """Messages for the user about missing or damaged data. Final after :meth:`images`."""
    gravity: np.ndarray
    """(3,) direction down, unit, colour camera's frame; NaN = unknown. Set by :meth:`images`."""

    def __init__(
        self, source: Path, camera: Camera, *, fps: float, serial: str = "", depth_delay_us: int = 0
    ) -> None:
        self.source, self.camera = source, camera
        self.fps, self.serial, self.depth_delay_us = fps, serial, depth_delay_us
        self.timing = ""
        self.truncated = False
        self.notes = []
        self.gravity = np.full(3, np.nan)

    @abstractmethod
    def images(self) -> Iterator[Image]:
        """Yield all images one at a time, so that memory does not grow; call once.

        Damaged images are left out and counted in a note. There are no depth images if
        ``camera.depth`` is None.
        """

    def sound(self) -> Sound | None:
        """The recording's sound, after :meth:`images`; None without sound."""
        return None

    @abstractmethod
    def preview(self) -> RecordingPreview:
        """Inspect the recording without reading all images, in milliseconds."""


class RecordingLayout(ABC):
    """The recordings of one sequence.

    The constructor finds the cameras and reads their poses. It raises UserError if the folder or
    the calibration cannot be used. ``sequence.recordings`` is an existing folder.
    """

    extrinsics: Extrinsics
    """Poses of the cameras. Their order is that of every axis C of the sequence's arrays."""
    names: list[str]
    """Cameras with a recording, including those without a pose."""
    pose_faults: dict[str, str]
    """Why a recording does not give its camera's pose, by the camera's name."""

    def __init__(self, sequence: SequenceEntry) -> None:
        self.sequence = sequence
        self.pose_faults = {}

    @abstractmethod
    def open(self, name: str) -> CameraRecording:
        """Open the recording of a camera that has a recording and a pose.

        Raises UserError if it cannot be used; the camera is then absent, with this reason.
        """
