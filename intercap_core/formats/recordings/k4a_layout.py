"""Layout ``k4a``: one Azure Kinect recording a camera, ``<camera>.mkv``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from intercap_core.config import SequenceEntry
from intercap_core.formats.calibration.extrinsics import read_extrinsics
from intercap_core.formats.calibration.files import read_other_calibration, refuse_scale
from intercap_core.formats.calibration.k4a import COLOUR_MODES
from intercap_core.formats.calibration.other import Recorded
from intercap_core.formats.recordings.encoded import JPEG_QUALITY, bgr_of_raw, jpeg_of
from intercap_core.formats.recordings.glance import Glance
from intercap_core.formats.recordings.k4a import Recording, imu_samples
from intercap_core.formats.recordings.source import CameraRecording, Image, Layout


class KinectLayout(Layout):
    """``<camera>.mkv`` files, and camera poses as :func:`read_extrinsics` reads them, or those of
    another tool's calibration, whose lenses are left aside."""

    def __init__(self, sequence: SequenceEntry) -> None:
        super().__init__(sequence)
        self.names = sorted(path.stem for path in sequence.recordings.glob("[!.]*.mkv"))
        path, scale = sequence.calibration, sequence.calibration_scale
        other = read_other_calibration(path, Recorded(self.names), scale)
        if other is None:
            refuse_scale(path, scale)
        self.extrinsics = read_extrinsics(path) if other is None else other.extrinsics

    def open(self, name: str) -> KinectRecording:
        """Open ``<name>.mkv``; raises UserError as :class:`Recording` does."""
        path = self.sequence.recordings / f"{name}.mkv"
        return KinectRecording(path, name, self.extrinsics.master_from_colour[name])


class KinectRecording(CameraRecording):
    """One Azure Kinect recording; lenses are those of the calibration that it holds."""

    def __init__(self, path: Path, name: str, pose: np.ndarray) -> None:
        self._recording = Recording(path)
        info = self._recording.info
        try:
            camera = self._recording.camera(name, pose)
        except BaseException:
            self._recording.close()
            raise
        super().__init__(
            path, camera, fps=info.fps, serial=info.serial, depth_delay_us=info.depth_delay_us
        )
        self.truncated = info.truncated

    def close(self) -> None:
        """Close the file."""
        self._recording.close()

    def glance(self) -> Glance:
        """The head, the first image and the file's length."""
        return self._recording.glance()

    def images(self) -> Iterator[Image]:
        """Colour packets as recorded, depth without loss; gravity from the accelerometer.

        Raw colour is stored as JPEG, with a note: as recorded it would be ten times the bytes.
        """
        info = self._recording.info
        counts = {"colour": 0, "depth": 0}
        acceleration, samples = np.zeros(3), 0
        for packet in self._recording.packets():
            if packet.kind == "imu":
                values = imu_samples(packet.content)[:, :3]
                acceleration += values.sum(axis=0)
                samples += len(values)
                continue
            counts[packet.kind] += 1
            content: bytes | np.ndarray = packet.content
            if packet.kind == "depth":
                content = self._recording.depth_image(packet.content)
            elif info.colour_format != "MJPG":
                size = COLOUR_MODES[info.colour_mode].size
                content = jpeg_of(bgr_of_raw(packet.content, info.colour_format, size))
            yield Image(packet.kind, packet.device_time_us, content)
        if info.colour_format != "MJPG":
            self.notes.append(
                f"colour was recorded as {info.colour_format} and is stored as JPEG of quality "
                f"{JPEG_QUALITY}"
            )
        if self.truncated:
            self.notes.append(
                f"the file is cut off: {counts['colour']} colour and {counts['depth']} depth "
                "images could be read"
            )
        if self._recording.broken_packets:
            self.notes.append(f"{self._recording.broken_packets} damaged packets left out")
        rotation = self._recording.colour_from_accelerometer()
        if samples and rotation is not None and np.linalg.norm(acceleration) > 0:
            # At rest the sensor feels the floor's push, which is up.
            self.gravity = rotation @ (-acceleration / np.linalg.norm(acceleration))
