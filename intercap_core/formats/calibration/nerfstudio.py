"""Calibrations of nerfstudio: ``transforms.json``.

Each frame has a ``transform_matrix``, world from camera with OpenGL's axes (x right, y up, z
backwards), and lenses stand in the frame or above all frames. The world has the unit of whatever
made the file: metres of a phone's tracking, or COLMAP's without a scale. The first pixel's centre
is at (0.5, 0.5), here at (0, 0).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.calibration.opencv import Calibration, image_size_of, opencv_lens
from intercap_core.formats.calibration.other import Recorded, fixed_cameras, put_together
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.transforms import invert, is_rigid
from intercap_core.inputs.json_files import read_object
from intercap_core.inputs.numbers import numbers_of
from intercap_core.inputs.quotes import quoted

TRANSFORMS = "transforms.json"
FIRST_PIXEL = 0.5  # where its centre is, in nerfstudio's coordinates
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")


def is_nerfstudio(content: Any) -> bool:
    """Whether JSON content is a list of frames, and no calibration of another form."""
    return isinstance(content, dict) and "frames" in content and "cameras" not in content


def read_nerfstudio_calibration(path: Path, recorded: Recorded, scale: float | None) -> Calibration:
    """Read a transforms.json; raises UserError naming file, frame and field."""
    content = read_object(path)
    cameras = fixed_cameras(path, _images(path, content), recorded, scale=scale)
    unit = "its world has the unit of the program that made it"
    return put_together(path, "nerfstudio", cameras, recorded, scale=scale, unit=unit)


def _images(path: Path, content: dict[str, Any]) -> Iterator[tuple[str, Intrinsics, np.ndarray]]:
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise UserError(f"{path}: 'frames' is no list of frames; correct it")
    shared = {key: value for key, value in content.items() if key != "frames"}
    for number, frame in enumerate(frames):
        where = f"{path}: frame {number}"
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise UserError(f"{where}: has no file_path; correct it")
        where = f"{where} ({quoted(frame['file_path'])})"
        yield frame["file_path"], _lens({**shared, **frame}, where), _pose(frame, where)


def _pose(frame: dict[str, Any], where: str) -> np.ndarray:
    """Camera from world (4, 4), OpenCV's axes."""
    pose = numbers_of(frame.get("transform_matrix"), where, "transform_matrix")
    if not is_rigid(pose):
        raise UserError(
            f"{where}: transform_matrix is no rigid 4x4 transform of world from camera; correct it"
        )
    return invert(pose @ OPENGL_FROM_OPENCV)


def _lens(entry: dict[str, Any], where: str) -> Intrinsics:
    model = entry.get("camera_model", MODELS[0])
    if model not in MODELS or entry.get("is_fisheye"):
        shown = "is_fisheye" if model in MODELS else f"camera_model {quoted(model, 40)}"
        raise UserError(
            f"{where}: {shown} cannot be represented, expected {', '.join(MODELS)}; undistort the "
            "recordings, or calibrate with one of these models"
        )
    missing = [key for key in ("fl_x", "cx", "cy", "w", "h") if key not in entry]
    if missing:
        raise UserError(f"{where}: has no {missing[0]}, nor has the file above its frames; add it")
    fx, fy, cx, cy, k4, *bends = (
        _number(entry, key, default, where)
        for key, default in (
            ("fl_x", 0.0), ("fl_y", entry["fl_x"]), ("cx", 0.0), ("cy", 0.0), ("k4", 0.0),
            *((key, 0.0) for key in COEFFICIENTS),
        )
    )  # fmt: skip
    if k4 != 0:
        raise UserError(
            f"{where}: k4 is {k4:g}, a coefficient of the eighth power of the radius that cannot "
            "be represented; calibrate with k1, k2, k3, p1 and p2 alone"
        )
    matrix = [[fx, 0, cx - FIRST_PIXEL], [0, fy, cy - FIRST_PIXEL], [0, 0, 1]]
    return opencv_lens(image_size_of([entry["w"], entry["h"]], where), matrix, bends, where)


def _number(entry: dict[str, Any], key: str, default: Any, where: str) -> float:
    number = numbers_of(entry.get(key, default), where, key)
    if number.size != 1:
        raise UserError(
            f"{where}: {key} is {quoted(entry.get(key), 40)}, expected one number; correct it"
        )
    return float(number.ravel()[0])
