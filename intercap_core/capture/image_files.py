"""Image files of a released data set: their heads, their pixels, a camera made of many of them.

Depth here lies on the colour image's pixel grid, so that both have one lens.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from intercap_core.camera.intrinsics import Intrinsics
from intercap_core.camera.rig import Camera
from intercap_core.capture.source import CameraRecording, Image
from intercap_core.errors import UserError

JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"
PNG_START, PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB\x60\x82"
GREY_TYPE = 0  # PNG colour type of one channel
# Start-of-frame markers hold the size; C4, C8 and CC in their range are other tables.
_SIZE_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


class DamagedImage(Exception):
    """The file is no image that can be used; says why, in words that fit after its name."""


class Shot(NamedTuple):
    """What one camera recorded at one moment; None = no file."""

    time_us: int
    colour: Path | None
    depth: Path | None


def jpeg_size(content: bytes) -> tuple[int, int]:
    """Return width and height that the head of a JPEG states, without decoding it.

    Raises :class:`DamagedImage` where there is none.
    """
    if not content.startswith(JPEG_START):
        raise DamagedImage("is no JPEG")
    at = 2
    while at + 9 <= len(content) and content[at] == 0xFF:
        marker = content[at + 1]
        if marker == 0xFF:  # padding
            at += 1
            continue
        if marker in _SIZE_MARKERS:
            height, width = struct.unpack_from(">HH", content, at + 5)
            return width, height
        at += 2 + int.from_bytes(content[at + 2 : at + 4], "big")
    raise DamagedImage("is a JPEG without a size in its head")


def read_jpeg(path: Path, size: tuple[int, int]) -> bytes:
    """Return a whole JPEG file of ``size`` as it is; raises :class:`DamagedImage`."""
    content = _read(path)
    found = jpeg_size(content)
    if not content.rstrip(b"\0").endswith(JPEG_END):
        raise DamagedImage("is cut off")
    _check_size(found, size)
    return content


def read_depth(path: Path, size: tuple[int, int]) -> np.ndarray:
    """Decode a 16-bit PNG of one channel and of ``size``: (H, W) uint16, millimetres.

    Raises :class:`DamagedImage` for anything else.
    """
    content = _read(path)
    _check_depth_head(content, size)
    if not content.rstrip(b"\0").endswith(PNG_END):
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


def _read(path: Path, length: int = -1) -> bytes:
    try:
        with open(path, "rb") as file:
            return file.read(length)
    except OSError as error:
        raise DamagedImage(f"cannot be read ({error.strerror})") from None


def common_size(paths: Iterable[Path]) -> tuple[int, int] | None:
    """Return width and height of the first JPEG that states them; None where none does."""
    for path in paths:
        try:
            return jpeg_size(_read(path))
        except DamagedImage:
            continue
    return None


class AlignedRecording(CameraRecording):
    """One camera's image files, with depth on the colour image's grid.

    ``shots`` are in order of time. A camera none of whose depth files is a 16-bit PNG of the
    colour image's size is one without depth, with a note. Raises UserError, naming ``source``,
    where no colour file is as large as the lens says.
    """

    def __init__(
        self,
        source: Path,
        name: str,
        lens: Intrinsics,
        pose: np.ndarray,
        *,
        shots: list[Shot],
        fps: float,
    ) -> None:
        self._shots, self._size = shots, (lens.width, lens.height)
        fault = self._fault_of_depth()
        depth = None if fault else lens
        camera = Camera(name, lens, depth, None if fault else np.eye(4), pose)
        super().__init__(source, camera, fps=fps)
        if fault:
            self.notes.append(fault)
        if not any(shot.colour for shot in shots):
            raise UserError(f"{source}: holds no colour image; copy this camera's images again")

    def _fault_of_depth(self) -> str:
        """Why the camera has no depth; empty where some file's head is as it must be."""
        fault = ""
        for path in (shot.depth for shot in self._shots if shot.depth is not None):
            try:
                _check_depth_head(_read(path, 32), self._size)
                return ""
            except DamagedImage as error:
                fault = fault or f"no depth used: {path.name} {error}"
        return fault or "no depth images"

    def images(self) -> Iterator[Image]:
        """Colour files as they are, depth decoded; damaged ones are left out and counted."""
        damaged: list[str] = []
        without_depth = 0
        for time_us, colour, depth in self._shots:
            if colour is not None:
                try:
                    yield Image("colour", time_us, read_jpeg(colour, self._size))
                except DamagedImage as error:
                    damaged.append(f"{colour.name} {error}")
            if self.camera.depth is None:
                continue
            without_depth += depth is None
            if depth is not None:
                try:
                    yield Image("depth", time_us, read_depth(depth, self._size))
                except DamagedImage as error:
                    damaged.append(f"{depth.name} {error}")
        if without_depth:
            self.notes.append(f"no depth image beside {without_depth} of its colour images")
        if damaged:
            self.notes.append(f"{len(damaged)} damaged images left out (first: {damaged[0]})")
