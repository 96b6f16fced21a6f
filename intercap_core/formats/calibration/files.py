"""Read calibrations in any supported form; functions that the readers of single tools share.

``read_calibration`` asks the reader of each tool whether it recognises the file or folder. If none
does, the path is read by :mod:`.opencv`. A module of this package that defines ``READER``, a
:class:`CalibrationReader`, adds a tool.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path, PurePosixPath

import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.calibration.extrinsics import (
    MAX_DISTANCE_M,
    check_camera_name,
    list_names,
    read_extrinsics,
    relate_to_master,
)
from intercap_core.formats.calibration.opencv import (
    CalibratedCamera,
    Calibration,
    read_opencv_calibration,
    states_lenses,
)
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.transforms import invert, rotation_log
from intercap_core.plugins import modules_of


@dataclass(frozen=True)
class RecordedCameras:
    """Facts about the recordings that help to read a calibration."""

    names: Collection[str] = ()
    """Names of the recorded cameras."""
    size_of: Callable[[str], tuple[int, int] | None] = field(default=lambda name: None)
    """Width and height of a camera's first image; None if it cannot be read."""


@dataclass(frozen=True)
class CalibrationReader:
    """Reader of the calibration files of one tool."""

    tool: str
    """Name of the tool."""
    rank: int
    """Position in the order in which readers are tried; the lowest is first."""
    recognises: Callable[[Path], bool]
    """Whether a file or folder is a calibration of the tool."""
    read: Callable[[Path, RecordedCameras, float | None], Calibration]
    """Reads a path that is recognised; the last argument is metres for one unit of the file."""
    parts: tuple[str, ...] = ()
    """Names of files that hold half of a calibration; the user names their folder instead."""


@dataclass(frozen=True, eq=False)
class ToolCamera:
    """One camera as a tool calibrated it, with OpenCV's axes."""

    names: tuple[str, ...]
    """Names that the recording may have, the most likely one first."""
    lens: Intrinsics
    """Lens of the colour camera."""
    camera_from_world: np.ndarray
    """(4, 4), in the file's unit of length."""


@cache
def calibration_readers() -> tuple[CalibrationReader, ...]:
    """The readers of all tools, in the order in which they are tried."""
    modules = modules_of("intercap_core.formats.calibration")
    readers = [module.READER for module in modules if hasattr(module, "READER")]
    return tuple(sorted(readers, key=lambda reader: (reader.rank, reader.tool)))


def read_calibration(
    path: Path,
    recorded: RecordedCameras | None = None,
    *,
    scale: float | None = None,
    lenses: bool = True,
) -> Calibration:
    """Read a calibration in OpenCV's terms or of another tool.

    Raises UserError as the format's reader does, and for a ``scale`` of a file that is in metres.

    Args:
        path: file or folder.
        recorded: the recordings, which help to name the cameras.
        scale: metres for one unit of the file; None = not stated.
        lenses: whether the file must state lenses. Otherwise rig files and the folders of
            :func:`read_extrinsics` are read too; their ``cameras`` are empty.
    """
    if not path.is_dir() and any(path.name in reader.parts for reader in calibration_readers()):
        raise UserError(f"{path}: is a part of a calibration; name its folder, {path.parent}")
    reader = next((reader for reader in calibration_readers() if reader.recognises(path)), None)
    if reader is not None:
        return reader.read(path, recorded or RecordedCameras(), scale)
    refuse_scale(path, scale)
    if lenses or states_lenses(path):
        return read_opencv_calibration(path)
    return Calibration({}, read_extrinsics(path))


def only_file(path: Path, files: Sequence[Path]) -> Path:
    """Return the only calibration of ``path``; raises UserError if there are several."""
    if len(files) > 1:
        raise UserError(
            f"{path}: holds {', '.join(file.name for file in files)}; name the one that is the "
            "calibration"
        )
    return files[0]


def refuse_scale(path: Path, scale: float | None) -> None:
    """Raise UserError if a scale is stated for a file in metres."""
    if scale is not None:
        raise UserError(
            f"{path}: is in metres, yet column calibration_scale of the table of sequences is "
            f"{scale:g}; leave it empty and write the file in metres"
        )


def to_calibration(
    path: Path,
    tool: str,
    cameras: Sequence[ToolCamera],
    recorded: RecordedCameras,
    *,
    scale: float | None,
    unit: str | None,
    as_stored: bool = False,
) -> Calibration:
    """Name the cameras as the recordings do and scale them to metres; the first is the master.

    Raises UserError for names that are unsafe, used twice or absent from the recordings, and for a
    scale that is missing or impossible.

    Args:
        path: file or folder, for messages.
        tool: name of the tool, for messages.
        cameras: the cameras in the file's order.
        recorded: names of the recorded cameras.
        scale: metres for one unit of the file, as the user states it.
        unit: why the file's unit of length is unknown, as a clause for the message; None if the
            file is in metres.
        as_stored: whether the tool ignores the Exif orientation of image files.
    """
    if not cameras:
        raise UserError(f"{path}: holds no camera; calibrate again, or name another file")
    if unit is not None and scale is None:
        raise UserError(
            f"{path}: {unit}, so the length of a metre in this file of {tool} is unknown; state "
            "metres for one of its units in column calibration_scale of the table of sequences "
            "(1 = metres, 0.001 = millimetres; else a distance that you measured between two "
            "cameras, divided by that in the file)"
        )
    poses: dict[str, np.ndarray] = {}
    calibrated: dict[str, CalibratedCamera] = {}
    for camera in cameras:
        name = next((n for n in camera.names if n in recorded.names), camera.names[0])
        check_camera_name(path, name)
        if name in poses:
            raise UserError(f"{path}: two cameras are named {name!r}; rename one")
        pose = camera.camera_from_world.copy()
        pose[:3, 3] *= scale or 1.0
        poses[name] = invert(pose)
        calibrated[name] = CalibratedCamera(camera.lens, as_stored=as_stored)
    if recorded.names and not set(poses) & set(recorded.names):
        raise UserError(
            f"{path}: its cameras are {list_names(poses)}, the recordings are of "
            f"{list_names(sorted(recorded.names))}: none is the same; give both the same names"
        )
    _check_size(path, np.stack([pose[:3, 3] for pose in poses.values()]), scale)
    return Calibration(calibrated, relate_to_master(path, next(iter(poses)), poses))


def group_images_by_camera(
    path: Path,
    images: Iterable[tuple[str, Intrinsics, np.ndarray]],
    recorded: RecordedCameras,
    *,
    scale: float | None,
) -> list[ToolCamera]:
    """Merge the images of each fixed camera into one camera; sorted by the cameras' names.

    An image belongs to the recorded camera after which a folder of its path (innermost first) or
    the file is named. Otherwise its camera is named after its innermost folder, or after the file
    if there is no folder. Lens and pose are those of the camera's first image. Raises UserError for
    a camera whose images were taken from several places.

    Args:
        path: the calibration, for messages.
        images: path, lens and camera_from_world (4, 4), in the file's unit, of each image.
        recorded: names of the recorded cameras.
        scale: metres for one unit of the file; None = only rotations are compared.
    """
    by_camera: dict[str, list[tuple[str, Intrinsics, np.ndarray]]] = {}
    for image, lens, pose in images:
        by_camera.setdefault(_camera_of(image, recorded.names), []).append((image, lens, pose))
    for name, own in by_camera.items():
        first, _, first_pose = own[0]
        for image, _, pose in own[1:]:
            distance = float(np.linalg.norm(invert(pose)[:3, 3] - invert(first_pose)[:3, 3]))
            distance *= scale or 0.0
            turn = rotation_log(pose[:3, :3] @ first_pose[:3, :3].T)
            angle = np.degrees(np.linalg.norm(turn))
            # Reconstructions of rooms are accurate to millimetres and tenths of a degree.
            if distance > 0.01 or angle > 0.3:
                raise UserError(
                    f"{path}: camera {name!r} has {len(own)} images, of which {first} and "
                    f"{image} are {distance:.3g} m and {angle:.2g} degrees apart, expected one "
                    "place for each fixed camera; keep one image a camera, in a folder named after "
                    "the camera or named so itself"
                )
    return [
        ToolCamera((name,), by_camera[name][0][1], by_camera[name][0][2])
        for name in sorted(by_camera)
    ]


def _camera_of(image: str, recorded: Collection[str]) -> str:
    path = PurePosixPath(image.replace("\\", "/"))
    folders = [part for part in path.parent.parts if part not in (".", "..", "/")]
    for name in [*reversed(folders), path.stem]:
        if name in recorded:
            return name
    own = [name for name in folders if name != "images"]
    return own[-1] if own else path.stem


def _check_size(path: Path, centres: np.ndarray, scale: float | None) -> None:
    """Raise UserError if the cameras' centres (C, 3), metres, lie too far apart or too close."""
    extent = np.linalg.norm(centres[:, None] - centres[None], axis=-1).max()
    farthest = np.abs(centres).max()
    stated = "" if scale is None else f" with calibration_scale {scale:g}"
    if farthest > MAX_DISTANCE_M:
        raise UserError(
            f"{path}: a camera is {farthest:.4g} m from the origin{stated}, expected at most "
            f"{MAX_DISTANCE_M:.0f} m; state the unit in column calibration_scale of the table of "
            "sequences (0.001 = the file is in millimetres)"
        )
    least = 0.05  # metres; cameras that record a whole person stand farther apart
    if len(centres) > 1 and extent < least:
        raise UserError(
            f"{path}: all its cameras lie within {1000 * extent:.3g} mm{stated}, expected at least "
            f"{1000 * least:.0f} mm; correct the scale, or calibrate again"
        )
