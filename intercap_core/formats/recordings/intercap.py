"""Layout ``intercap``: the folders of the InterCap release.

``recordings`` is ``RGBD_Images/<subject>/<object>/Seg_<k>``. It holds ``Frames_Cam<n>`` with
``color/%05d.jpg`` and a folder of depth: 16-bit PNG, millimetres, on the colour image's grid.
``calibration`` is a folder of ``Color.json``, ``Color_2.json``, ... Cameras are named k1, k2, ...
The release states no times: the number in a file's name is its place at 30 images a second.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.calibration.extrinsics import read_extrinsics
from intercap_core.formats.calibration.lens_checks import (
    check_lens,
    check_resolution,
    pad_distortion,
)
from intercap_core.formats.recordings.image_files import AlignedRecording, ImagePair, find_size
from intercap_core.formats.recordings.source import RecordingLayout
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.inputs.documents import read_json
from intercap_core.inputs.files import UnreadableFile

FPS = 30.0  # of the release, whose Azure Kinects record at their highest rate
CAMERA_FOLDER = re.compile(r"frames_cam(\d{1,2})", re.IGNORECASE)
COLOUR_FOLDER = re.compile(r"colou?r", re.IGNORECASE)
DEPTH_FOLDER = re.compile(r"depth.*", re.IGNORECASE)
NUMBERED = re.compile(r"(?!\.)\D*(\d{1,9})\.(?:jpe?g|png)", re.IGNORECASE)


def time_from_number(number: int) -> int:
    """Device time, microseconds, of the image with this number in its name."""
    return round(number * 1e6 / FPS)


def numbers_from_times(times_us: np.ndarray) -> np.ndarray:
    """Numbers in the names of the images with these device times, microseconds."""
    return np.rint(np.asarray(times_us) * (FPS / 1e6)).astype(np.int64)


class InterCapLayout(RecordingLayout):
    """One sequence of the release."""

    def __init__(self, sequence: SequenceEntry) -> None:
        super().__init__(sequence)
        if not sequence.calibration.is_dir():
            raise UserError(
                f"{sequence.calibration}: layout 'intercap' of sequence {sequence.sequence!r} "
                "needs a folder of Color.json, Color_2.json, ..., which hold the lenses; correct "
                "'calibration' in the table of sequences"
            )
        self.extrinsics = read_extrinsics(sequence.calibration)
        self._folders = find_camera_folders(sequence.recordings)
        self.names = list(self._folders)

    def open(self, name: str) -> AlignedRecording:
        """Find the camera's files; raises UserError without colour images or a matching lens."""
        folder = self._folders[name]
        colour, depth = find_images(folder)
        size = find_size(colour.values())
        if size is None:
            raise UserError(
                f"{folder}: holds no readable color/<number>.jpg; copy the folder from the release "
                "again"
            )
        number = int(name[1:])
        lens_file = "Color.json" if number == 1 else f"Color_{number}.json"
        lens = read_lens(self.sequence.calibration / lens_file, size)
        shots = [
            ImagePair(time_from_number(at), colour.get(at), depth.get(at))
            for at in sorted({*colour, *depth})
        ]
        pose = self.extrinsics.master_from_colour[name]
        fps = frame_rate(sorted(colour))
        recording = AlignedRecording(folder, name, lens, pose, shots=shots, fps=fps)
        recording.notes += [
            f"the images in {unread.name}/ are not read, because another folder has its depth; "
            "keep one of them"
            for unread in _depth_folders(folder)[1:]
        ]
        return recording


def frame_rate(numbers: list[int]) -> float:
    """Images a second of increasing numbers; less than 30 if only every n-th image was kept."""
    steps = np.diff(numbers)
    return FPS / max(1.0, float(np.median(steps))) if len(steps) else FPS


def find_camera_folders(recordings: Path) -> dict[str, Path]:
    """The folders ``Frames_Cam<n>`` by camera name, in the cameras' order."""
    folders: dict[int, Path] = {}
    for path in sorted(recordings.iterdir()):
        match = CAMERA_FOLDER.fullmatch(path.name)
        if match and path.is_dir():
            folders.setdefault(int(match.group(1)), path)
    return {f"k{number}": folders[number] for number in sorted(folders)}


def find_images(folder: Path) -> tuple[dict[int, Path], dict[int, Path]]:
    """Colour and depth files of a camera's folder by the number in their names.

    Of several folders of depth, the first whose name contains "align" is used, else the first by
    name. Raises UserError if two files have the same number.
    """
    below = sorted(path for path in folder.iterdir() if path.is_dir())
    colour = next((path for path in below if COLOUR_FOLDER.fullmatch(path.name)), None)
    depths = _depth_folders(folder)
    return _numbered(colour, (".jpg", ".jpeg", ".png")), _numbered(
        depths[0] if depths else None, (".png",)
    )


def _depth_folders(folder: Path) -> list[Path]:
    """Folders of depth that hold images, the one that is used first."""
    below = sorted(path for path in folder.iterdir() if path.is_dir())
    found = [path for path in below if DEPTH_FOLDER.fullmatch(path.name) and any(path.iterdir())]
    return sorted(found, key=lambda path: "align" not in path.name.lower())


def _numbered(folder: Path | None, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """Image files of a folder by the number in their names; {} without the folder."""
    images: dict[int, Path] = {}
    for path in sorted(folder.iterdir()) if folder is not None else ():
        match = NUMBERED.fullmatch(path.name)
        if not match or path.suffix.lower() not in suffixes:
            continue
        number = int(match.group(1))
        if number in images:
            raise UserError(
                f"{folder}: image {number} is there twice, as {images[number].name} and "
                f"{path.name}; keep one"
            )
        images[number] = path
    return images


def read_lens(path: Path, size: tuple[int, int]) -> Intrinsics:
    """Read a lens from a ``Color*.json`` for images of ``size``, which the file does not state.

    ``f`` and ``c`` are focal length and principal point (x, y) in pixels. ``k`` has 4, 5 or 8
    coefficients in OpenCV's order (k1, k2, p1, p2, k3, ...). Raises UserError for a broken file,
    and for a principal point that belongs to images of another size.
    """
    where = f"{path.parent.name}/{path.name}"
    try:
        content: Any = read_json(path)
        focal, centre = (np.array(content[key], np.float64).reshape(2) for key in "fc")
        distortion = pad_distortion(np.array(content["k"], np.float64).ravel())
        fx, fy, cx, cy = (float(value) for value in (*focal, *centre))
        lens = Intrinsics(*size, fx, fy, cx, cy, distortion)
    except (UnreadableFile, KeyError, TypeError, ValueError, OverflowError) as error:
        reason = f" ({error})" if type(error) is ValueError else ""
        raise UserError(
            f"{where}: expected 'f' and 'c' of two numbers and 'k' of 4, 5 or 8{reason}; get the "
            "file from the release again"
        ) from None
    check_resolution(centre, size, 0.15, where)
    return check_lens(lens, where)
