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
from intercap_core.formats.recordings.containers import RecordingPreview
from intercap_core.formats.recordings.encoded import PNG_END, PNG_START, encoded_size
from intercap_core.formats.recordings.source import CameraRecording, Image
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera
from intercap_core.inputs.files import MAX_IMAGE_BYTES, Unreadable, read_bytes

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
