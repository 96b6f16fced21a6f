"""What every layout of recordings gives: the cameras, their poses, their images one at a time.

A layout is one class, :class:`RecordingLayout`, made for one sequence; it opens one
:class:`CameraRecording`
for each camera. The frames stage knows nothing else of where images come from. To add a layout:
derive from both, name it in ``config.LayoutName`` and in
:mod:`intercap_core.formats.recordings.layouts`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Literal, NamedTuple, Self

import numpy as np

from intercap_core.config import SequenceEntry
from intercap_core.formats.calibration.extrinsics import Extrinsics
from intercap_core.geometry.camera.rig import Camera

SOUND_RATE = 8000  # samples a second: telephony's, steps and voices are within 4 kHz


class RecordingPreview(NamedTuple):
    """What a look at a recording shows without reading all of it.

    ``size`` (width, height) of the first colour image, None = none can be read. ``images`` counts
    the colour images that are there (one by one where ``counted``, else by duration and rate),
    ``seconds`` lasts from the first to the last; None = nothing says. ``share`` of what the head
    states is in the file. ``faults`` are what else is wrong, in words that follow its name.
    """

    size: tuple[int, int] | None
    images: int | None
    seconds: float | None
    share: float = 1.0
    faults: tuple[str, ...] = ()
    counted: bool = True


@dataclass(frozen=True, eq=False)
class Sound:
    """``samples`` (N,) float32 at :data:`SOUND_RATE`; the first one was recorded ``first_s``
    seconds after the first image, by the file's own clock."""

    samples: np.ndarray
    first_s: float


class Image(NamedTuple):
    """One image as recorded.

    ``content`` of a colour image is a whole JPEG or PNG file; of a depth image (H, W) uint16,
    millimetres, 0 = invalid, in the size of the camera's depth lens. ``time_us`` is the camera's
    device time, whole microseconds; depth that is late by design keeps its own time.
    """

    kind: Literal["colour", "depth"]
    time_us: int
    content: bytes | np.ndarray


class CameraRecording(ABC):
    """One camera's recording, open; use as a context manager.

    The constructor reads what the head says and raises UserError, naming the file, for a recording
    of which nothing can be used. Attributes that :meth:`images` completes are final after it.
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
    """Device time of a depth image minus that of its colour image, by design."""
    truncated: bool
    """The recording was cut off. Completed by :meth:`images`."""
    notes: list[str]
    """What is degraded, in words for the user. Completed by :meth:`images`."""
    gravity: np.ndarray
    """(3,) direction down, unit, colour camera's frame; NaN = not known. By :meth:`images`."""

    def __init__(
        self, source: Path, camera: Camera, *, fps: float, serial: str = "", depth_delay_us: int = 0
    ) -> None:
        self.source, self.camera = source, camera
        self.fps, self.serial, self.depth_delay_us = fps, serial, depth_delay_us
        self.truncated = False
        self.notes = []
        self.gravity = np.full(3, np.nan)

    @abstractmethod
    def images(self) -> Iterator[Image]:
        """Yield every image one at a time, so that memory does not grow; call once.

        Images that are damaged are left out and counted in a note. No depth image is given where
        ``camera.depth`` is None.
        """

    def sound(self) -> Sound | None:
        """The recording's sound, after :meth:`images`; None = it has none."""
        return None

    @abstractmethod
    def preview(self) -> RecordingPreview:
        """Look at what can be told without reading all images, in milliseconds."""

    def close(self) -> None:  # noqa: B027 (a folder has nothing to close)
        """Release the file."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class RecordingLayout(ABC):
    """The recordings of one sequence.

    The constructor finds the cameras and reads their poses; it raises UserError where the folder
    or the calibration cannot be used at all. ``sequence.recordings`` is a folder that exists.
    """

    extrinsics: Extrinsics
    """Poses of the cameras; its order is that of every C axis."""
    names: list[str]
    """Cameras that have a recording, also those without a pose."""

    def __init__(self, sequence: SequenceEntry) -> None:
        self.sequence = sequence

    @abstractmethod
    def open(self, name: str) -> CameraRecording:
        """Open the recording of a camera that has a recording and a pose.

        Raises UserError where it cannot be used: the camera is then set aside with that reason.
        """
