"""Layout ``k4a``: MKV recordings of Azure Kinects, read without the Azure Kinect SDK.

Colour packets are JPEG files, or raw images in some modes; depth packets are big-endian numbers.
Device time is block time + ``K4A_START_OFFSET_NS``, in whole microseconds. Sources of the tags and
tracks: https://learn.microsoft.com/azure/kinect-dk/record-file-format and the SDK's reader (MIT).
Orbbec's K4A wrapper, for Femto cameras, has the same recorder; it sets the device's clock to the
host's, so that device times count from 1970 (timer_sync_with_host in ob_k4a_impl.cpp).
"""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import av
import numpy as np
from av.stream import Discard

from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.calibration.files import RecordedCameras, read_calibration
from intercap_core.formats.calibration.k4a import (
    COLOUR_MODES,
    DEPTH_MODES,
    colour_from_accelerometer,
    parse_camera,
)
from intercap_core.formats.calibration.opencv import check_rate
from intercap_core.formats.recordings import containers, encodings
from intercap_core.formats.recordings.source import (
    Accelerometer,
    CameraRecording,
    ClosedOnExit,
    Image,
    RecordingLayout,
    RecordingPreview,
)
from intercap_core.geometry.camera.rig import Camera
from intercap_core.inputs.files import quoted, read_bytes

CALIBRATION_NAME = "calibration.json"
IMU_SAMPLE = np.dtype(  # times in ns, m/s^2, rad/s
    [("time", "<u8"), ("acceleration", "<f4", 3), ("rate_time", "<u8"), ("rate", "<f4", 3)]
)
# Largest delay of depth that is accepted; the SDK allows one frame's period.
LONGEST_DELAY_US = 1_000_000

Kind = Literal["colour", "depth", "imu"]
TRACKS: dict[Kind, str] = {"colour": "COLOR", "depth": "DEPTH", "imu": "IMU"}


class Packet(NamedTuple):
    """One image or inertial sample as recorded."""

    kind: Kind
    device_time_us: int
    """Device time, microseconds."""
    content: bytes


@dataclass(frozen=True)
class KinectFileInfo:
    """The head of a recording."""

    colour_mode: str
    """Key of ``COLOUR_MODES``."""
    colour_format: str
    """MJPG or one of :data:`.encodings.RAW_FORMATS`."""
    depth_mode: str | None
    """Key of ``DEPTH_MODES``; None without depth."""
    fps: float
    """Images a second."""
    serial: str
    """Serial number of the device; "" = not stated."""
    start_offset_us: int
    """Device time of the file's time 0, microseconds."""
    depth_delay_us: int
    """Device time of a depth image minus that of its colour image, microseconds."""
    calibration: bytes
    """The device's calibration JSON."""
    truncated: bool
    """The file is shorter than its head states."""


class KinectFile(ClosedOnExit):
    """One open recording; use as a context manager.

    Raises UserError, naming the file, if it is missing, empty or no Matroska file. It is also
    raised without a colour track or a calibration, and for a mode that the SDK does not know. A
    file that was cut off can be opened if its head is complete; ``info.truncated`` is then True.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self.broken_packets = 0
        truncated = _is_truncated(self.path)
        try:
            # Headers of the tracks are complete, so that probing would only buffer packets.
            self._container = containers.open_container(self.path, probesize="32768")
        except (av.error.FFmpegError, OSError) as error:
            raise UserError(
                f"{self.path}: cannot be opened as a recording ({error.strerror}); record again, "
                "or copy the file again if the copy was cut off"
            ) from error
        try:
            self._tracks = self._find_tracks()
            self.info = self._read_info(truncated)
        except BaseException:
            self._container.close()
            raise
        for stream in self._container.streams:
            if stream not in self._tracks.values():
                stream.discard = Discard.all  # infrared is half of the bytes and is not used

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def packets(self) -> Iterator[Packet]:
        """Yield all packets in the file's order, one at a time; call once.

        Depth of another size than an image's is left out and counted in ``broken_packets``. Damaged
        colour is yielded, because it counts in the numbers of the images. A file that was cut off
        ends early without an error.
        """
        kinds = {stream.index: kind for kind, stream in self._tracks.items()}
        streams = list(self._tracks.values())
        for packet in containers.demux(self._container, streams, self._count_broken):
            if not packet.size or packet.pts is None or packet.time_base is None:
                continue  # the end mark of a track
            kind = kinds[packet.stream_index]
            content = bytes(packet)
            time_us = round(packet.pts * packet.time_base * 1_000_000) + self.info.start_offset_us
            is_whole = kind != "depth" or 0 < len(content) == 2 * math.prod(self._depth_size)
            if is_whole and abs(time_us) <= containers.LATEST_US:
                yield Packet(kind, time_us, content)
            else:
                self._count_broken()

    def _count_broken(self) -> None:
        self.broken_packets += 1

    @property
    def _depth_size(self) -> tuple[int, int]:
        """Width and height of depth images; 0 without depth."""
        return DEPTH_MODES[self.info.depth_mode].size if self.info.depth_mode else (0, 0)

    def preview(self) -> RecordingPreview:
        """Inspect the colour track without reading the others."""
        seen = containers.preview_video(self.path, self._tracks["colour"].index, self.info.fps)
        is_raw = self.info.colour_format != "MJPG"
        return seen._replace(size=COLOUR_MODES[self.info.colour_mode].size) if is_raw else seen

    def depth_image(self, content: bytes) -> np.ndarray:
        """Convert a depth packet to (H, W) uint16, millimetres, 0 = invalid."""
        return np.frombuffer(content, ">u2").reshape(self._depth_size[::-1]).astype(np.uint16)

    def camera(self, name: str, master_from_colour: np.ndarray | None = None) -> Camera:
        """The device's lenses as a camera; raises UserError if the calibration is broken.

        ``master_from_colour``: pose (4, 4), None = the identity.
        """
        return parse_camera(
            self.info.calibration,
            colour_mode=self.info.colour_mode,
            depth_mode=self.info.depth_mode,
            name=name,
            source=str(self.path),
            master_from_colour=master_from_colour,
        )

    def colour_from_accelerometer(self) -> np.ndarray | None:
        """Rotation (3, 3) from accelerometer to colour axes; None if not calibrated."""
        return colour_from_accelerometer(self.info.calibration, source=str(self.path))

    def _find_tracks(self) -> dict[Kind, Any]:
        """Streams by kind, found by the tag, else by the name."""
        tracks: dict[Kind, Any] = {}
        candidates = [s for s in self._container.streams if s.type != "attachment"]
        for kind, name in TRACKS.items():
            tagged = [s for s in candidates if f"K4A_{name}_TRACK" in s.metadata]
            named = [s for s in candidates if s.metadata.get("title") == name]
            for stream in (tagged or named)[:1]:
                tracks[kind] = stream
        return tracks

    def _read_info(self, truncated: bool) -> KinectFileInfo:
        colour, depth = self._tracks.get("colour"), self._tracks.get("depth")
        if colour is None or colour.type != "video" or colour.codec_context is None:
            raise UserError(
                f"{self.path}: has no COLOR track, so it is not an Azure Kinect recording with "
                "colour; record with k4arecorder and the colour camera on"
            )
        has_depth = False
        if depth is not None and depth.codec_context is not None:
            has_depth = depth.metadata.get("K4A_DEPTH_MODE") != "PASSIVE_IR"  # infrared alone
        fps = float(colour.average_rate or 30)
        check_rate(fps, str(self.path))
        return KinectFileInfo(
            colour_mode=self._mode("colour", colour, COLOUR_MODES),
            colour_format=self._colour_format(colour),
            depth_mode=self._mode("depth", depth, DEPTH_MODES) if has_depth else None,
            fps=fps,
            serial=self._container.metadata.get("K4A_DEVICE_SERIAL_NUMBER", ""),
            start_offset_us=self._microseconds("K4A_START_OFFSET_NS", containers.LATEST_US),
            depth_delay_us=self._microseconds("K4A_DEPTH_DELAY_NS", LONGEST_DELAY_US),
            calibration=self._calibration(),
            truncated=truncated,
        )

    def _colour_format(self, colour: Any) -> str:
        four_cc = colour.codec_context.codec_tag.upper()
        if colour.codec_context.name == "mjpeg":
            return "MJPG"
        if four_cc in encodings.RAW_FORMATS:
            return four_cc
        raise UserError(
            f"{self.path}: colour is recorded as {four_cc or colour.codec_context.name}, expected "
            f"MJPG, {', '.join(encodings.RAW_FORMATS)}; record in a colour mode of k4arecorder"
        )

    def _mode(self, kind: Kind, stream: Any, known: dict[str, Any]) -> str:
        """The mode whose images have the track's size; no two modes share a size."""
        size = (stream.codec_context.width, stream.codec_context.height)
        name = next((mode for mode, entry in known.items() if entry.size == size), None)
        if name is None:
            stated = stream.metadata.get(f"K4A_{TRACKS[kind]}_MODE", "without a name")
            raise UserError(
                f"{self.path}: {kind} mode {stated} has images of {size[0]}x{size[1]}, expected "
                f"one of {', '.join(known)}; record in one of them"
            )
        return name

    def _microseconds(self, tag: str, most: int) -> int:
        """A tag that states nanoseconds, in microseconds; 0 without the tag."""
        value = self._container.metadata.get(tag, "0")
        microseconds = round(int(value) / 1000) if re.fullmatch("-?[0-9]{1,20}", value) else None
        if microseconds is not None and abs(microseconds) <= most:
            return microseconds
        raise UserError(
            f"{self.path}: tag {tag} is {quoted(value)}, expected nanoseconds, at most "
            f"{most / 1e6:g} s; the file is damaged, copy or record it again"
        )

    def _calibration(self) -> bytes:
        """The calibration JSON, which is attached to the file."""
        attached: list[Any] = [s for s in self._container.streams if s.type == "attachment"]
        tagged = [s for s in attached if "K4A_CALIBRATION_FILE" in s.metadata]
        named = [s for s in attached if s.metadata.get("filename") == CALIBRATION_NAME]
        for stream in tagged or named:
            return bytes(stream.data)
        raise UserError(
            f"{self.path}: holds no {CALIBRATION_NAME}; attach the device's own (mkvpropedit "
            f"--attachment-name {CALIBRATION_NAME} --add-attachment FILE) or record again"
        )


def parse_imu_samples(content: bytes) -> np.ndarray:
    """Accelerations and angular rates (n, 6) of one packet, m/s^2 and rad/s."""
    samples = np.frombuffer(content, IMU_SAMPLE, len(content) // IMU_SAMPLE.itemsize)
    return np.hstack([samples["acceleration"], samples["rate"]]).astype(np.float64)


def _is_truncated(path: Path) -> bool:
    """Whether the file is shorter than its Segment states, or was never finished.

    Raises UserError if the file is missing, empty or no Matroska file.
    """
    try:
        size = os.path.getsize(path)
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    head = read_bytes(path, max(size, 4096), head=4096)
    if not head:
        raise UserError(f"{path}: is empty (0 bytes); copy or record it again")
    if not head.startswith(b"\x1a\x45\xdf\xa3"):
        raise UserError(
            f"{path}: is not a Matroska file (it starts with {head[:4]!r}); give the .mkv that "
            "k4arecorder wrote"
        )
    end = containers.segment_end(head)
    return end is None or size < end


def find_cameras(recordings: Path) -> list[str]:
    """Names of the cameras with a file in ``recordings``; [] if no file is one of a Kinect."""
    files = _find_files(recordings)
    return sorted({file.stem for file in files}) if any(map(_is_kinect_file, files)) else []


def _find_files(recordings: Path) -> list[Path]:
    files = (path for path in recordings.iterdir() if path.suffix.lower() == ".mkv")
    return sorted(path for path in files if not path.name.startswith("."))


def _is_kinect_file(path: Path) -> bool:
    try:
        with KinectFile(path):
            return True
    except UserError:
        return False


class KinectLayout(RecordingLayout):
    """Files ``<camera>.mkv``, in capitals too.

    Poses are those of :func:`read_extrinsics` or of another tool's calibration. Lenses are those in
    the recordings.
    """

    def __init__(self, sequence: SequenceEntry) -> None:
        super().__init__(sequence)
        self._paths: dict[str, Path] = {}
        for file in _find_files(sequence.recordings):
            first = self._paths.setdefault(file.stem, file)
            if first != file:
                raise UserError(
                    f"{sequence.recordings}: camera {file.stem} is recorded as {first.name} "
                    f"and {file.name}; keep one"
                )
        self.names = list(self._paths)
        self.extrinsics = read_calibration(
            sequence.calibration,
            RecordedCameras(self.names),
            scale=sequence.calibration_scale,
            lenses=False,
        ).extrinsics

    def open(self, name: str) -> KinectRecording:
        """Open ``<name>.mkv``; raises UserError as :class:`KinectFile` does."""
        return KinectRecording(self._paths[name], name, self.extrinsics.master_from_colour[name])


class KinectRecording(CameraRecording):
    """One Azure Kinect recording, with the lenses of the calibration in it."""

    def __init__(self, path: Path, name: str, pose: np.ndarray) -> None:
        self._recording = KinectFile(path)
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

    def preview(self) -> RecordingPreview:
        """Inspect the head, the first image and the file's length."""
        return self._recording.preview()

    def images(self) -> Iterator[Image]:
        """Yield colour packets as recorded and lossless depth; find gravity from the accelerometer.

        Raw colour is stored as JPEG, with a note; raw it would be ten times as large. Raw colour of
        another size than an image's becomes an empty image.
        """
        info = self._recording.info
        counts = {"colour": 0, "depth": 0}
        accelerometer = Accelerometer()
        for packet in self._recording.packets():
            if packet.kind == "imu":
                accelerometer.add(parse_imu_samples(packet.content)[:, :3])
                continue
            counts[packet.kind] += 1
            content: bytes | np.ndarray = packet.content
            if packet.kind == "depth":
                content = self._recording.depth_image(packet.content)
            elif info.colour_format != "MJPG":
                size, content = COLOUR_MODES[info.colour_mode].size, b""
                with contextlib.suppress(ValueError):
                    image = encodings.decode_raw(packet.content, info.colour_format, size)
                    content = encodings.encode_jpeg(image)
            yield Image(packet.kind, packet.device_time_us, content)
        if info.colour_format != "MJPG":
            self.notes.append(
                f"colour was recorded as {info.colour_format} and is stored as JPEG of quality "
                f"{encodings.JPEG_QUALITY}"
            )
        if self.truncated:
            self.notes.append(
                f"the file is cut off: {counts['colour']} colour and {counts['depth']} depth "
                "images could be read"
            )
        if self._recording.broken_packets:
            self.notes.append(f"{self._recording.broken_packets} damaged packets left out")
        rotation = self._recording.colour_from_accelerometer()
        if rotation is not None:
            self.gravity, note = accelerometer.gravity(rotation)
            self.notes += [note] if note else []
