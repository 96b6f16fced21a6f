"""Calibrations of nerfstudio: ``transforms.json``.

Each frame has a ``transform_matrix``, world from camera with OpenGL's axes (x right, y up, z
backwards). Lenses are stated in the frame, or for all frames at the top level of the file. The unit
of length is that of the program that made the file: metres if a phone tracked itself, arbitrary if
COLMAP did. Nerfstudio's centre of the first pixel is (0.5, 0.5); in this package it is (0, 0).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.calibration.files import (
    CalibrationReader,
    RecordedCameras,
    group_images_by_camera,
    to_calibration,
)
from intercap_core.formats.calibration.opencv import (
    Calibration,
    opencv_lens,
    parse_image_size,
    parse_number,
)
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.transforms import invert, is_rigid
from intercap_core.inputs.documents import read_json, read_object
from intercap_core.inputs.files import UnreadableFile, parse_numbers, quoted

TRANSFORMS = "transforms.json"
MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")


def _recognises(path: Path) -> bool:
    """Whether the path is a folder with transforms.json, or JSON with frames.

    JSON that also has ``cameras`` is a calibration in OpenCV's terms.
    """
    if path.is_dir():
        return (path / TRANSFORMS).is_file()
    if path.suffix.lower() != ".json":
        return False
    try:
        content = read_json(path)
    except UnreadableFile:
        return False  # the reader of OpenCV's files reports the fault
    return isinstance(content, dict) and "frames" in content and "cameras" not in content


def _read(path: Path, recorded: RecordedCameras, scale: float | None) -> Calibration:
    """Read a transforms.json or its folder; raises UserError naming file, frame and field."""
    path = path / TRANSFORMS if path.is_dir() else path
    images = _images(path, read_object(path))
    cameras = group_images_by_camera(path, images, recorded, scale=scale)
    unit = "its world has the unit of the program that made it"
    return to_calibration(path, "nerfstudio", cameras, recorded, scale=scale, unit=unit)


READER = CalibrationReader(tool="nerfstudio", rank=2, recognises=_recognises, read=_read)


def _images(path: Path, content: dict[str, Any]) -> Iterator[tuple[str, Intrinsics, np.ndarray]]:
    """Yield path, lens and camera_from_world (4, 4) of each frame."""
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
    pose = parse_numbers(frame.get("transform_matrix"), where, "transform_matrix")
    if not is_rigid(pose):
        raise UserError(
            f"{where}: transform_matrix is no rigid 4x4 transform of world from camera; correct it"
        )
    opengl_from_opencv = np.diag([1.0, -1.0, -1.0, 1.0])
    return invert(pose @ opengl_from_opencv)


def _lens(entry: dict[str, Any], where: str) -> Intrinsics:
    """The lens of a frame's fields, to which those at the top level were added."""
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
    values = {"fl_y": entry["fl_x"], **entry}
    fx, fy, cx, cy, k4, *distortion = (
        parse_number(values.get(key, 0.0), where, key)
        for key in ("fl_x", "fl_y", "cx", "cy", "k4", "k1", "k2", "p1", "p2", "k3")
    )
    if k4 != 0:
        raise UserError(
            f"{where}: k4 is {k4:g}, a coefficient of the eighth power of the radius that cannot "
            "be represented; calibrate with k1, k2, k3, p1 and p2 alone"
        )
    matrix = [[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]]
    size = parse_image_size([entry["w"], entry["h"]], where)
    return opencv_lens(size, matrix, distortion, where)
