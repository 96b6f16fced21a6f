"""Calibrations of EasyMocap: a folder with ``intri.yml`` and ``extri.yml``, as OpenCV writes YAML.

``names`` lists the cameras; of each, ``K_<name>`` and ``dist_<name>`` (older files: ``D_<name>``)
stand in the one, the rotation vector ``R_<name>``, its matrix ``Rot_<name>`` and ``T_<name>`` with
x_camera = R x_world + T in the other; metres. ``W_`` and ``H_`` are the image's size where they are
there; else it is that of the recordings.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.calibration.opencv import (
    Calibration,
    image_size_of,
    load_opencv,
    opencv_lens,
    opencv_pose,
)
from intercap_core.formats.calibration.other import OtherCamera, Recorded, put_together
from intercap_core.inputs.quotes import quoted

INTRINSICS, EXTRINSICS = "intri.yml", "extri.yml"
SAME_ROTATION = 1e-3  # of the entries of one rotation's two forms; files have six digits


def read_easymocap_calibration(
    folder: Path, recorded: Recorded, scale: float | None
) -> Calibration:
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
        size = _size(lenses, name, where, recorded)
        lens = opencv_lens(size, matrix, distortion, where)
        cameras.append(
            OtherCamera(
                (name,), lens, _pose(poses, name, f"{folder / EXTRINSICS}: camera {quoted(name)}")
            )
        )
    return put_together(folder, "EasyMocap", cameras, recorded, scale=scale, unit=None)


def _entry(content: dict[str, Any], key: str, where: str) -> Any:
    if content.get(key) is None:
        raise UserError(f"{where}: has no {key}; calibrate this camera too")
    return content[key]


def _size(content: dict[str, Any], name: str, where: str, recorded: Recorded) -> tuple[int, int]:
    stated = [content.get(f"{key}_{name}") for key in "WH"]
    if None not in stated:
        return image_size_of(stated, where)
    size = recorded.size_of(name)
    if size is None:
        raise UserError(
            f"{where}: has no W_{name} and H_{name}, and no recording of this camera says how "
            "large its images are; add both (whole pixels), or the recording"
        )
    return size


def _pose(content: dict[str, Any], name: str, where: str) -> np.ndarray:
    shift = _entry(content, f"T_{name}", where)
    vector, matrix = content.get(f"R_{name}"), content.get(f"Rot_{name}")
    turns = [turn for turn in (vector, matrix) if turn is not None]
    if not turns:
        raise UserError(f"{where}: has no R_{name}; calibrate this camera too")
    poses = [opencv_pose(turn, shift, where) for turn in turns]
    if np.abs(poses[0] - poses[-1]).max() > SAME_ROTATION:
        raise UserError(f"{where}: R_{name} and Rot_{name} are two rotations; keep the right one")
    return poses[0]
