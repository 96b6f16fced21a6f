"""Calibrations of Pose2Sim and Anipose: TOML, a table for each camera.

Both write ``name``, ``size`` (width, height), ``matrix``, ``distortions`` (OpenCV's 4 or 5),
``rotation`` (a rotation vector) and ``translation`` with x_camera = R x_world + T. Pose2Sim adds
``fisheye`` to every camera and works in metres. Anipose works in the unit in which the squares of
the board were stated, which the file does not say.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from intercap_core.errors import UserError
from intercap_core.formats.calibration.extrinsics import parse_pose
from intercap_core.formats.calibration.files import (
    CalibrationReader,
    RecordedCameras,
    ToolCamera,
    only_file,
    to_calibration,
)
from intercap_core.formats.calibration.opencv import (
    Calibration,
    opencv_lens,
    parse_image_size,
)
from intercap_core.inputs.documents import read_toml
from intercap_core.inputs.files import quoted

FIELDS = ("size", "matrix", "distortions", "rotation", "translation")


def _toml_files(path: Path) -> list[Path]:
    if path.is_dir():
        return sorted(path.glob("[!.]*.toml"))
    return [path] if path.suffix.lower() == ".toml" else []


def _read(path: Path, recorded: RecordedCameras, scale: float | None) -> Calibration:
    """Read a file, or the only TOML file of a folder; raises UserError naming camera and field."""
    path = only_file(path, _toml_files(path))
    tables = _camera_tables(path)
    cameras = []
    for section, table in tables.items():
        where = f"{path}: camera {quoted(section)}"
        missing = [field for field in FIELDS if field not in table]
        if missing:
            raise UserError(f"{where}: has no {missing[0]}; calibrate this camera too")
        if table.get("fisheye", False) is not False:
            raise UserError(
                f"{where}: is calibrated as a fisheye, which cannot be represented; undistort its "
                "recording, or calibrate it with the standard model (fisheye = false)"
            )
        size = parse_image_size(table["size"], where)
        lens = opencv_lens(size, table["matrix"], table["distortions"], where)
        pose = parse_pose(table["rotation"], table["translation"], where)
        cameras.append(ToolCamera(_names(section, table, where), lens, pose))
    pose2sim = all("fisheye" in table for table in tables.values())
    unit = "its translations are in the unit in which the board's squares were stated"
    return to_calibration(
        path,
        "Pose2Sim" if pose2sim else "Anipose",
        cameras,
        recorded,
        scale=scale,
        unit=None if pose2sim else unit,
    )


READER = CalibrationReader(
    tool="Pose2Sim or Anipose",
    rank=3,
    recognises=lambda path: bool(_toml_files(path)),
    read=_read,
)


def _camera_tables(path: Path) -> dict[str, dict[str, Any]]:
    """The tables that describe cameras, by their names."""
    content = read_toml(path)
    tables = {
        name: table
        for name, table in content.items()
        if isinstance(table, dict) and any(field in table for field in FIELDS)
    }
    if not tables:
        raise UserError(
            f"{path}: has no table with {', '.join(FIELDS)}; give the calibration that Pose2Sim or "
            "Anipose wrote, not their configuration"
        )
    return tables


def _names(section: str, table: dict[str, Any], where: str) -> tuple[str, ...]:
    """Names that the camera's recording may have."""
    name = table.get("name", section)
    if not isinstance(name, str):
        raise UserError(f"{where}: name is {quoted(name, 40)}, expected text; correct it")
    # Pose2Sim names a camera after its folder of images of the board, int_<name>_img.
    folder = re.fullmatch(r"int_(.+)_img", name)
    return (name, section, *([folder[1]] if folder else []))
