"""Layout ``behave``: the folders of the BEHAVE data set.

``recordings`` is the folder of a sequence, with a folder ``t<seconds>`` for each frame. The latter
holds ``k<n>.color.jpg`` and ``k<n>.depth.png`` of Kinects 0 to 3; depth has 16 bits, in millimetres
on the colour image's grid. ``calibration`` is ``calibs/<date>/config``: ``<n>/config.json`` has the
pose of each colour camera. Lenses are in ``calibs/intrinsics/<n>/calibration.json``. Cameras are
named k0, k1, ... and k1 is the master, to whose colour camera poses are related.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.calibration.extrinsics import (
    Extrinsics,
    check_distance,
    relate_to_master,
)
from intercap_core.formats.calibration.lens_checks import check_lens, pad_distortion
from intercap_core.formats.recordings.image_files import AlignedRecording, ImagePair, find_size
from intercap_core.formats.recordings.numbering import FRAME_FOLDER
from intercap_core.formats.recordings.source import RecordingLayout
from intercap_core.formats.recordings.timestamps import frame_rate
from intercap_core.geometry.camera.intrinsics import DEFAULT_METRIC_RADIUS, Intrinsics
from intercap_core.geometry.camera.transforms import is_rigid, rigid
from intercap_core.inputs.documents import read_json, read_object
from intercap_core.inputs.files import UnreadableFile

MASTER = "k1"
IMAGE_FILE = re.compile(r"k(\d{1,2})\.(color\.(?:jpe?g|png)|depth\.png)", re.IGNORECASE)
KINECT_FOLDER = re.compile(r"k?(\d{1,2})")


class BehaveLayout(RecordingLayout):
    """One sequence of the data set."""

    def __init__(self, sequence: SequenceEntry) -> None:
        super().__init__(sequence)
        self.extrinsics = read_poses(sequence.calibration)
        self._frames = frame_folders(sequence.recordings)
        if not self._frames:
            raise UserError(
                f"{sequence.recordings}: sequence {sequence.sequence!r} has no frame folders "
                "t<seconds>, such as t0003.000; correct 'recordings' in the table of sequences"
            )
        self._images = {time_us: _images(path) for time_us, path in self._frames.items()}
        self.names = _cameras_of(self._images.values())

    def open(self, name: str) -> AlignedRecording:
        """Find the camera's files; raises UserError without colour images or a matching lens."""
        shots = [
            ImagePair(time_us, images.get((name, "color")), images.get((name, "depth")))
            for time_us, images in self._images.items()
            if (name, "color") in images or (name, "depth") in images
        ]
        recordings = self.sequence.recordings
        size = find_size(shot.colour for shot in shots if shot.colour is not None)
        if size is None:
            raise UserError(
                f"{recordings}: no {name}.color.jpg can be read; copy the sequence again"
            )
        lens = read_lens(self.sequence.calibration, int(name[1:]))
        if (lens.width, lens.height) != size:
            raise UserError(
                f"intrinsics of {name} are for {lens.width}x{lens.height}, its colour images have "
                f"{size[0]}x{size[1]}; give the calibration of this resolution"
            )
        check_lens(lens, f"intrinsics of {name}")
        pose = self.extrinsics.master_from_colour[name]
        fps = nominal_rate(list(self._frames))
        return AlignedRecording(recordings, name, lens, pose, shots=shots, fps=fps)


def frame_folders(recordings: Path) -> dict[int, Path]:
    """Folders of frames by time, microseconds, in order of time.

    Raises UserError if two have the same time.
    """
    folders: dict[int, Path] = {}
    for path in sorted(recordings.iterdir()):
        match = FRAME_FOLDER.fullmatch(path.name)
        if not match or not path.is_dir():
            continue
        time_us = round(float(match.group(1)) * 1e6)
        if time_us in folders:
            raise UserError(
                f"{recordings}: {folders[time_us].name} and {path.name} have one time; keep one"
            )
        folders[time_us] = path
    return dict(sorted(folders.items()))


def find_cameras(recordings: Path) -> list[str]:
    """Names of the cameras that have an image in ``recordings``; raises as frame_folders does."""
    return _cameras_of(_images(path) for path in frame_folders(recordings).values())


def _cameras_of(frames: Iterable[dict[tuple[str, str], Path]]) -> list[str]:
    return sorted({name for images in frames for name, _ in images}, key=lambda name: int(name[1:]))


def nominal_rate(times_us: list[int]) -> float:
    """Nominal frame rate of increasing times; 1 for a single time."""
    fps = frame_rate(np.array(times_us)) or 1.0
    # Rates of Azure Kinects. Folder names round times to milliseconds, 3 % of a period at 30 Hz.
    return next((n for n in (30.0, 15.0, 5.0) if abs(fps / n - 1) < 0.05), fps)


def _images(folder: Path) -> dict[tuple[str, str], Path]:
    """A frame's images by camera and kind, "color" or "depth"."""
    images = {}
    for path in sorted(folder.iterdir()):
        match = IMAGE_FILE.fullmatch(path.name)
        if match:
            images[f"k{int(match.group(1))}", match.group(2).partition(".")[0].lower()] = path
    return images


def read_poses(folder: Path) -> Extrinsics:
    """Read ``<n>/config.json`` of every Kinect: poses relative to Kinect 1's colour camera.

    ``rotation`` (9 numbers, row by row) and ``translation`` (metres) map a colour camera's points
    to the world, x_world = R x + t. Raises UserError naming the file if one is broken, and if there
    is none of Kinect 1.
    """
    world_from_colour = {}
    for number, path in _kinect_folders(folder).items():
        file = path / "config.json"
        if not file.is_file():
            continue
        content = read_object(file)
        try:
            rotation = np.array(content["rotation"], np.float64).reshape(3, 3)
            translation = np.array(content["translation"], np.float64).reshape(3)
            pose = rigid(rotation, translation)
        except (KeyError, TypeError, ValueError, OverflowError):
            pose = np.zeros(0)
        if not is_rigid(pose, tolerance=1e-3):
            raise UserError(
                f"{file}: expected a rotation matrix 'rotation' of 9 numbers and a 'translation' "
                "of 3, metres; get the file from the data set again"
            )
        check_distance(file, "the camera", pose[:3, 3])
        world_from_colour[f"k{number}"] = pose
    if MASTER not in world_from_colour:
        raise UserError(
            f"{folder}: holds no 1/config.json (the pose of the master, Kinect 1); give the folder "
            "calibs/<date>/config of the data set"
        )
    return Extrinsics(
        MASTER, relate_to_master(folder, MASTER, world_from_colour).master_from_colour
    )


def find_intrinsics_folder(calibration: Path) -> Path | None:
    """The folder ``intrinsics`` in ``calibration`` (``calibs/<date>/config``) or up to two folders
    above it; None if there is none."""
    above = calibration.resolve()
    places = [above / "intrinsics", above.parent / "intrinsics", above.parents[1] / "intrinsics"]
    return next((place for place in places if place.is_dir()), None)


def read_lens(calibration: Path, number: int) -> Intrinsics:
    """Read the colour lens of one Kinect from the folder of :func:`find_intrinsics_folder`.

    The file's ``color`` states ``width``, ``height``, ``fx``, ``fy``, ``cx``, ``cy`` and
    ``opencv``: those four again, then OpenCV's distortion. Raises UserError naming the file.
    """
    place = find_intrinsics_folder(calibration)
    folders = _kinect_folders(place) if place is not None else {}
    path = folders[number] / "calibration.json" if number in folders else None
    if path is None or not path.is_file():
        raise UserError(
            f"no intrinsics/{number}/calibration.json above {calibration.name}; put the data set's "
            "folder 'intrinsics' next to those of the dates"
        )
    where = f"intrinsics/{path.parent.name}/{path.name}"
    try:
        colour = read_json(path)["color"]
        fx, fy, cx, cy = (float(colour[key]) for key in ("fx", "fy", "cx", "cy"))
        distortion = pad_distortion(np.array(colour["opencv"][4:], np.float64))
        radius = float(colour.get("metric_radius", 0)) or DEFAULT_METRIC_RADIUS
        size = int(colour["width"]), int(colour["height"])
        radius = radius if np.isfinite(radius) else DEFAULT_METRIC_RADIUS
        return Intrinsics(*size, fx, fy, cx, cy, distortion, radius)
    except (UnreadableFile, KeyError, TypeError, ValueError, OverflowError):
        raise UserError(
            f"{where}: expected 'color' with width, height, fx, fy, cx, cy and 'opencv' (these "
            "four and 4, 5 or 8 coefficients); get the file from the data set again"
        ) from None


def _kinect_folders(folder: Path) -> dict[int, Path]:
    """The folders of single Kinects by number; raises UserError without ``folder``."""
    if not folder.is_dir():
        raise UserError(
            f"{folder}: there is no such folder of camera poses; correct 'calibration' in the "
            "table of sequences"
        )
    folders = {}
    for path in sorted(folder.iterdir()):
        match = KINECT_FOLDER.fullmatch(path.name)
        if match and path.is_dir():
            folders[int(match.group(1))] = path
    return dict(sorted(folders.items()))
