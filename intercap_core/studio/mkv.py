"""Writer of Azure Kinect MKV recordings that the Azure Kinect SDK itself opens.

A Matroska file consists of nested elements: id, length, payload (RFC 8794, RFC 9559). The SDK (its
``matroska_read.cpp``, MIT) also requires that every image track is ``V_MS/VFW/FOURCC`` with a
BITMAPINFOHEADER and a frame period of exactly 1/5, 1/15 or 1/30 s, and the tags below. Muxers of
general use write other codec ids, which it refuses.
"""

from __future__ import annotations

import hashlib
import struct
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np

from intercap_core.formats.calibration.k4a import COLOUR_MODES, DEPTH_MODES

KINECT_RATES = (5, 15, 30)  # frames a second
TIMECODE_SCALE_NS = 1000  # block times are microseconds
CLUSTER_SPAN_US = 30_000  # a block's time is a signed 16-bit number of microseconds in its cluster
ColourFormat = Literal["MJPG", "NV12", "YUY2", "BGRA"]
_COLOUR_BITS = {"MJPG": 24, "NV12": 12, "YUY2": 16, "BGRA": 32}  # a pixel, as the SDK writes them
WiredSyncMode = Literal["STANDALONE", "MASTER", "SUBORDINATE"]

# Ids of elements by their names (RFC 8794, RFC 9559).
_IDS = {
    "EBML": 0x1A45DFA3, "Segment": 0x18538067, "SeekHead": 0x114D9B74, "Void": 0xEC,
    "Info": 0x1549A966, "Tracks": 0x1654AE6B, "Attachments": 0x1941A469, "Tags": 0x1254C367,
    "Cluster": 0x1F43B675, "Cues": 0x1C53BB6B, "EBMLVersion": 0x4286, "EBMLReadVersion": 0x42F7,
    "EBMLMaxIDLength": 0x42F2, "EBMLMaxSizeLength": 0x42F3, "DocTypeVersion": 0x4287,
    "DocTypeReadVersion": 0x4285, "MuxingApp": 0x4D80, "WritingApp": 0x5741, "Title": 0x7BA9,
    "FileName": 0x466E, "FileMimeType": 0x4660, "FileData": 0x465C, "FileUID": 0x46AE,
    "TrackNumber": 0xD7, "TrackUID": 0x73C5, "FlagLacing": 0x9C, "CodecPrivate": 0x63A2,
    "DefaultDuration": 0x23E383, "Video": 0xE0, "BlockDuration": 0x9B, "Seek": 0x4DBB,
    "SeekID": 0x53AB, "SeekPosition": 0x53AC, "DocType": 0x4282, "Duration": 0x4489,
    "AttachedFile": 0x61A7, "TrackType": 0x83, "Name": 0x536E, "TrackEntry": 0xAE, "CodecID": 0x86,
    "PixelWidth": 0xB0, "PixelHeight": 0xBA, "TargetType": 0x63CA, "TagTrackUID": 0x63C5,
    "TagAttachmentUID": 0x63C6, "TagName": 0x45A3, "TagString": 0x4487, "Tag": 0x7373,
    "Targets": 0x63C0, "SimpleTag": 0x67C8, "BlockGroup": 0xA0, "SimpleBlock": 0xA3,
    "Timestamp": 0xE7, "CueTrackPositions": 0xB7, "CueTrack": 0xF7, "CueClusterPosition": 0xF1,
    "CuePoint": 0xBB, "CueTime": 0xB3, "Block": 0xA1, "TimestampScale": 0x2AD7B1,
}  # fmt: skip
_UNKNOWN_SIZE = b"\x01" + b"\xff" * 7
_SEEK_HEAD_BYTES = 256  # reserved for five entries; the rest is a Void element
_VIDEO, _SUBTITLE = 1, 17  # TrackType


def _id(name: str) -> bytes:
    number = _IDS[name]
    return number.to_bytes((number.bit_length() + 7) // 8, "big")


def _size(length: int, width: int = 0) -> bytes:
    """An element's length: a marker bit, then the number, in ``width`` bytes (0 = the fewest)."""
    if not width:
        width = next(w for w in range(1, 9) if length < (1 << 7 * w) - 1)
    return (length | 1 << 7 * width).to_bytes(width, "big")


# Content of an element: bytes, a number, text, or other elements by name.
Content = bytes | int | str | dict[str, Any]


def _element(name: str, content: Content, width: int = 0) -> bytes:
    """Serialize an element; its length has ``width`` bytes, 0 = the fewest."""
    if isinstance(content, dict):
        payload = b"".join(_element(*item) for item in content.items())
    elif isinstance(content, int):
        payload = content.to_bytes(max(1, (content.bit_length() + 7) // 8), "big")
    else:
        payload = content if isinstance(content, bytes) else content.encode()
    return _id(name) + _size(len(payload), width) + payload


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

        # Value of each tag, and the track or attachment that it describes; "" = the file.
        tags: dict[str, tuple[str, str]] = {}
        colour = f"{colour_format}_{colour_mode}"
        modes = {"COLOR": colour, "DEPTH": depth_mode or "", "IR": "ACTIVE", "IMU": "ON"}
        for name in names:
            tags[f"K4A_{name}_TRACK"] = (str(self._uid(name)), name)
            tags[f"K4A_{name}_MODE"] = (modes[name], name)
        if calibration_json is not None:
            tags["K4A_CALIBRATION_FILE"] = ("calibration.json", "calibration.json")
        tags["K4A_DEPTH_DELAY_NS"] = (str(depth_delay_ns), "")
        tags["K4A_WIRED_SYNC_MODE"] = (wired_sync_mode, "")
        if wired_sync_mode == "SUBORDINATE":
            tags["K4A_SUBORDINATE_DELAY_NS"] = (str(subordinate_delay_ns), "")
        tags["K4A_DEVICE_SERIAL_NUMBER"] = (serial, "")
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
            positions["Cues"] = self._file.tell() - self._segment_start
            self._file.write(_element("Cues", b"".join(self._cues)))
        end = self._file.tell()
        entries = b"".join(
            _element("Seek", {"SeekID": _id(name), "SeekPosition": position.to_bytes(8, "big")})
            for name, position in positions.items()
        )
        head = _element("SeekHead", entries)
        filler = _SEEK_HEAD_BYTES - len(head)
        self._patch(self._segment_start, head + _element("Void", bytes(filler - 9), 8))
        self._patch(self._segment_start - 8, _size(end - self._segment_start, 8))
        self._patch(self._duration_at, struct.pack(">d", float(self._last_us)))
        self._file.close()

    def _uid(self, name: str) -> int:
        """A track's or attachment's id: random-looking, never 0, the same for the same device."""
        digest = hashlib.sha256(f"{self._serial}/{name}".encode()).digest()
        return int.from_bytes(digest[:7], "big") | 1

    def _write_head(
        self, fps: int, calibration: bytes | None, tags: dict[str, tuple[str, str]]
    ) -> None:
        ebml: Content = {
            "EBMLVersion": 1, "EBMLReadVersion": 1, "EBMLMaxIDLength": 4, "EBMLMaxSizeLength": 8,
            "DocType": "matroska", "DocTypeVersion": 2, "DocTypeReadVersion": 2,
        }  # fmt: skip
        self._file.write(_element("EBML", ebml) + _id("Segment") + _UNKNOWN_SIZE)
        self._segment_start = self._file.tell()
        self._file.write(_element("Void", bytes(_SEEK_HEAD_BYTES - 9), 8))

        self._positions: dict[str, int] = {}
        info = {
            "TimestampScale": TIMECODE_SCALE_NS,
            "MuxingApp": "intercap",
            "WritingApp": "intercap",
            "Title": "Azure Kinect",
            "Duration": bytes(8),  # filled in at the end
        }
        self._top("Info", info)
        self._duration_at = self._file.tell() - 8
        self._top("Tracks", b"".join(self._track_entry(n, i, fps) for n, i in self._tracks.items()))
        if calibration is not None:
            attached = {
                "FileName": "calibration.json",
                "FileMimeType": "application/octet-stream",
                "FileData": calibration,
                "FileUID": self._uid("calibration.json"),
            }
            self._top("Attachments", {"AttachedFile": attached})
        self._top("Tags", b"".join(self._tag(name, *value) for name, value in tags.items()))

    def _top(self, name: str, payload: Content) -> None:
        """Write an element of the Segment and remember its position for the index."""
        self._positions[name] = self._file.tell() - self._segment_start
        self._file.write(_element(name, payload))

    def _track_entry(self, name: str, number: int, fps: int) -> bytes:
        """The TrackEntry of a track."""
        entry: dict[str, Any] = {
            "TrackNumber": number,
            "TrackUID": self._uid(name),
            "TrackType": _SUBTITLE if name == "IMU" else _VIDEO,
            "FlagLacing": 0,
            "Name": name,
        }
        if name == "IMU":
            return _element("TrackEntry", {**entry, "CodecID": "S_K4A/IMU"})
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
        entry |= {
            "CodecID": "V_MS/VFW/FOURCC",
            "CodecPrivate": header,
            "DefaultDuration": 1_000_000_000 // fps,
            "Video": {"PixelWidth": width, "PixelHeight": height},
        }
        return _element("TrackEntry", entry)

    def _tag(self, name: str, value: str, about: str) -> bytes:
        """The element of a tag, for the whole file if ``about`` is ""."""
        target: Content = {}
        if about in self._tracks:
            target = {"TargetType": "TRACK", "TagTrackUID": self._uid(about)}
        elif about:
            target = {"TargetType": "ATTACHMENT", "TagAttachmentUID": self._uid(about)}
        simple = {"TagName": name, "TagString": value}
        return _element("Tag", {"Targets": target, "SimpleTag": simple})

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
            group = {"Block": block + b"\x00" + payload, "BlockDuration": 1}
            self._cluster.append(_element("BlockGroup", group))
        else:
            head = block + b"\x80"  # a key frame
            self._cluster += [_id("SimpleBlock"), _size(len(head) + len(payload)), head, payload]
        self._last_us = max(self._last_us, time_us)

    def _flush_cluster(self) -> None:
        """Write the collected blocks as one cluster, and note its position for the index."""
        if not self._cluster or self._cluster_us is None:
            return
        position = self._file.tell() - self._segment_start
        time = _element("Timestamp", self._cluster_us)
        length = len(time) + sum(len(block) for block in self._cluster)
        self._file.write(_id("Cluster") + _size(length, 8) + time)
        self._file.writelines(self._cluster)
        track = min(self._cluster_tracks, default=self._tracks["COLOR"])
        where = {"CueTrack": track, "CueClusterPosition": position}
        cue = {"CueTime": self._cluster_us, "CueTrackPositions": where}
        self._cues.append(_element("CuePoint", cue))
        self._cluster, self._cluster_us = [], None
        self._cluster_tracks = set()

    def _patch(self, position: int, content: bytes) -> None:
        self._file.seek(position)
        self._file.write(content)
