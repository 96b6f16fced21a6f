"""Calibrations of EasyMocap: a folder with ``intri.yml`` and ``extri.yml``, as OpenCV writes YAML.

``names`` lists the cameras. Of each camera, ``intri.yml`` holds ``K_<name>`` and ``dist_<name>``
(older files: ``D_<name>``). ``extri.yml`` holds the rotation vector ``R_<name>``, its matrix
``Rot_<name>`` and ``T_<name>`` with x_camera = R x_world + T, metres. ``W_<name>`` and ``H_<name>``
are the image's size; without them it is that of the recordings.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.calibration.extrinsics import parse_pose
from intercap_core.formats.calibration.files import (
    CalibrationReader,
    RecordedCameras,
    ToolCamera,
    to_calibration,
)
from intercap_core.formats.calibration.opencv import (
    Calibration,
    load_opencv,
    opencv_lens,
    parse_image_size,
)
from intercap_core.inputs.files import quoted

INTRINSICS, EXTRINSICS = "intri.yml", "extri.yml"


def _read(folder: Path, recorded: RecordedCameras, scale: float | None) -> Calibration:
    """Read the pair of files; raises UserError naming file, camera and field."""
    for name in (INTRINSICS, EXTRINSICS):
        if not (folder / name).is_file():
            raise UserError(
                f"{folder}: has no {name}; EasyMocap writes {INTRINSICS} and {EXTRINSICS}"
            )
    lenses, poses = load_opencv(folder / INTRINSICS), load_opencv(folder / EXTRINSICS)
    names = lenses.get("names")
    if not isinstance(names, list) or not names:
        raise UserError(f"{folder / INTRINSICS}: expected 'names', a list of cameras; correct it")
    cameras = []
    for name in map(str, names):
        where = f"{folder / INTRINSICS}: camera {quoted(name)}"
        distortion = lenses.get(f"dist_{name}", lenses.get(f"D_{name}"))
        matrix = _entry(lenses, f"K_{name}", where)
        if distortion is None:
            raise UserError(f"{where}: has no dist_{name}; add it (zeros for a plain lens)")
        lens = opencv_lens(_size(lenses, name, where, recorded), matrix, distortion, where)
        pose = _pose(poses, name, f"{folder / EXTRINSICS}: camera {quoted(name)}")
        cameras.append(ToolCamera((name,), lens, pose))
    return to_calibration(folder, "EasyMocap", cameras, recorded, scale=scale, unit=None)


READER = CalibrationReader(
    tool="EasyMocap",
    rank=0,
    recognises=lambda path: any((path / name).is_file() for name in (INTRINSICS, EXTRINSICS)),
    read=_read,
    parts=(INTRINSICS, EXTRINSICS),
)


def _entry(content: dict[str, Any], key: str, where: str) -> Any:
    if content.get(key) is None:
        raise UserError(f"{where}: has no {key}; calibrate this camera too")
    return content[key]


def _size(
    content: dict[str, Any], name: str, where: str, recorded: RecordedCameras
) -> tuple[int, int]:
    """Width and height that the file states, or else those of the camera's recording."""
    stated = [content.get(f"{key}_{name}") for key in "WH"]
    if None not in stated:
        return parse_image_size(stated, where)
    size = recorded.size_of(name)
    if size is None:
        raise UserError(
            f"{where}: has no W_{name} and H_{name}, and no recording of this camera says how "
            "large its images are; add both (whole pixels), or the recording"
        )
    return size


def _pose(content: dict[str, Any], name: str, where: str) -> np.ndarray:
    """Camera from world (4, 4), metres; raises UserError if ``R`` and ``Rot`` disagree."""
    translation = _entry(content, f"T_{name}", where)
    rotations = [content.get(f"{key}_{name}") for key in ("R", "Rot")]
    rotations = [rotation for rotation in rotations if rotation is not None]
    if not rotations:
        raise UserError(f"{where}: has no R_{name}; calibrate this camera too")
    poses = [parse_pose(rotation, translation, where) for rotation in rotations]
    if np.abs(poses[0] - poses[-1]).max() > 1e-3:  # files have six digits
        raise UserError(f"{where}: R_{name} and Rot_{name} are two rotations; keep the right one")
    return poses[0]
