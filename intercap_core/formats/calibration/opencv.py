"""Calibration files in OpenCV's terms.

A file is JSON or YAML, written by hand or by ``cv2.FileStorage``; docs/recordings.md shows an
example. A lens has 4, 5 or 8 distortion coefficients in OpenCV's order (k1, k2, p1, p2[, k3[, k4,
k5, k6]]). A pose is R, T of x_camera = R x_world + T, metres.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from intercap_core.errors import UserError
from intercap_core.formats.calibration.extrinsics import (
    CAMERA_NAME,
    Extrinsics,
    check_distance,
    list_names,
    parse_pose,
    relate_to_master,
)
from intercap_core.formats.calibration.lens_checks import (
    check_lens,
    check_resolution,
    pad_distortion,
    turning_radius,
)
from intercap_core.geometry.camera.intrinsics import DEFAULT_METRIC_RADIUS, Intrinsics
from intercap_core.geometry.camera.transforms import invert, is_rigid
from intercap_core.inputs.documents import YamlLoader, read_json, read_yaml
from intercap_core.inputs.files import UnreadableFile, parse_numbers, quoted

# Between the colour and the depth lens of a camera; beyond it, the file is in millimetres.
MAX_LENSES_APART_M = 1.0
MAX_SIDE = 16_384  # px of an image; no sensor has more
_MATRIX_TYPES = ("opencv-matrix", "opencv-nd-matrix")  # OpenCV 5 writes vectors as the latter


@dataclass(frozen=True, eq=False)
class CalibratedCamera:
    """One camera of a calibration."""

    colour: Intrinsics
    """Lens of the colour camera."""
    depth: Intrinsics | None = None
    """Lens of the depth camera; None without depth."""
    colour_from_depth: np.ndarray | None = None
    """(4, 4), metres."""
    fps: float | None = None
    """Images a second; None = not stated."""
    time_offset: float = 0.0
    """Seconds that are added to the times of all images."""
    depth_unit_m: float = 0.001
    """Metres for one unit of the depth files."""
    as_stored: bool = False
    """Whether lens and pose are those of image files as stored, without their Exif orientation."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """All cameras of a calibration and their poses."""

    cameras: dict[str, CalibratedCamera]
    """Lenses by the camera's name."""
    extrinsics: Extrinsics
    """Poses of the same cameras."""


def read_opencv_calibration(path: Path) -> Calibration:
    """Read a calibration file, or a folder with one file a camera, ``<camera>.json|yaml|yml``.

    Raises UserError naming file, camera and field if something is missing or impossible.
    """
    content = read_content(path)
    entries = content.get("cameras")
    if not isinstance(entries, dict) or not entries:
        raise UserError(
            f"{path}: expected 'cameras' with an entry for each camera (or a folder of files, one "
            "a camera); docs/recordings.md shows one"
        )
    master = str(content.get("master", next(iter(entries))))
    if master not in entries:
        raise UserError(
            f"{path}: master {quoted(master)} is none of the cameras ({list_names(entries)}); "
            "correct the name or add the camera"
        )
    fps, unit = _rate(content, f"{path}"), _depth_unit(content, f"{path}")
    cameras, poses = {}, {}
    for name, entry in entries.items():
        where = f"{path}: camera {quoted(name)}"
        if not isinstance(entry, dict) or not CAMERA_NAME.fullmatch(name):
            raise UserError(
                f"{where}: expected a name of letters, digits, '_' and '-', and fields such as "
                "camera_matrix; correct it"
            )
        cameras[name] = _camera(entry, where, fps, unit)
        poses[name] = _pose(entry, where, path, is_master=name == master)
    return Calibration(cameras, relate_to_master(path, master, poses))


def read_content(path: Path) -> dict[str, Any]:
    """Content of a calibration file, or of a folder with one file a camera as such a file.

    Raises UserError as :func:`load_opencv`.
    """
    if not path.is_dir():
        return load_opencv(path)
    suffixes = (".json", ".yaml", ".yml")
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in suffixes)
    return {"cameras": {file.stem: load_opencv(file) for file in files}}


def states_lenses(path: Path) -> bool:
    """Whether a file or folder is a calibration in OpenCV's terms, with the lens of a camera."""
    try:
        entries = read_content(path).get("cameras")
    except UserError:
        return False
    every = entries.values() if isinstance(entries, dict) else ()
    return any(isinstance(entry, dict) and "camera_matrix" in entry for entry in every)


def opencv_lens(size: tuple[int, int], matrix: Any, coefficients: Any, where: str) -> Intrinsics:
    """Make a lens of ``size`` (width, height) from a matrix (3, 3) and 4, 5 or 8 coefficients.

    Its metric radius is 1.1 times the radius of the farthest corner of the image, at least
    ``DEFAULT_METRIC_RADIUS`` and at most :func:`turning_radius`. Otherwise points outside the view
    could be projected into the image. Raises UserError, beginning with ``where``, for numbers that
    describe no lens.
    """
    k, d = (
        parse_numbers(matrix, where, "camera_matrix"),
        parse_numbers(coefficients, where, "distortion"),
    )
    d = d.ravel()
    if d.size not in (4, 5, 8):
        more = (
            "; thin prism and tilt are not supported: calibrate with CALIB_RATIONAL_MODEL alone"
            if d.size in (12, 14)
            else ""
        )
        raise UserError(
            f"{where}: distortion_coefficients has {d.size} numbers, expected 4, 5 or 8{more}"
        )
    is_plain = k.shape == (3, 3) and k[0, 1] == 0 and k[1, 0] == 0 and (k[2] == [0, 0, 1]).all()
    if not is_plain or min(k[0, 0], k[1, 1]) <= 0:
        raise UserError(
            f"{where}: camera_matrix is no [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels; "
            "correct it"
        )
    check_resolution(k[:2, 2], size, 0.25, where)
    distortion = pad_distortion(d)
    arguments = (*size, k[0, 0], k[1, 1], k[0, 2], k[1, 2], distortion)
    turn = turning_radius(distortion)
    corners = np.array([[0, 0], [size[0], 0], [0, size[1]], size]) - 0.5
    widest = np.linalg.norm(Intrinsics(*arguments, turn).unproject(corners)[:, :2], axis=1).max()
    radius = min(turn, max(1.1 * float(widest), DEFAULT_METRIC_RADIUS))
    return check_lens(Intrinsics(*arguments, radius), where)


def check_rate(fps: float, where: str) -> None:
    """Raise UserError for a frame rate that no camera has."""
    low, high = 0.05, 10_000.0  # time lapse to high-speed cameras
    if not low <= fps <= high:
        raise UserError(f"{where}: fps is {fps:.4g}, expected {low:g} to {high:g}; correct it")


def parse_number(value: Any, where: str, field: str, expected: str = "one number") -> float:
    """A single finite number; raises UserError, beginning with ``where``, for anything else."""
    numbers = parse_numbers(value, where, field)
    if numbers.size != 1:
        raise UserError(f"{where}: {field} is {quoted(value, 40)}, expected {expected}; correct it")
    return float(numbers.ravel()[0])


def parse_image_size(size: Any, where: str) -> tuple[int, int]:
    """Width and height in whole pixels; raises UserError, beginning with ``where``, otherwise."""
    numbers = parse_numbers(size, where, "image_size").ravel()
    whole = (numbers == numbers.round()) & (numbers >= 1) & (numbers <= MAX_SIDE)
    if numbers.size != 2 or not whole.all():
        raise UserError(
            f"{where}: image_size is {quoted(size)}, expected width and height in pixels"
        )
    return int(numbers[0]), int(numbers[1])


def _camera(entry: dict[str, Any], where: str, fps: float | None, unit: float) -> CalibratedCamera:
    """Read all of a camera's entry but its pose.

    ``fps`` and ``unit`` are the rate and the unit of depth, metres, stated for all cameras.
    """
    colour = _lens(entry, where)
    offset = parse_number(entry.get("time_offset", 0.0), where, "time_offset", "seconds")
    if abs(offset) > 1e9:  # clocks that count from 1970 are above it
        raise UserError(f"{where}: time_offset is {offset:.4g}, expected seconds; correct it")
    depth = entry.get("depth")
    lens, colour_from_depth = None, None
    if depth == "aligned":
        lens, colour_from_depth = colour, np.eye(4)
    elif isinstance(depth, dict):
        lens = _lens(depth, f"{where}, depth")
        field = "depth.colour_from_depth"
        colour_from_depth = parse_numbers(depth.get("colour_from_depth"), where, field)
        if not is_rigid(colour_from_depth):
            raise UserError(
                f"{where}: {field} is no rigid 4x4 transform (x_colour = R x_depth + t, metres, "
                "last row 0 0 0 1); correct it"
            )
        distance = float(np.linalg.norm(colour_from_depth[:3, 3]))
        if distance > MAX_LENSES_APART_M:
            raise UserError(
                f"{where}: {field} moves by {distance:.4g} m, expected at most "
                f"{MAX_LENSES_APART_M:.0f} m, so it is likely in millimetres; write it in metres"
            )
    elif depth is not None:
        raise UserError(
            f"{where}: depth is {quoted(depth, 40)}, expected 'aligned' or a lens with "
            "colour_from_depth; correct it"
        )
    fps, unit = _rate(entry, where) or fps, _depth_unit(entry, where, unit)
    return CalibratedCamera(colour, lens, colour_from_depth, fps, offset, unit)


def _depth_unit(entry: dict[str, Any], where: str, unit: float = 0.001) -> float:
    """Metres for one unit of the depth files; ``unit`` if the entry does not state it."""
    value = parse_number(entry.get("depth_unit", unit), where, "depth_unit", "metres")
    if not 1e-6 <= value <= 0.1:  # 16 bits then reach 6.5 cm, or have steps of 10 cm
        raise UserError(
            f"{where}: depth_unit is {value:.4g}, expected metres for one unit of the depth files "
            "(0.001 = millimetres, 0.0002 = 1/5000 m); correct it"
        )
    return value


def _lens(entry: dict[str, Any], where: str) -> Intrinsics:
    for key in ("camera_matrix", "distortion_coefficients"):
        if key not in entry:
            raise UserError(f"{where}: has no {key}; add it")
    stated = entry.get("image_size", [entry.get("image_width"), entry.get("image_height")])
    size = parse_image_size(stated, where)
    return opencv_lens(size, entry["camera_matrix"], entry["distortion_coefficients"], where)


def _pose(entry: dict[str, Any], where: str, path: Path, *, is_master: bool) -> np.ndarray:
    """World from camera (4, 4), metres; the identity for a master without a pose."""
    rotation, translation = (
        entry.get(key, entry.get(other)) for key, other in (("R", "rvec"), ("T", "tvec"))
    )
    if rotation is None and translation is None and is_master:
        return np.eye(4)
    if rotation is None or translation is None:
        raise UserError(
            f"{where}: has no pose; add R (3x3, or a rotation vector) and T with x_camera = R "
            "x_world + T, metres"
        )
    camera_from_world = parse_pose(rotation, translation, where)
    check_distance(path, f"camera {where.rpartition(' ')[2]}", camera_from_world[:3, 3])
    return invert(camera_from_world)


def _rate(entry: dict[str, Any], where: str) -> float | None:
    value = entry.get("fps")
    if value is None:
        return None
    fps = parse_number(value, where, "fps", "one positive number")
    check_rate(fps, where)
    return fps


class _Loader(YamlLoader):
    """The safe loader, extended by OpenCV's matrices."""


def _matrix(entry: dict[Any, Any]) -> Any:
    """Nested lists of an array as ``cv2.FileStorage`` writes it."""
    try:
        shape = entry["sizes"] if "sizes" in entry else (entry["rows"], entry["cols"])
        return np.array(entry["data"], np.float64).reshape(shape).tolist()
    except (KeyError, TypeError, ValueError, OverflowError):
        return None


def _yaml_matrix(loader: yaml.SafeLoader, node: Any) -> Any:
    return _matrix(loader.construct_mapping(node, deep=True))


for _name in _MATRIX_TYPES:
    _Loader.add_constructor(f"tag:yaml.org,2002:{_name}", _yaml_matrix)


def _json_object(entry: dict[str, Any]) -> Any:
    return _matrix(entry) if entry.get("type_id") in _MATRIX_TYPES else entry


def load_opencv(path: Path) -> dict[str, Any]:
    """Read a JSON or YAML file, written by hand or by ``cv2.FileStorage``.

    Matrices become nested lists. Raises UserError if the file is neither, or if its top level is
    not a mapping.
    """
    try:
        if path.suffix.lower() == ".json":
            content = read_json(path, entry=_json_object)
        else:  # OpenCV's first line, %YAML:1.0, is not YAML
            content = read_yaml(
                path,
                loader=_Loader,
                prepared=lambda text: text.removeprefix("%YAML:1.0"),
            )
    except UnreadableFile as error:
        reason = re.sub("(is )?not valid (JSON|YAML)", "is not valid JSON or YAML", error.reason)
        raise UserError(f"{path}: {reason}; correct it") from None
    if not isinstance(content, dict):
        raise UserError(f"{path}: expected names and values, found {type(content).__name__}")
    return content
