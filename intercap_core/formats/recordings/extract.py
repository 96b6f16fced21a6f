"""Copy one camera's images into the frames artefact, with notes on missing or damaged data.

A frame set holds one image of each camera, all taken at nearly the same time. Sets are formed later
from the times and the masks ``colour_usable`` and ``depth_usable`` of the images copied here.
"""

from __future__ import annotations

import logging
import zlib
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.errors import UserError
from intercap_core.formats.recordings.encodings import encoded_size, holds_all_pixels
from intercap_core.formats.recordings.source import CameraRecording, Image, RecordingLayout, Sound
from intercap_core.geometry.camera.rig import Camera, stereo_depth_noise
from intercap_core.inputs.files import printable
from intercap_core.progress import Progress

log = logging.getLogger(__name__)


def advice_on_size(actual: tuple[int, ...], expected: tuple[int, ...]) -> str:
    """Next step for images whose size (width, height) is not that of the calibration."""
    if actual == expected[::-1]:
        return (
            "give the calibration of the images as shown: an orientation that the files state "
            "(exiftool -Orientation FILES) turns them"
        )
    return "give the calibration of this resolution"


@dataclass
class ExtractedCamera:
    """One camera whose images were copied."""

    name: str
    """Name of the camera."""
    source: Path | None = None
    """Its recording; None without one."""
    camera: Camera | None = None
    """Lenses and pose; None if the camera cannot be used."""
    fps: float = 0.0
    """Nominal images a second."""
    serial: str = ""
    """Serial number of the device; "" = unknown."""
    depth_delay_us: int = 0
    """Device time of a depth image minus that of its colour image, by design, microseconds."""
    fingerprint: int = 0
    """Checksum over the ends of all colour images, which is equal for copies of one recording."""
    gravity: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))
    """(3,) direction down, unit, colour camera's frame; NaN = unknown."""
    truncated: bool = False
    """The recording was cut off."""
    notes: list[str] = field(default_factory=list)
    """Messages for the user about missing or damaged data."""
    colour_times: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    """(N,) device times, microseconds, in the order of the artefact's images."""
    depth_times: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    """(M,) the same of depth images; ``depth_delay_us`` is not subtracted."""
    colour_usable: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    """(N,) whether frame sets may use the colour image."""
    depth_usable: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    """(M,) whether frame sets may use the depth image."""
    sound: Sound | None = None
    """Sound track of the recording."""

    @property
    def present(self) -> bool:
        """Whether frame sets may use the camera."""
        return self.camera is not None and bool(self.colour_usable.any())

    @property
    def usable_times(self) -> np.ndarray:
        """Device times of the colour images that frame sets may use."""
        return self.colour_times[self.colour_usable]


def extract(
    name: str,
    layout: RecordingLayout,
    writer: artefacts.Writer,
    *,
    depth: bool = True,
    stereo_baseline_m: float = 0.0,
) -> ExtractedCamera:
    """Copy one camera's images into the artefact; faults become notes of the result.

    Without ``depth``, only colour is copied. ``stereo_baseline_m`` is that of depth cameras whose
    recording states none; 0 = time of flight.
    """
    view = ExtractedCamera(name)
    if name not in layout.extrinsics.master_from_colour:
        absent = f"no pose in {layout.sequence.calibration.name}; add the camera there"
        view.notes.append(_without_folders(layout.pose_faults.get(name, absent), layout))
        return view
    if name not in layout.names:
        view.notes.append(f"no recording of {name} in {layout.sequence.recordings.name}")
        return view
    try:
        with layout.open(name) as recording:
            view.source, view.camera = recording.source, recording.camera
            lens, noise = recording.camera.depth, recording.camera.depth_noise
            if lens is not None and not noise:
                noise = stereo_depth_noise(lens, stereo_baseline_m)
                view.camera = replace(recording.camera, depth_noise=noise)
            view.fps, view.serial = recording.fps, recording.serial
            view.depth_delay_us = recording.depth_delay_us
            _Copy(recording, view, writer, depth=depth).run()
            view.sound = recording.sound()
    except UserError as error:
        view.notes.append(str(error))
        view.camera = None
    view.notes = [_without_folders(note, layout) for note in view.notes]
    return view


def _without_folders(text: str, layout: RecordingLayout) -> str:
    """Printable text with paths relative to the sequence's folders: artefacts hold no others."""
    recordings, calibration = layout.sequence.recordings, layout.sequence.calibration
    for folder in (recordings, calibration.parent):
        text = text.replace(f"{folder}/", "")
    return printable(text.replace(str(recordings), recordings.name))


class _Copy:
    """Copies one recording."""

    def __init__(
        self,
        recording: CameraRecording,
        view: ExtractedCamera,
        writer: artefacts.Writer,
        *,
        depth: bool,
    ) -> None:
        self.recording, self.view, self.writer = recording, view, writer
        lens = recording.camera.depth if depth else None
        self.group = f"cameras/{view.name}"
        self.colour = writer.stream(f"{self.group}/colour")
        self.depth = (
            writer.stream(f"{self.group}/depth", (lens.height, lens.width)) if lens else None
        )
        self.colour_size = (recording.camera.colour.width, recording.camera.colour.height)
        self.colour_times: list[int] = []
        self.usable: list[bool] = []  # whether the colour image is whole and of the right size
        self.depth_times: list[int] = []
        self.offsets, self.buffer = [0], bytearray()
        self.measured = False  # whether any depth image holds a distance
        self.damaged = self.other_size = 0

    def run(self) -> None:
        """Copy all images, write their times and note missing or damaged data.

        Raises UserError if the first image has another size than the calibration, or if the
        recording fails before its first colour image.
        """
        view, recording = self.view, self.recording
        progress = Progress(log, f"{view.name}: read", None, "images")
        try:
            for image in recording.images():
                (self._take_colour if image.kind == "colour" else self._take_depth)(image)
                progress.step()
        except UserError as error:
            if not any(self.usable):
                raise
            view.truncated = True
            view.notes.append(f"read up to image {len(self.colour_times)}: {error}")
        finally:
            self._finish()
        view.truncated |= recording.truncated
        view.gravity = recording.gravity
        view.notes += recording.notes
        self._note_images()

    def _take_colour(self, image: Image) -> None:
        """Copy a colour image; count one that is damaged or of another size.

        Those are copied too, but not usable, because detectors number all recorded images.
        """
        content = bytes(image.content)
        size = encoded_size(content)
        usable = size == self.colour_size and holds_all_pixels(content)
        if size in (None, self.colour_size):
            self.damaged += not usable
        else:
            self._refuse("colour", size, self.colour_size, not any(self.usable))
        self.usable.append(usable)
        self.colour_times.append(image.time_us)
        self.offsets.append(self.offsets[-1] + len(content))
        # The end is entropy-coded data, which no two images share.
        self.view.fingerprint = zlib.crc32(content[-256:], self.view.fingerprint)
        self.buffer += content
        if len(self.buffer) >= 4 << 20:
            self._flush()

    def _take_depth(self, image: Image) -> None:
        """Copy a depth image if depth is wanted; count one of another size."""
        depth = np.asarray(image.content)
        lens = self.recording.camera.depth
        if self.depth is None or lens is None:
            return
        if depth.shape != (lens.height, lens.width):
            expected = (lens.width, lens.height)
            self._refuse("depth", depth.shape[::-1], expected, not self.depth_times)
            return
        self.measured = self.measured or bool(depth.any())
        self.depth_times.append(image.time_us)
        self.depth.append(depth[None])

    def _refuse(
        self, kind: str, actual: tuple[int, ...], expected: tuple[int, ...], first: bool
    ) -> None:
        """Count an image of another size; raise UserError if it is the first of the recording."""
        if first:
            raise UserError(
                f"{self.recording.source}: {kind} images are {actual[0]}x{actual[1]}, the "
                f"calibration of camera {self.view.name} is for {expected[0]}x{expected[1]}; "
                f"{advice_on_size(actual, expected)}"
            )
        self.other_size += 1

    def _flush(self) -> None:
        self.colour.append(np.frombuffer(bytes(self.buffer), np.uint8))
        self.buffer.clear()

    def _finish(self) -> None:
        view = self.view
        self._flush()
        view.colour_times = np.array(self.colour_times, np.int64)
        view.depth_times = np.array(self.depth_times, np.int64)
        view.colour_usable = np.array(self.usable, bool)
        view.depth_usable = np.full(len(self.depth_times), self.measured)
        self.writer.put(f"{self.group}/colour_offsets", self.offsets)
        self.writer.put(f"{self.group}/colour_time", view.colour_times)
        if self.depth is not None:
            self.writer.put(f"{self.group}/depth_time", view.depth_times)

    def _note_images(self) -> None:
        """Note what was left out; a camera whose depth is all zero loses its depth lens."""
        view = self.view
        if not any(self.usable):
            view.notes.append("holds no colour image")
        if self.damaged:
            view.notes.append(f"{self.damaged} damaged images left out")
        if self.other_size:
            view.notes.append(f"{self.other_size} images of another size left out")
        if self.depth is None:
            is_left_out = self.recording.camera.depth is not None
            left_out = "its depth is left out (frames.depth)"
            view.notes.append(left_out if is_left_out else "has no depth")
        elif not self.measured:
            empty = f"depth is zero in all {len(self.depth_times)} images"
            view.notes.append(f"{empty}: used without depth" if self.depth_times else "no depth")
        if not self.measured and view.camera is not None:
            view.camera = replace(view.camera, depth=None, colour_from_depth=None)
