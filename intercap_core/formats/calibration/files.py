"""Calibrations in any form that is read; which one it is, the file or folder itself says."""

from __future__ import annotations

from pathlib import Path

from intercap_core.errors import UserError
from intercap_core.formats.calibration.colmap import is_colmap, read_colmap_calibration
from intercap_core.formats.calibration.easymocap import (
    EXTRINSICS,
    INTRINSICS,
    read_easymocap_calibration,
)
from intercap_core.formats.calibration.nerfstudio import (
    TRANSFORMS,
    is_nerfstudio,
    read_nerfstudio_calibration,
)
from intercap_core.formats.calibration.opencv import Calibration, read_opencv_calibration
from intercap_core.formats.calibration.other import Recorded
from intercap_core.formats.calibration.toml import read_toml_calibration
from intercap_core.inputs.files import Unreadable
from intercap_core.inputs.json_files import read_json

PARTS = {  # a file that is half of a calibration: its folder is the whole
    INTRINSICS, EXTRINSICS, "cameras.txt", "images.txt", "cameras.bin", "images.bin",
}  # fmt: skip


def read_calibration(
    path: Path, recorded: Recorded | None = None, *, scale: float | None = None
) -> Calibration:
    """Read a calibration in OpenCV's terms, or of Pose2Sim, Anipose, EasyMocap, COLMAP, nerfstudio.

    ``recorded``: what the recordings say of their cameras. ``scale``: metres for one unit of the
    file, None = not stated. Raises UserError as the format's reader does, and for a scale with a
    file that is in metres by its own definition.
    """
    path, recorded = Path(path), recorded or Recorded()
    other = read_other_calibration(path, recorded, scale)
    if other is not None:
        return other
    refuse_scale(path, scale)
    return read_opencv_calibration(path)


def read_other_calibration(
    path: Path, recorded: Recorded, scale: float | None
) -> Calibration | None:
    """Read a calibration of another tool; None where the path is none of these."""
    if path.is_dir():
        if any((path / name).is_file() for name in (INTRINSICS, EXTRINSICS)):
            return read_easymocap_calibration(path, recorded, scale)
        if is_colmap(path):
            return read_colmap_calibration(path, recorded, scale)
        if (path / TRANSFORMS).is_file():
            return read_nerfstudio_calibration(path / TRANSFORMS, recorded, scale)
        return _one_toml_file(path, recorded, scale)
    if path.name in PARTS:
        raise UserError(f"{path}: is a part of a calibration; name its folder, {path.parent}")
    if path.suffix.lower() == ".toml":
        return read_toml_calibration(path, recorded, scale)
    if path.suffix.lower() == ".json" and _has_frames(path):
        return read_nerfstudio_calibration(path, recorded, scale)
    return None


def refuse_scale(path: Path, scale: float | None) -> None:
    """Raise UserError for a scale that is stated beside a file in metres."""
    if scale is not None:
        raise UserError(
            f"{path}: is in metres, yet column calibration_scale of the table of sequences says "
            f"{scale:g}; leave it empty and write the file in metres"
        )


def _one_toml_file(folder: Path, recorded: Recorded, scale: float | None) -> Calibration | None:
    files = sorted(folder.glob("[!.]*.toml"))
    if len(files) > 1:
        raise UserError(
            f"{folder}: holds {', '.join(file.name for file in files)}; name the one that is the "
            "calibration"
        )
    return read_toml_calibration(files[0], recorded, scale) if files else None


def _has_frames(path: Path) -> bool:
    try:
        return is_nerfstudio(read_json(path))
    except Unreadable:
        return False  # the reader of OpenCV's files says what is wrong with it
