"""Layout ``plain``: a folder of images or a video for each camera, and a calibration file.

``recordings`` holds ``<camera>/`` with JPEG, PNG, BMP or TIFF files (or ``<camera>/colour/``), or a
video ``<camera>.mp4``. ``<camera>/depth/`` holds the depth, if any: 16-bit PNG or TIFF files,
millimetres unless the calibration states ``depth_unit``. Suffixes and folders may be in capitals.
``calibration`` is any form of :mod:`intercap_core.formats.calibration.files`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.calibration.extrinsics import CAMERA_NAME
from intercap_core.formats.calibration.files import RecordedCameras, read_calibration
from intercap_core.formats.calibration.opencv import CalibratedCamera
from intercap_core.formats.recordings.image_files import Decoding, FilesRecording, find_size
from intercap_core.formats.recordings.source import CameraRecording, RecordingLayout
from intercap_core.formats.recordings.timestamps import (
    find_timestamps,
    frame_rate,
    pair_images,
    read_timestamps,
)
from intercap_core.geometry.camera.rig import Camera

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff")
DEPTH_SUFFIXES = (".png", ".tif", ".tiff")
VIDEO_SUFFIXES = (".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".ts", ".mts")
COLOUR_FOLDERS = ("colour", "color", "rgb")
DEPTH_FOLDER = "depth"


class PlainLayout(RecordingLayout):
    """Folders and videos named after the cameras."""

    def __init__(self, sequence: SequenceEntry) -> None:
        super().__init__(sequence)
        self._folders, self._videos = _find_recordings(sequence.recordings)
        self.names = find_cameras(sequence.recordings)
        calibration = read_calibration(
            sequence.calibration,
            RecordedCameras(self.names, self._size_of),
            scale=sequence.calibration_scale,
        )
        self._known, self.extrinsics = calibration.cameras, calibration.extrinsics

    def _size_of(self, name: str) -> tuple[int, int] | None:
        """Width and height of the camera's first image; None if none can be read."""
        folder = self._folders.get(name)
        if folder and folder.colour:
            return find_size(folder.colour[:1])
        from intercap_core.formats.recordings.video import read_video_size

        return next((read_video_size(path) for path in self._videos if path.stem == name), None)

    def open(self, name: str) -> CameraRecording:
        """Open the camera's video or folder.

        Raises UserError if it has neither or several, and if the times of images are unknown.
        """
        known, folder = self._known[name], self._folders.get(name)
        colour, depth = (folder.colour, folder.depth) if folder else ([], [])
        videos = [path for path in self._videos if path.stem == name]
        recorded = [path.name for path in videos] + [f"{name}/"] * bool(colour)
        if len(recorded) != 1:
            description = f"as {' and '.join(recorded)}" if recorded else "depth alone"
            raise UserError(
                f"{self.sequence.recordings}: camera {name} is recorded {description}, expected "
                f"one video or one folder of {', '.join(IMAGE_SUFFIXES)}; keep or add one"
            )
        with_depth = bool(depth) and known.depth is not None
        camera = Camera(
            name,
            known.colour,
            known.depth if with_depth else None,
            known.colour_from_depth if with_depth else None,
            self.extrinsics.master_from_colour[name],
        )
        source = videos[0] if videos else self.sequence.recordings / name
        stem = source.with_name(f"{name}_timestamps") if videos else source / "timestamps"
        file = find_timestamps(stem)
        times = read_timestamps(file) if file else None
        decoding = Decoding("ignore" if known.as_stored else "turn", known.depth_unit_m)
        recording: CameraRecording
        if videos:
            from intercap_core.formats.recordings.video import VideoRecording

            recording = VideoRecording(
                source,
                camera,
                depth if with_depth else [],
                fps=known.fps,
                offset_s=known.time_offset,
                times=times,
                decoding=decoding,
            )
        else:
            paired = pair_images(
                colour,
                depth if with_depth else [],
                fps=known.fps,
                offset_s=known.time_offset,
                times=times,
                source=source,
            )
            stated = np.array([shot.time_us for shot in paired.pairs if shot.colour])
            recording = FilesRecording(
                source, camera, paired.pairs, known.fps or frame_rate(stated) or 1.0, decoding
            )
            recording.timing, recording.notes = paired.timing, paired.notes
        recording.notes += folder.notes(known) if folder else []
        if known.depth is not None and not depth:
            recording.notes.append(
                "the calibration states its depth, but it has no depth files; expected "
                f"{name}/depth/ with 16-bit {', '.join(DEPTH_SUFFIXES)}"
            )
        return recording


def find_cameras(recordings: Path) -> list[str]:
    """Names of the cameras that have a folder of images or a video in ``recordings``."""
    folders, videos = _find_recordings(recordings)
    recorded = sorted({*folders, *(path.stem for path in videos)})
    return [name for name in recorded if CAMERA_NAME.fullmatch(name)]


def find_images(recordings: Path) -> dict[str, list[Path]]:
    """Colour files by camera, of the cameras that have a folder of images."""
    folders, _ = _find_recordings(recordings)
    return {name: folder.colour for name, folder in folders.items() if folder.colour}


def _find_recordings(recordings: Path) -> tuple[dict[str, _CameraFolder], list[Path]]:
    """Folders with images by name, and videos."""
    below = sorted(path for path in recordings.iterdir() if not path.name.startswith("."))
    folders = [_CameraFolder.of(path) for path in below if path.is_dir()]
    videos = [path for path in below if path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()]
    return {f.path.name: f for f in folders if f.colour or f.depth}, videos


def _images(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    visible = (path for path in folder.iterdir() if not path.name.startswith("."))
    return sorted(path for path in visible if path.suffix.lower() in suffixes)


@dataclass(frozen=True)
class _CameraFolder:
    """The image files of a camera's folder."""

    path: Path
    colour: list[Path]
    depth: list[Path]
    unused: list[Path]
    """Further folders with colour or depth images, which are not read."""

    @classmethod
    def of(cls, path: Path) -> _CameraFolder:
        """Find the folders of colour and depth by their names in any case."""
        named = (e for e in path.iterdir() if e.name.lower() in (*COLOUR_FOLDERS, DEPTH_FOLDER))
        below = sorted(entry for entry in named if entry.is_dir())  # calls nothing for images
        colour_folders = [
            *(entry for name in COLOUR_FOLDERS for entry in below if entry.name.lower() == name),
            path,
        ]
        depth_folders = [entry for entry in below if entry.name.lower() == DEPTH_FOLDER]
        colour = {
            entry: files for entry in colour_folders if (files := _images(entry, IMAGE_SUFFIXES))
        }
        depth = {
            entry: files for entry in depth_folders if (files := _images(entry, DEPTH_SUFFIXES))
        }
        colour_files, depth_files = (next(iter(found.values()), []) for found in (colour, depth))
        return cls(path, colour_files, depth_files, [*list(colour)[1:], *list(depth)[1:]])

    def notes(self, known: CalibratedCamera) -> list[str]:
        """Notes on files that are not read."""
        notes = [
            f"the images in {self.path.name if entry == self.path else entry.name}/ are not read, "
            "because another folder has its images; keep one of them"
            for entry in self.unused
        ]
        if self.depth and known.depth is None:
            notes.append(
                "its depth images are not read: the calibration has no entry 'depth' (aligned, or "
                "a lens)"
            )
        return notes
