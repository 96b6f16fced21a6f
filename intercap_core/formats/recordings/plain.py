"""Layout ``plain``: a folder of images or a video for each camera, and a calibration file.

``recordings`` holds ``<camera>/`` with JPEG or PNG files (or ``<camera>/colour/``), or a video
``<camera>.mp4``. ``<camera>/depth/`` holds the depth, if any: 16-bit PNG files, millimetres.
``calibration`` is any form of :mod:`intercap_core.formats.calibration.files`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.calibration.extrinsics import CAMERA_NAME
from intercap_core.formats.calibration.files import RecordedCameras, read_calibration
from intercap_core.formats.recordings.image_files import FilesRecording, find_size
from intercap_core.formats.recordings.source import CameraRecording, RecordingLayout
from intercap_core.formats.recordings.timestamps import (
    find_timestamps,
    frame_rate,
    pair_images,
    read_timestamps,
)
from intercap_core.geometry.camera.rig import Camera

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
VIDEO_SUFFIXES = (".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".ts", ".mts")
COLOUR_FOLDERS = ("colour", "color", "rgb")


class PlainLayout(RecordingLayout):
    """Folders and videos named after the cameras."""

    def __init__(self, sequence: SequenceEntry) -> None:
        super().__init__(sequence)
        below = sorted(sequence.recordings.iterdir())
        self._folders = {p.name: p for p in below if p.is_dir() and (_colour(p) or _depth(p))}
        self._videos = [p for p in below if p.suffix.lower() in VIDEO_SUFFIXES and p.is_file()]
        recorded = sorted({*self._folders, *(path.stem for path in self._videos)})
        self.names = [name for name in recorded if CAMERA_NAME.fullmatch(name)]
        calibration = read_calibration(
            sequence.calibration,
            RecordedCameras(self.names, self._size_of),
            scale=sequence.calibration_scale,
        )
        self._known, self.extrinsics = calibration.cameras, calibration.extrinsics

    def _size_of(self, name: str) -> tuple[int, int] | None:
        """Width and height of the camera's first image; None if none can be read."""
        folder = self._folders.get(name)
        files = _colour(folder) if folder else []
        if files:
            return find_size(files[:1])
        from intercap_core.formats.recordings.video import read_video_size

        return next((read_video_size(path) for path in self._videos if path.stem == name), None)

    def open(self, name: str) -> CameraRecording:
        """Open the camera's video or folder.

        Raises UserError if it has neither or several, and if the times of images are unknown.
        """
        known, folder = self._known[name], self._folders.get(name)
        colour, depth = (_colour(folder), _depth(folder)) if folder else ([], [])
        videos = [path for path in self._videos if path.stem == name]
        recorded = [path.name for path in videos] + [f"{name}/"] * bool(colour)
        if len(recorded) != 1:
            description = f"as {' and '.join(recorded)}" if recorded else "depth alone"
            raise UserError(
                f"{self.sequence.recordings}: camera {name} is recorded {description}, expected "
                "one video or one folder of .jpg or .png; keep or add one"
            )
        with_depth = bool(depth) and known.depth is not None
        camera = Camera(
            name,
            known.colour,
            known.depth if with_depth else None,
            known.colour_from_depth if with_depth else None,
            self.extrinsics.master_from_colour[name],
        )
        source = videos[0] if videos else folder
        assert source is not None
        stem = source.with_name(f"{name}_timestamps") if videos else source / "timestamps"
        file = find_timestamps(stem)
        times = read_timestamps(file) if file else None
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
            )
        else:
            shots = pair_images(
                colour,
                depth if with_depth else [],
                fps=known.fps,
                offset_s=known.time_offset,
                times=times,
                source=source,
            )
            stated = np.array([shot.time_us for shot in shots if shot.colour])
            recording = FilesRecording(
                source, camera, shots, known.fps or frame_rate(stated) or 1.0
            )
        if depth and not with_depth:
            recording.notes.append(
                "its depth images are not read: the calibration has no entry 'depth' (aligned, or "
                "a lens)"
            )
        return recording


def _images(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    if not folder.is_dir():
        return []
    visible = (path for path in folder.iterdir() if not path.name.startswith("."))
    return sorted(path for path in visible if path.suffix.lower() in suffixes)


def _colour(folder: Path) -> list[Path]:
    """The camera's colour files, in its folder or in a folder of their own."""
    in_folders = [
        files for name in COLOUR_FOLDERS if (files := _images(folder / name, IMAGE_SUFFIXES))
    ]
    return in_folders[0] if in_folders else _images(folder, IMAGE_SUFFIXES)


def _depth(folder: Path) -> list[Path]:
    return _images(folder / "depth", (".png",))
