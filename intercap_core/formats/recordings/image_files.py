"""Image files: colour and depth of one file, and recordings that consist of many files."""

from __future__ import annotations

import contextlib
import struct
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.recordings.encodings import (
    PNG_START,
    TIFF_STARTS,
    DamagedImage,
    OrientationUse,
    decode,
    encoded_size,
    holds_all_pixels,
    stated_orientation,
    store_colour,
    to_millimetres,
)
from intercap_core.formats.recordings.source import CameraRecording, Image, RecordingPreview
from intercap_core.formats.recordings.synchronise import distance_to
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.solve.time_series import sample_evenly
from intercap_core.inputs.files import UnreadableFile, read_bytes


class Decoding(NamedTuple):
    """How a camera's image files are read."""

    orientation: OrientationUse = "turn"
    """Treatment of colour images that state an orientation."""
    depth_unit_m: float = 0.001
    """Metres for one unit of the depth files."""


DEFAULT = Decoding()


class ImagePair(NamedTuple):
    """Colour and depth file of one camera at one time; None = no file."""

    time_us: int
    """Device time, microseconds."""
    colour: Path | None
    depth: Path | None


def read_colour(path: Path, orientation: OrientationUse = "turn") -> tuple[bytes, str]:
    """Read a colour file as :func:`.encodings.store_colour` stores it, with its remark."""
    return store_colour(read_content(path), orientation)


def read_depth(path: Path, size: tuple[int, int], unit_m: float = 0.001) -> np.ndarray:
    """Decode a 16-bit PNG or TIFF of one channel to (H, W) uint16, millimetres, 0 = invalid.

    The largest number, 65535, is invalid too: sensors write it where they measure nothing.
    Raises :class:`DamagedImage` for anything else, for another ``size`` (width, height), and for
    files that state an orientation: OpenCV would turn TIFF and not PNG files, and never the lens.

    Args:
        path: the file.
        size: width and height of the depth lens.
        unit_m: metres for one unit of the file. Distances above 65.535 m become 0 (invalid).
    """
    content = read_content(path)
    if content.startswith(PNG_START):
        _check_depth_head(content, size)
        if encoded_size(content) is None:
            raise DamagedImage("is cut off")
    elif not content.startswith(TIFF_STARTS):
        raise DamagedImage("is no PNG or TIFF")
    orientation = stated_orientation(content)
    if orientation != 1:
        raise DamagedImage(
            f"states orientation {orientation}, the depth lens none; turn the depth images, or "
            "remove the entry (exiftool -Orientation= FILES)"
        )
    image = decode(content, cv2.IMREAD_UNCHANGED)
    if image.dtype != np.uint16 or image.ndim != 2:
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise DamagedImage(
            f"has {channels} channels of {image.dtype}, expected one of uint16 (depth_unit in the "
            "calibration states its unit)"
        )
    _check_depth_size(image.shape[::-1], size)
    return to_millimetres(image, unit_m)


def _check_depth_head(content: bytes, size: tuple[int, int]) -> None:
    if not content.startswith(PNG_START) or len(content) < 26:
        raise DamagedImage("is no PNG")
    width, height, bits, colour_type = struct.unpack_from(">IIBB", content, 16)
    if bits != 16 or colour_type != 0:
        raise DamagedImage(f"is no 16-bit grey PNG ({bits} bits, colour type {colour_type})")
    _check_depth_size((width, height), size)


def _check_depth_size(actual: tuple[int, ...], size: tuple[int, int]) -> None:
    if actual != size:
        raise DamagedImage(f"has {actual[0]}x{actual[1]} pixels, expected {size[0]}x{size[1]}")


def read_content(path: Path, length: int | None = None) -> bytes:
    """Bytes of an image file, or its first ``length``; raises :class:`DamagedImage`."""
    try:
        return read_bytes(path, head=length)
    except UnreadableFile as error:
        raise DamagedImage(error.reason) from None


def find_size(
    paths: Iterable[Path], orientation: OrientationUse = "turn"
) -> tuple[int, int] | None:
    """Width and height, as stored, of the first complete image; None if there is none."""
    for path in paths:
        with contextlib.suppress(DamagedImage):
            return encoded_size(read_colour(path, orientation)[0])
    return None


class FilesRecording(CameraRecording):
    """One camera's image files: colour files are copied, depth is decoded.

    Depth images have the size of the camera's depth lens. Without a depth lens they are not read.
    ``shots``: files in order of time; ``fps``: nominal images a second. With depth, colour images
    that state a half turn or a mirror are refused. :class:`.video.VideoRecording` adds a video.
    """

    def __init__(
        self,
        source: Path,
        camera: Camera,
        shots: list[ImagePair],
        fps: float,
        decoding: Decoding = DEFAULT,
    ) -> None:
        super().__init__(source, camera, fps=fps)
        self._shots = shots
        if camera.depth is not None and decoding.orientation == "turn":
            decoding = decoding._replace(orientation="refuse")
        self._decoding = decoding

    @property
    def colour_files(self) -> list[tuple[int, Path]]:
        """Device time, microseconds, and path of all colour files, including damaged ones."""
        return [(shot.time_us, shot.colour) for shot in self._shots if shot.colour is not None]

    @property
    def _depth_files(self) -> list[tuple[int, Path]]:
        """The same of depth files; [] without a depth lens."""
        if self.camera.depth is None:
            return []
        return [(shot.time_us, shot.depth) for shot in self._shots if shot.depth is not None]

    def preview(self) -> RecordingPreview:
        """Inspect the sizes of all files, and some of the images."""
        files = self.colour_files
        size = find_size((path for _, path in files), self._decoding.orientation)
        times = [time_us for time_us, _ in files]
        seconds = (times[-1] - times[0]) * 1e-6 if times else None
        faults, remarks = self._inspect_files()
        remarks += self._list_unpaired()
        return RecordingPreview(size, len(files), seconds, 1.0, tuple(faults), tuple(remarks))

    def images(self) -> Iterator[Image]:
        """Yield images in the order of the shots; damaged ones and changes are noted."""
        damaged: list[str] = []
        remarks: Counter[str] = Counter()
        kinds: tuple[Literal["colour", "depth"], ...] = ("colour", "depth")
        for time_us, *files in self._shots:
            for kind, path in zip(kinds, files, strict=True):
                if path is None or (kind == "depth" and self.camera.depth is None):
                    continue
                try:
                    content, remark = self._read(kind, path)
                except DamagedImage as error:
                    damaged.append(f"{path.name} {error}")
                    continue
                remarks[remark] += 1
                yield Image(kind, time_us, content)
        self.notes += list_remarks(remarks) + self._list_unpaired()
        if damaged:
            self.notes.append(f"{len(damaged)} damaged images left out (first: {damaged[0]})")

    def _read(self, kind: str, path: Path) -> tuple[bytes | np.ndarray, str]:
        """Image of a file, and a remark on what was changed; raises :class:`DamagedImage`."""
        lens = self.camera.depth
        if kind == "colour" or lens is None:
            return read_colour(path, self._decoding.orientation)
        return read_depth(path, (lens.width, lens.height), self._decoding.depth_unit_m), ""

    def _inspect_files(self) -> tuple[list[str], list[str]]:
        """Inspect the sizes of all files and the content of a few.

        Returns:
            Faults (empty files, and damaged ones among five inspected), and remarks on the others.
        """
        faults = []
        remarks: Counter[str] = Counter()
        for kind, files in (("colour", self.colour_files), ("depth", self._depth_files)):
            paths = [path for _, path in files]
            empty = [path for path in paths if path.stat().st_size == 0]
            if empty:
                faults.append(
                    f"{len(empty)} of {len(paths)} {kind} files are empty (first: {empty[0].name})"
                )
            bad = []
            chosen = sample_evenly(np.ones(len(paths), bool), 5).tolist()
            for path in (paths[index] for index in chosen):
                try:
                    content, remark = self._read(kind, path)
                    remarks[remark] += kind == "colour"
                    if isinstance(content, bytes) and not holds_all_pixels(content):
                        raise DamagedImage("lacks a part of its pixels")
                except DamagedImage as error:
                    if path not in empty:
                        bad.append(f"{path.name} {error}")
            if bad:
                part = f"{len(bad)} of {len(chosen)} inspected {kind} files"
                faults.append(f"{part} are damaged (first: {bad[0]})")
        inspected = sum(remarks.values())
        return faults, [
            f"{count} of {inspected} inspected colour images {remark}"
            for remark, count in remarks.items()
            if remark
        ]

    def _list_unpaired(self) -> list[str]:
        """Notes on colour images without depth, and the reverse, within half a period."""
        colour, depth = self.colour_files, self._depth_files
        if self.camera.depth is None or not colour:  # no depth, or a video
            return []
        notes = []
        for kind, images, other, partners in (
            ("colour", colour, "depth", depth),
            ("depth", depth, "colour", colour),
        ):
            taken = np.sort([time_us for time_us, _ in partners])
            distance = distance_to(np.array([time_us for time_us, _ in images]), taken)
            without = [images[i][1].name for i in np.flatnonzero(distance > 0.5e6 / self.fps)]
            if without:
                notes.append(
                    f"no {other} image with {len(without)} of its {kind} images "
                    f"(first: {without[0]})"
                )
        return notes


def list_remarks(remarks: Counter[str]) -> list[str]:
    """Notes on colour images by the remarks of :func:`.encodings.store_colour` and their counts."""
    return [f"{count} colour images {remark}" for remark, count in remarks.items() if remark]


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
        chosen = sample_evenly(np.ones(len(paths), bool), count)
        images = []
        for index in chosen.tolist():
            with contextlib.suppress(DamagedImage):
                images.append(read_depth(paths[index], self._size))
        if not images:
            raise UserError(f"{self.source}: none of its depth images can be read")
        return images
