"""Image files of a released data set: their heads, their pixels, a camera made of many of them.

Depth here lies on the colour image's pixel grid, so that both have one lens.
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
from intercap_core.inputs.files import MAX_IMAGE_BYTES, Unreadable, read_bytes

JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"
PNG_START, PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
JPEG_QUALITY = 97  # of colour that was not recorded as JPEG; about 1 grey level of error
RAW_FORMATS = {"NV12": 1.5, "YUY2": 2.0, "BGRA": 4.0}  # bytes a pixel
_SCAN = 0xDA
_NO_FRAME_HEADERS = (0xC4, 0xC8, 0xCC)  # among C0..CF: tables, reserved, arithmetic conditioning


def encoded_size(content: bytes) -> tuple[int, int] | None:
    """Return width and height of a JPEG or PNG file; None for what is no whole file of these.

    They are those of the image as OpenCV decodes it: turned as a JPEG's Exif orientation says. The
    end must be there (zero bytes may follow a JPEG's), and in a JPEG a scan; its pixels are not
    looked at.
    """
    if content.startswith(PNG_START):
        whole = content.endswith(PNG_END) and len(content) >= 33
        return struct.unpack(">II", content[16:24]) if whole else None
    if not content.startswith(JPEG_START):
        return None
    if not content.endswith(JPEG_END) and not content.rstrip(b"\0").endswith(JPEG_END):
        return None
    return _jpeg_size(content)


def _jpeg_size(content: bytes) -> tuple[int, int] | None:
    """Walk the segments up to the first scan; the frame header before it holds the size."""
    at, lying = 2, False
    size: tuple[int, int] | None = None
    while at + 9 <= len(content) and content[at] == 0xFF:
        marker = content[at + 1]
        if marker == 0xFF:  # a fill byte
            at += 1
            continue
        if 0xC0 <= marker <= 0xCF and marker not in _NO_FRAME_HEADERS:
            height, width = struct.unpack(">HH", content[at + 5 : at + 9])
            size = (height, width) if lying else (width, height)
        end = at + 2 + int.from_bytes(content[at + 2 : at + 4], "big")
        if marker == 0xE1 and content[at + 4 : at + 10] == b"Exif\0\0":
            lying = _orientation(content[at + 10 : end]) >= 5  # by a quarter turn
        if marker == _SCAN:
            return size if end + 2 < len(content.rstrip(b"\0")) else None
        at = end
    return None


def _orientation(tiff: bytes) -> int:
    """The Exif orientation, 1 to 8; 1 (as stored) where there is none."""
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
    """Encode (H, W, 3) uint8 BGR, for recordings whose colour cannot be copied."""
    import cv2

    done, content = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise ValueError(f"an image of {image.shape} {image.dtype} cannot be stored as JPEG")
    return content.tobytes()


def decode_raw(content: bytes, pixel_format: str, size: tuple[int, int]) -> np.ndarray:
    """Return (H, W, 3) uint8 BGR of a raw image of ``size`` (width, height).

    ``pixel_format`` is one of :data:`RAW_FORMATS`; YUV is BT.601 with limited range, as the Azure
    Kinect's own viewer takes it. Raises ValueError for another number of bytes.
    """
    import cv2

    width, height = size
    shape, code = {
        "NV12": ((height * 3 // 2, width), cv2.COLOR_YUV2BGR_NV12),
        "YUY2": ((height, width, 2), cv2.COLOR_YUV2BGR_YUY2),
        "BGRA": ((height, width, 4), cv2.COLOR_BGRA2BGR),
    }[pixel_format]
    return cv2.cvtColor(np.frombuffer(content, np.uint8).reshape(shape), code)


LOOKED_AT = 5  # files of each kind that a preview opens, spread over the recording
GREY_TYPE = 0  # PNG colour type of one channel


class DamagedImage(Exception):
    """The file is no image that can be used; says why, in words that fit after its name."""


class ImagePair(NamedTuple):
    """What one camera recorded at one moment; None = no file."""

    time_us: int
    colour: Path | None
    depth: Path | None


def read_colour(path: Path) -> bytes:
    """Return a whole JPEG or PNG file as it is; raises :class:`DamagedImage` for anything else."""
    content = _read(path)
    if encoded_size(content) is None:
        raise DamagedImage("is no whole JPEG or PNG")
    return content


def read_depth(path: Path, size: tuple[int, int]) -> np.ndarray:
    """Decode a 16-bit PNG of one channel and of ``size``: (H, W) uint16, millimetres.

    Raises :class:`DamagedImage` for anything else.
    """
    content = _read(path)
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
    if bits != 16 or colour_type != GREY_TYPE:
        raise DamagedImage(f"is no 16-bit grey PNG ({bits} bits, colour type {colour_type})")
    _check_size((width, height), size)


def _check_size(found: tuple[int, int], expected: tuple[int, int]) -> None:
    if found != expected:
        raise DamagedImage(
            f"has {found[0]}x{found[1]} pixels, the colour images {expected[0]}x{expected[1]}"
        )


def _read(path: Path, length: int | None = None) -> bytes:
    try:
        return read_bytes(path, MAX_IMAGE_BYTES, head=length)
    except Unreadable as error:
        raise DamagedImage(error.reason) from None


def common_size(paths: Iterable[Path]) -> tuple[int, int] | None:
    """Return width and height of the first whole image; None where none does."""
    for path in paths:
        with contextlib.suppress(DamagedImage):
            size = encoded_size(_read(path))
            if size is not None:
                return size
    return None


class FilesRecording(CameraRecording):
    """One camera's image files: colour files as they are, depth decoded.

    Depth images have the size of the camera's depth lens; without one they are not read.
    """

    def __init__(self, source: Path, camera: Camera, shots: list[ImagePair], fps: float) -> None:
        super().__init__(source, camera, fps=fps)
        self._shots = shots

    @property
    def colour_files(self) -> list[tuple[int, Path]]:
        """Device time, microseconds, and path of every colour file, also of damaged ones."""
        return [(shot.time_us, shot.colour) for shot in self._shots if shot.colour is not None]

    def preview(self) -> RecordingPreview:
        """The sizes of all files, and some of the images."""
        files, size = self.colour_files, None
        for _, path in files:
            with contextlib.suppress(DamagedImage):
                size = encoded_size(read_colour(path))
                break
        times = [time_us for time_us, _ in files]
        seconds = (times[-1] - times[0]) * 1e-6 if times else None
        faults = faults_of_files(self._shots, self.camera.depth)
        return RecordingPreview(size, len(files), seconds, faults=tuple(faults))

    def images(self) -> Iterator[Image]:
        """Images in the order of the shots; damaged ones are left out and counted."""
        return read_pairs(self, self._shots)


def faults_of_files(shots: list[ImagePair], lens: Intrinsics | None) -> list[str]:
    """What is wrong with a camera's image files, by their sizes and a look into some of them.

    ``lens`` of the depth camera, None = its depth is not used.
    """
    faults = []
    for kind, paths in (
        ("colour", [shot.colour for shot in shots if shot.colour is not None]),
        ("depth", [shot.depth for shot in shots if shot.depth is not None and lens is not None]),
    ):
        empty = [path for path in paths if path.stat().st_size == 0]
        if empty:
            told = f"{len(empty)} of {len(paths)} {kind} files are empty (first: {empty[0].name})"
            faults.append(told)
        bad = []
        looked = np.unique(np.linspace(0, len(paths) - 1, LOOKED_AT).round().astype(int))
        looked = looked[: len(paths)].tolist()
        for index in looked:
            try:
                if kind == "colour":
                    read_colour(paths[index])
                elif lens is not None:
                    read_depth(paths[index], (lens.width, lens.height))
            except DamagedImage as error:
                if paths[index] not in empty:
                    bad.append(f"{paths[index].name} {error}")
        if bad:
            told = f"{len(bad)} of {len(looked)} {kind} files looked at are damaged"
            faults.append(f"{told} (first: {bad[0]})")
    return faults


def read_pairs(recording: CameraRecording, shots: list[ImagePair]) -> Iterator[Image]:
    """Yield the images of ``shots``; what is damaged is noted at the recording, by first name."""
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
        recording.notes.append(f"no depth image beside {without} of its colour images")
    if damaged:
        recording.notes.append(f"{len(damaged)} damaged images left out (first: {damaged[0]})")


class AlignedRecording(FilesRecording):
    """One camera's image files, with depth on the colour image's grid.

    ``shots`` are in order of time. A camera none of whose depth files is a 16-bit PNG of the
    colour image's size is one without depth, with a note. Raises UserError, naming ``source``,
    where there is no colour file at all.
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
        """What is wrong with all depth files; empty where some file's head is as it must be."""
        fault = ""
        for path in (shot.depth for shot in self._shots if shot.depth is not None):
            try:
                _check_depth_head(_read(path, 32), self._size)
                return ""
            except DamagedImage as error:
                fault = fault or f"no depth used: {path.name} {error}"
        return fault

    def sample_depth(self, count: int) -> list[np.ndarray]:
        """Up to ``count`` depth images (H, W) uint16 mm, spread over the recording.

        Raises UserError where none can be read.
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
