"""Writer of Azure Kinect MKV recordings that the Azure Kinect SDK itself opens.

Matroska is nested elements: an id, a length, a payload (RFC 8794, RFC 9559). What the SDK asks for
on top (its ``matroska_read.cpp``, MIT): every image track is ``V_MS/VFW/FOURCC`` with a
BITMAPINFOHEADER and a frame period of exactly 1/5, 1/15 or 1/30 s, and the tags below. Muxers of
general use write other codec ids, which it refuses.
"""

from __future__ import annotations

import hashlib
import struct
from pathlib import Path
from typing import IO, Literal

import numpy as np

from intercap_core.formats.calibration.k4a import COLOUR_MODES, DEPTH_MODES

KINECT_RATES = (5, 15, 30)  # frames a second
TIMECODE_SCALE_NS = 1000  # block times are microseconds
CLUSTER_SPAN_US = 30_000  # a block's time is a signed 16-bit number of microseconds in its cluster
ColourFormat = Literal["MJPG", "NV12", "YUY2", "BGRA"]
_COLOUR_BITS = {"MJPG": 24, "NV12": 12, "YUY2": 16, "BGRA": 32}  # a pixel, as the SDK writes them
WiredSyncMode = Literal["STANDALONE", "MASTER", "SUBORDINATE"]

_EBML, _SEGMENT, _SEEK_HEAD, _VOID = 0x1A45DFA3, 0x18538067, 0x114D9B74, 0xEC
_INFO, _TRACKS, _ATTACHMENTS, _TAGS = 0x1549A966, 0x1654AE6B, 0x1941A469, 0x1254C367
_CLUSTER, _CUES = 0x1F43B675, 0x1C53BB6B
_UNKNOWN_SIZE = b"\x01" + b"\xff" * 7
_SEEK_HEAD_BYTES = 256  # reserved for five entries; the rest is a Void element
_VIDEO, _SUBTITLE = 1, 17  # TrackType


def _id(number: int) -> bytes:
    return number.to_bytes((number.bit_length() + 7) // 8, "big")


def _size(length: int, width: int = 0) -> bytes:
    """An element's length: a marker bit, then the number, in ``width`` bytes (0 = the fewest)."""
    if not width:
        width = next(w for w in range(1, 9) if length < (1 << 7 * w) - 1)
    return (length | 1 << 7 * width).to_bytes(width, "big")


def _element(number: int, payload: bytes, width: int = 0) -> bytes:
    return _id(number) + _size(len(payload), width) + payload


def _unsigned(number: int, value: int, width: int = 0) -> bytes:
    width = width or max(1, (value.bit_length() + 7) // 8)
    return _element(number, value.to_bytes(width, "big"))


def _text(number: int, value: str) -> bytes:
    return _element(number, value.encode())


class MkvWriter:
    """Writes one camera's recording, in order of time, with memory for one cluster only.

    A context manager: on leaving, the index and the sizes are filled in. Times are the device's
    microseconds. The same calls write the same bytes. Raises ValueError for unknown modes, for
    images of another size and for times before the start or more than a cluster back.
    """

    def __init__(
        self,
        path: Path,
        *,
        calibration_json: bytes | None,
        colour_mode: str,
        depth_mode: str | None,
        fps: int,
        serial: str,
        start_offset_ns: int = 0,
        depth_delay_ns: int = 0,
        wired_sync_mode: WiredSyncMode = "STANDALONE",
        subordinate_delay_ns: int = 0,
        with_ir: bool = False,
        with_imu: bool = False,
        colour_format: ColourFormat = "MJPG",
    ) -> None:
        """Open a recording.

        Args:
            calibration_json: the device's calibration; None omits the attachment.
            colour_mode: key of ``COLOUR_MODES``.
            depth_mode: key of ``DEPTH_MODES``; None omits the depth track.
            start_offset_ns: device time at which the file's clock starts.
        """
        if fps not in KINECT_RATES:
            raise ValueError(f"fps is {fps}, the device records at 5, 15 or 30")
        if start_offset_ns % TIMECODE_SCALE_NS:
            raise ValueError(f"start_offset_ns {start_offset_ns} is not a whole microsecond")
        self._colour_format = colour_format
        self._colour_size = COLOUR_MODES[colour_mode].size
        self._depth_size = DEPTH_MODES[depth_mode].size if depth_mode else None
        self._start_us = start_offset_ns // TIMECODE_SCALE_NS
        self._serial = serial
        names = ["COLOR"] + ["DEPTH"] * bool(depth_mode) + ["IR"] * with_ir + ["IMU"] * with_imu
        self._tracks = {name: number for number, name in enumerate(names, start=1)}
        self._cluster_us: int | None = None
        self._cluster: list[bytes] = []
        self._cluster_tracks: set[int] = set()
        self._cues: list[bytes] = []
        self._last_us = 0

        tags = self._tags(colour_mode, depth_mode, calibration_json is not None)
        tags["K4A_DEPTH_DELAY_NS"] = (str(depth_delay_ns), "")
        tags["K4A_WIRED_SYNC_MODE"] = (wired_sync_mode, "")
        if wired_sync_mode == "SUBORDINATE":
            tags["K4A_SUBORDINATE_DELAY_NS"] = (str(subordinate_delay_ns), "")
        tags["K4A_DEVICE_SERIAL_NUMBER"] = (self._serial, "")
        tags["K4A_START_OFFSET_NS"] = (str(start_offset_ns), "")

        self._file: IO[bytes] = open(path, "wb")  # noqa: SIM115 - closed by close()
        self._write_head(fps, calibration_json, tags)

    def __enter__(self) -> MkvWriter:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def write_colour(self, image: bytes, device_time_us: int) -> None:
        """Add one JPEG image, or the bytes of a raw image if ``colour_format`` is not MJPG."""
        self._write("COLOR", image, device_time_us)

    def write_depth(self, depth: np.ndarray, device_time_us: int) -> None:
        """Add one depth image (H, W) uint16, millimetres, 0 = invalid."""
        self._write_image("DEPTH", depth, device_time_us)

    def write_ir(self, infrared: np.ndarray, device_time_us: int) -> None:
        """Add one infrared image (H, W) uint16."""
        self._write_image("IR", infrared, device_time_us)

    def write_imu(
        self, acceleration: np.ndarray, angular_velocity: np.ndarray, device_time_us: int
    ) -> None:
        """Add one sample: m/s^2 (3,) and rad/s (3,), both in their sensor's axes."""
        time_ns = device_time_us * 1000
        acc, gyro = (np.asarray(v, "<f4").tobytes() for v in (acceleration, angular_velocity))
        stamp = struct.pack("<Q", time_ns)
        self._write("IMU", stamp + acc + stamp + gyro, device_time_us)

    def turn_back(self) -> None:
        """Allow the next image to be older than the last one, as after a jump of the clock."""
        self._flush_cluster()

    def close(self) -> None:
        """Write the index, fill in sizes and positions, and close the file; safe to call twice."""
        if self._file.closed:
            return
        self._flush_cluster()
        positions = dict(self._positions)
        if self._cues:
            positions[_CUES] = self._file.tell() - self._segment_start
            self._file.write(_element(_CUES, b"".join(self._cues)))
        end = self._file.tell()
        # Seek: SeekID, SeekPosition
        entries = b"".join(
            _element(0x4DBB, _element(0x53AB, _id(number)) + _unsigned(0x53AC, position, 8))
            for number, position in positions.items()
        )
        head = _element(_SEEK_HEAD, entries)
        filler = _SEEK_HEAD_BYTES - len(head)
        self._patch(self._segment_start, head + _element(_VOID, bytes(filler - 9), 8))
        self._patch(self._segment_start - 8, _size(end - self._segment_start, 8))
        self._patch(self._duration_at, struct.pack(">d", float(self._last_us)))
        self._file.close()

    def _uid(self, name: str) -> int:
        """A track's or attachment's id: random-looking, never 0, the same for the same device."""
        digest = hashlib.sha256(f"{self._serial}/{name}".encode()).digest()
        return int.from_bytes(digest[:7], "big") | 1

    def _tags(
        self, colour_mode: str, depth_mode: str | None, calibrated: bool
    ) -> dict[str, tuple[str, str]]:
        """Tags: name -> (value, track or attachment that the tag describes; "" = the file)."""
        tags = {
            "K4A_COLOR_TRACK": (str(self._uid("COLOR")), "COLOR"),
            "K4A_COLOR_MODE": (f"{self._colour_format}_{colour_mode}", "COLOR"),
        }
        if depth_mode:
            tags["K4A_DEPTH_TRACK"] = (str(self._uid("DEPTH")), "DEPTH")
            tags["K4A_DEPTH_MODE"] = (depth_mode, "DEPTH")
        if "IR" in self._tracks:
            tags["K4A_IR_TRACK"] = (str(self._uid("IR")), "IR")
            tags["K4A_IR_MODE"] = ("ACTIVE", "IR")
        if "IMU" in self._tracks:
            tags["K4A_IMU_TRACK"] = (str(self._uid("IMU")), "IMU")
            tags["K4A_IMU_MODE"] = ("ON", "IMU")
        if calibrated:
            tags["K4A_CALIBRATION_FILE"] = ("calibration.json", "calibration.json")
        return tags

    def _write_head(
        self, fps: int, calibration: bytes | None, tags: dict[str, tuple[str, str]]
    ) -> None:
        ebml = (
            _unsigned(0x4286, 1)  # EBMLVersion
            + _unsigned(0x42F7, 1)  # EBMLReadVersion
            + _unsigned(0x42F2, 4)  # EBMLMaxIDLength
            + _unsigned(0x42F3, 8)  # EBMLMaxSizeLength
            + _text(0x4282, "matroska")
            + _unsigned(0x4287, 2)  # DocTypeVersion
            + _unsigned(0x4285, 2)  # DocTypeReadVersion
        )
        self._file.write(_element(_EBML, ebml) + _id(_SEGMENT) + _UNKNOWN_SIZE)
        self._segment_start = self._file.tell()
        self._file.write(_element(_VOID, bytes(_SEEK_HEAD_BYTES - 9), 8))

        self._positions: dict[int, int] = {}
        info = (
            _unsigned(0x2AD7B1, TIMECODE_SCALE_NS)
            + _text(0x4D80, "intercap")  # MuxingApp
            + _text(0x5741, "intercap")  # WritingApp
            + _text(0x7BA9, "Azure Kinect")  # Title
            + _element(0x4489, bytes(8))  # Duration, filled in at the end
        )
        self._top(_INFO, info)
        self._duration_at = self._file.tell() - 8
        self._top(_TRACKS, b"".join(self._track_entry(n, i, fps) for n, i in self._tracks.items()))
        if calibration is not None:
            attached = (
                _text(0x466E, "calibration.json")  # FileName
                + _text(0x4660, "application/octet-stream")  # FileMimeType
                + _element(0x465C, calibration)  # FileData
                + _unsigned(0x46AE, self._uid("calibration.json"))  # FileUID
            )
            self._top(_ATTACHMENTS, _element(0x61A7, attached))
        self._top(_TAGS, b"".join(self._tag(name, *value) for name, value in tags.items()))

    def _top(self, number: int, payload: bytes) -> None:
        """Write an element of the Segment and remember its position for the index."""
        self._positions[number] = self._file.tell() - self._segment_start
        self._file.write(_element(number, payload))

    def _track_entry(self, name: str, number: int, fps: int) -> bytes:
        """The TrackEntry of a track."""
        entry = (
            _unsigned(0xD7, number)  # TrackNumber
            + _unsigned(0x73C5, self._uid(name))  # TrackUID
            + _unsigned(0x83, _SUBTITLE if name == "IMU" else _VIDEO)
            + _unsigned(0x9C, 0)  # FlagLacing
            + _text(0x536E, name)
        )
        if name == "IMU":
            return _element(0xAE, entry + _text(0x86, "S_K4A/IMU"))
        if name == "COLOR":
            (width, height), bits = self._colour_size, _COLOUR_BITS[self._colour_format]
            four_cc = self._colour_format.encode()
        else:
            assert self._depth_size is not None
            (width, height), four_cc, bits = self._depth_size, b"b16g", 16
        image_bytes = 0 if four_cc == b"MJPG" else width * height * bits // 8
        # BITMAPINFOHEADER: size 40, width, height, planes 1, bits, codec, bytes, four unused fields
        header = struct.pack(
            "<IiiHH4sIiiII", 40, width, height, 1, bits, four_cc, image_bytes, 0, 0, 0, 0
        )
        entry += (
            _text(0x86, "V_MS/VFW/FOURCC")
            + _element(0x63A2, header)  # CodecPrivate
            + _unsigned(0x23E383, 1_000_000_000 // fps)  # DefaultDuration
            + _element(0xE0, _unsigned(0xB0, width) + _unsigned(0xBA, height))  # Video
        )
        return _element(0xAE, entry)

    def _tag(self, name: str, value: str, about: str) -> bytes:
        """The element of a tag, for the whole file if ``about`` is ""."""
        # Tag: Targets (TargetType; TagTrackUID or TagAttachmentUID), SimpleTag (TagName, TagString)
        target = b""
        if about in self._tracks:
            target = _text(0x63CA, "TRACK") + _unsigned(0x63C5, self._uid(about))
        elif about:
            target = _text(0x63CA, "ATTACHMENT") + _unsigned(0x63C6, self._uid(about))
        simple = _text(0x45A3, name) + _text(0x4487, value)
        return _element(0x7373, _element(0x63C0, target) + _element(0x67C8, simple))

    def _write_image(self, name: str, image: np.ndarray, device_time_us: int) -> None:
        expected = self._depth_size and self._depth_size[::-1]
        if name in self._tracks and (image.shape != expected or image.dtype != np.uint16):
            raise ValueError(f"image is {image.shape} {image.dtype}, expected {expected} uint16")
        self._write(name, image.astype(">u2").tobytes(), device_time_us)

    def _write(self, name: str, payload: bytes, device_time_us: int) -> None:
        """Add a block. A second image of its track, or a time too far away, ends the cluster."""
        if name not in self._tracks:
            raise ValueError(f"this recording was opened without {name} track")
        track = self._tracks[name]
        time_us = int(device_time_us) - self._start_us
        if time_us < 0:
            raise ValueError(f"device time {device_time_us} us is before the recording's start")
        start = self._cluster_us
        if start is None or track in self._cluster_tracks or time_us - start > CLUSTER_SPAN_US:
            self._flush_cluster()
            self._cluster_us = start = time_us
        relative = time_us - start
        if relative < -CLUSTER_SPAN_US:
            raise ValueError(f"device time {device_time_us} us is far before the one written last")
        if name != "IMU":  # many samples share a cluster, images of one track do not
            self._cluster_tracks.add(track)
        block = _size(track) + struct.pack(">h", relative)
        if name == "IMU":
            group = _element(0xA1, block + b"\x00" + payload) + _unsigned(0x9B, 1)  # BlockDuration
            self._cluster.append(_element(0xA0, group))
        else:
            head = block + b"\x80"  # a key frame
            self._cluster.append(_id(0xA3) + _size(len(head) + len(payload)) + head + payload)
        self._last_us = max(self._last_us, time_us)

    def _flush_cluster(self) -> None:
        """Write the collected blocks as one cluster, and note its position for the index."""
        if not self._cluster or self._cluster_us is None:
            return
        position = self._file.tell() - self._segment_start
        time = _unsigned(0xE7, self._cluster_us)
        length = len(time) + sum(len(block) for block in self._cluster)
        self._file.write(_id(_CLUSTER) + _size(length, 8) + time)
        self._file.writelines(self._cluster)
        track = min(self._cluster_tracks, default=self._tracks["COLOR"])
        # CuePoint: CueTime, CueTrackPositions (CueTrack, CueClusterPosition)
        where = _element(0xB7, _unsigned(0xF7, track) + _unsigned(0xF1, position))
        self._cues.append(_element(0xBB, _unsigned(0xB3, self._cluster_us) + where))
        self._cluster, self._cluster_us = [], None
        self._cluster_tracks = set()

    def _patch(self, position: int, content: bytes) -> None:
        self._file.seek(position)
        self._file.write(content)
