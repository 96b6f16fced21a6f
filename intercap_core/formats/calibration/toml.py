"""Calibrations of Pose2Sim and Anipose: TOML, a table for each camera.

Both write ``name``, ``size`` (width, height), ``matrix``, ``distortions`` (OpenCV's 4 or 5),
``rotation`` (a rotation vector) and ``translation`` with x_camera = R x_world + T. Pose2Sim adds
``fisheye`` to every camera and works in metres; Anipose works in the unit in which the board's
squares were stated, which the file does not say.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from intercap_core.errors import UserError
from intercap_core.formats.calibration.opencv import (
    Calibration,
    image_size_of,
    opencv_lens,
    opencv_pose,
)
from intercap_core.formats.calibration.other import OtherCamera, Recorded, put_together
from intercap_core.inputs.json_files import read_toml
from intercap_core.inputs.quotes import quoted

FIELDS = ("size", "matrix", "distortions", "rotation", "translation")
# Pose2Sim names a camera after its folder of intrinsic images, its videos are named without these.
POSE2SIM_FOLDER = re.compile(r"int_(.+)_img")


def read_toml_calibration(path: Path, recorded: Recorded, scale: float | None) -> Calibration:
    """Read a file of Pose2Sim or Anipose; raises UserError naming file, camera and field."""
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
        size = image_size_of(table["size"], where)
        cameras.append(
            OtherCamera(
                _names(section, table, where),
                opencv_lens(size, table["matrix"], table["distortions"], where),
                opencv_pose(table["rotation"], table["translation"], where),
            )
        )
    pose2sim = all("fisheye" in table for table in tables.values())
    unit = "its translations are in the unit in which the board's squares were stated"
    return put_together(
        path,
        "Pose2Sim" if pose2sim else "Anipose",
        cameras,
        recorded,
        scale=scale,
        unit=None if pose2sim else unit,
    )


def _camera_tables(path: Path) -> dict[str, dict[str, Any]]:
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
    name = table.get("name", section)
    if not isinstance(name, str):
        raise UserError(f"{where}: name is {quoted(name, 40)}, expected text; correct it")
    folder = POSE2SIM_FOLDER.fullmatch(name)
    return (name, section, *([folder[1]] if folder else []))
