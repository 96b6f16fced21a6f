"""Image files: encodings of single images, and recordings that consist of many files.

JPEG: ITU-T T.81, annex B; PNG: RFC 2083; Exif: CIPA DC-008, 4.6.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.recordings.source import CameraRecording, Image, RecordingPreview
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera
from intercap_core.inputs.files import MAX_IMAGE_BYTES, UnreadableFile, read_bytes

JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"
PNG_START, PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
JPEG_QUALITY = 97  # of colour that was not recorded as JPEG; an error of about 1 grey level
RAW_FORMATS = {"NV12": 1.5, "YUY2": 2.0, "BGRA": 4.0}  # bytes a pixel


def encoded_size(content: bytes) -> tuple[int, int] | None:
    """Width and height of a JPEG or PNG file; None if the content is no complete file.

    The size is that of the image as OpenCV decodes it: rotated by a JPEG's Exif orientation. The
    file's end must be there (zero bytes may follow a JPEG's), and in a JPEG a scan. Pixels are not
    decoded.
    """
    if content.startswith(PNG_START):
        complete = content.endswith(PNG_END) and len(content) >= 33
        return struct.unpack(">II", content[16:24]) if complete else None
    if not content.startswith(JPEG_START):
        return None
    if not content.endswith(JPEG_END) and not content.rstrip(b"\0").endswith(JPEG_END):
        return None
    return _jpeg_size(content)


def _jpeg_size(content: bytes) -> tuple[int, int] | None:
    """Parse the segments up to the first scan; the frame header before it holds the size."""
    at, rotated = 2, False
    size: tuple[int, int] | None = None
    while at + 9 <= len(content) and content[at] == 0xFF:
        marker = content[at + 1]
        if marker == 0xFF:  # a fill byte
            at += 1
            continue
        # Frame headers are C0 to CF except tables, reserved and arithmetic conditioning.
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", content[at + 5 : at + 9])
            size = (height, width) if rotated else (width, height)
        end = at + 2 + int.from_bytes(content[at + 2 : at + 4], "big")
        if marker == 0xE1 and content[at + 4 : at + 10] == b"Exif\0\0":
            rotated = _orientation(content[at + 10 : end]) >= 5  # by a quarter turn
        if marker == 0xDA:  # a scan
            return size if end + 2 < len(content.rstrip(b"\0")) else None
        at = end
    return None


def _orientation(tiff: bytes) -> int:
    """The Exif orientation, 1 to 8; 1 (as stored) without an entry."""
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None or len(tiff) < 10:
        return 1
    (at,) = struct.unpack(f"{order}I", tiff[4:8])
    (entries,) = struct.unpack(f"{order}H", tiff[at : at + 2].ljust(2, b"\0"))
    for start in range(at + 2, min(at + 2 + 12 * entries, len(tiff) - 11), 12):
        tag, _, _, value = struct.unpack(f"{order}HHIH", tiff[start : start + 10])
        if tag == 0x0112:
            return value if 1 <= value <= 8 else 1
    return 1


def encode_jpeg(image: np.ndarray) -> bytes:
    """Encode (H, W, 3) uint8 BGR as JPEG of :data:`JPEG_QUALITY`."""
    done, content = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise ValueError(f"an image of {image.shape} {image.dtype} cannot be stored as JPEG")
    return content.tobytes()


def decode_raw(content: bytes, pixel_format: str, size: tuple[int, int]) -> np.ndarray:
    """Decode a raw image of ``size`` (width, height) to (H, W, 3) uint8 BGR.

    ``pixel_format`` is one of :data:`RAW_FORMATS`. YUV is BT.601 with limited range, as in the
    viewer of the Azure Kinect. Raises ValueError for another number of bytes.
    """
    width, height = size
    shape, code = {
        "NV12": ((height * 3 // 2, width), cv2.COLOR_YUV2BGR_NV12),
        "YUY2": ((height, width, 2), cv2.COLOR_YUV2BGR_YUY2),
        "BGRA": ((height, width, 4), cv2.COLOR_BGRA2BGR),
    }[pixel_format]
    return cv2.cvtColor(np.frombuffer(content, np.uint8).reshape(shape), code)


class DamagedImage(Exception):
    """The file is no usable image or mask; the message follows the file's name."""


class ImagePair(NamedTuple):
    """Colour and depth file of one camera at one time; None = no file."""

    time_us: int
    """Device time, microseconds."""
    colour: Path | None
    depth: Path | None


def read_colour(path: Path) -> bytes:
    """Content of a complete JPEG or PNG file; raises :class:`DamagedImage` for anything else."""
    content = read_content(path)
    if encoded_size(content) is None:
        raise DamagedImage("is no whole JPEG or PNG")
    return content


def read_depth(path: Path, size: tuple[int, int]) -> np.ndarray:
    """Decode a 16-bit PNG of one channel to (H, W) uint16, millimetres.

    Raises :class:`DamagedImage` for anything else, and for another ``size`` (width, height).
    """
    content = read_content(path)
    _check_depth_head(content, size)
    if not content.endswith(PNG_END):
        raise DamagedImage("is cut off")
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint16 or image.shape != size[::-1]:
        raise DamagedImage("does not decode")
    return image


def _check_depth_head(content: bytes, size: tuple[int, int]) -> None:
    if not content.startswith(PNG_START) or len(content) < 26:
        raise DamagedImage("is no PNG")
    width, height, bits, colour_type = struct.unpack_from(">IIBB", content, 16)
    if bits != 16 or colour_type != 0:
        raise DamagedImage(f"is no 16-bit grey PNG ({bits} bits, colour type {colour_type})")
    if (width, height) != size:
        raise DamagedImage(f"has {width}x{height} pixels, the colour images {size[0]}x{size[1]}")


def read_content(path: Path, length: int | None = None) -> bytes:
    """Bytes of an image file, or its first ``length``; raises :class:`DamagedImage`."""
    try:
        return read_bytes(path, MAX_IMAGE_BYTES, head=length)
    except UnreadableFile as error:
        raise DamagedImage(error.reason) from None


def find_size(paths: Iterable[Path]) -> tuple[int, int] | None:
    """Width and height of the first complete image; None if there is none."""
    for path in paths:
        with contextlib.suppress(DamagedImage):
            size = encoded_size(read_content(path))
            if size is not None:
                return size
    return None


class FilesRecording(CameraRecording):
    """One camera's image files: colour files are copied, depth is decoded.

    Depth images have the size of the camera's depth lens. Without a depth lens they are not read.
    ``shots``: files in order of time; ``fps``: nominal images a second.
    """

    def __init__(self, source: Path, camera: Camera, shots: list[ImagePair], fps: float) -> None:
        super().__init__(source, camera, fps=fps)
        self._shots = shots

    @property
    def colour_files(self) -> list[tuple[int, Path]]:
        """Device time, microseconds, and path of all colour files, including damaged ones."""
        return [(shot.time_us, shot.colour) for shot in self._shots if shot.colour is not None]

    def preview(self) -> RecordingPreview:
        """Inspect the sizes of all files, and some of the images."""
        files = self.colour_files
        size = find_size(path for _, path in files)
        times = [time_us for time_us, _ in files]
        seconds = (times[-1] - times[0]) * 1e-6 if times else None
        faults = inspect_files(self._shots, self.camera.depth)
        return RecordingPreview(size, len(files), seconds, faults=tuple(faults))

    def images(self) -> Iterator[Image]:
        """Yield images in the order of the shots; damaged ones are left out and counted."""
        return read_pairs(self, self._shots)


def inspect_files(shots: list[ImagePair], lens: Intrinsics | None) -> list[str]:
    """Faults of a camera's image files: empty files, and damaged ones among a few.

    ``lens`` is that of the depth camera; None = depth is not used.
    """
    faults = []
    for kind, paths in (
        ("colour", [shot.colour for shot in shots if shot.colour is not None]),
        ("depth", [shot.depth for shot in shots if shot.depth is not None and lens is not None]),
    ):
        empty = [path for path in paths if path.stat().st_size == 0]
        if empty:
            faults.append(
                f"{len(empty)} of {len(paths)} {kind} files are empty (first: {empty[0].name})"
            )
        bad = []
        chosen = np.unique(np.linspace(0, len(paths) - 1, 5).round().astype(int))
        chosen = chosen[: len(paths)].tolist()  # evenly over the recording
        for index in chosen:
            try:
                if kind == "colour":
                    read_colour(paths[index])
                elif lens is not None:
                    read_depth(paths[index], (lens.width, lens.height))
            except DamagedImage as error:
                if paths[index] not in empty:
                    bad.append(f"{paths[index].name} {error}")
        if bad:
            faults.append(
                f"{len(bad)} of {len(chosen)} inspected {kind} files are damaged (first: {bad[0]})"
            )
    return faults


def read_pairs(recording: CameraRecording, shots: list[ImagePair]) -> Iterator[Image]:
    """Yield the images of ``shots``; damaged ones are noted at the recording."""
    lens = recording.camera.depth
    damaged: list[str] = []
    for time_us, colour, depth in shots:
        if colour is not None:
            try:
                yield Image("colour", time_us, read_colour(colour))
            except DamagedImage as error:
                damaged.append(f"{colour.name} {error}")
        if depth is not None and lens is not None:
            try:
                yield Image("depth", time_us, read_depth(depth, (lens.width, lens.height)))
            except DamagedImage as error:
                damaged.append(f"{depth.name} {error}")
    without = sum(shot.colour is not None and shot.depth is None for shot in shots)
    if lens is not None and without:
        recording.notes.append(f"no depth image with {without} of its colour images")
    if damaged:
        recording.notes.append(f"{len(damaged)} damaged images left out (first: {damaged[0]})")


class AlignedRecording(FilesRecording):
    """One camera's image files with depth on the colour image's pixel grid: both have one lens.

    ``shots`` are in order of time. If no depth file is a 16-bit PNG of the colour image's size, the
    camera counts as without depth, with a note. Raises UserError, naming ``source``, if there is no
    colour file.
    """

    def __init__(
        self,
        source: Path,
        name: str,
        lens: Intrinsics,
        pose: np.ndarray,
        *,
        shots: list[ImagePair],
        fps: float,
    ) -> None:
        self._shots, self._size = shots, (lens.width, lens.height)
        fault = self._fault_of_depth()
        aligned = not fault and any(shot.depth for shot in shots)
        camera = Camera(name, lens, lens if aligned else None, np.eye(4) if aligned else None, pose)
        super().__init__(source, camera, shots, fps)
        if fault:
            self.notes.append(fault)
        if not any(shot.colour for shot in shots):
            raise UserError(f"{source}: holds no colour image; copy this camera's images again")

    def _fault_of_depth(self) -> str:
        """Why no depth file can be used; "" if the head of any of them is right."""
        fault = ""
        for path in (shot.depth for shot in self._shots if shot.depth is not None):
            try:
                _check_depth_head(read_content(path, 32), self._size)
                return ""
            except DamagedImage as error:
                fault = fault or f"no depth used: {path.name} {error}"
        return fault

    def sample_depth(self, count: int) -> list[np.ndarray]:
        """Up to ``count`` depth images (H, W) uint16, mm, evenly over the recording.

        Raises UserError if none can be read.
        """
        paths = [shot.depth for shot in self._shots if shot.depth is not None]
        chosen = np.unique(np.linspace(0, len(paths) - 1, count).round().astype(int))
        images = []
        for index in chosen.tolist():
            with contextlib.suppress(DamagedImage):
                images.append(read_depth(paths[index], self._size))
        if not images:
            raise UserError(f"{self.source}: none of its depth images can be read")
        return images
