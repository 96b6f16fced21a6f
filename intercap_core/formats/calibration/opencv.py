"""Calibration files in OpenCV's terms: lenses, depth lenses and poses of all cameras of a rig.

JSON or YAML, by hand or as ``cv2.FileStorage`` writes it; docs/recordings.md shows an example.
A lens has 4, 5 or 8 distortion coefficients in OpenCV's order (k1, k2, p1, p2[, k3[, k4, k5, k6]]);
a pose is R, T of x_camera = R x_world + T, metres.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from intercap_core.errors import UserError
from intercap_core.formats.calibration.extrinsics import (
    CAMERA_NAME,
    Extrinsics,
    check_distance,
    named,
    placed,
)
from intercap_core.formats.calibration.plausible import LONGEST_OFFSET_S, check_lens, check_rate
from intercap_core.geometry.camera.intrinsics import DEFAULT_METRIC_RADIUS, Intrinsics
from intercap_core.geometry.camera.projection import radial_fraction
from intercap_core.geometry.camera.transforms import invert, is_rigid, rigid
from intercap_core.inputs import yaml_files
from intercap_core.inputs.files import MAX_CALIBRATION_BYTES, Unreadable
from intercap_core.inputs.json_files import read_json
from intercap_core.inputs.numbers import numbers_of
from intercap_core.inputs.quotes import quoted

SUFFIXES = (".json", ".yaml", ".yml")
COEFFICIENTS = (4, 5, 8)
ALIGNED = "aligned"
MAX_LENSES_APART_M = 1.0  # colour and depth lens of one camera; farther: the file is in millimetres
MAX_SIDE = 32_768  # px of an image; the largest sensors have half of it
MAX_OFF_CENTRE = 0.25  # of the image's width or height, of a principal point; 0.03 is usual


@dataclass(frozen=True, eq=False)
class CalibratedCamera:
    """One camera of the file; ``fps`` None = not stated; times are in seconds."""

    colour: Intrinsics
    depth: Intrinsics | None = None
    colour_from_depth: np.ndarray | None = None
    fps: float | None = None
    time_offset: float = 0.0


@dataclass(frozen=True, eq=False)
class Calibration:
    """A whole file: cameras by name, and their poses."""

    cameras: dict[str, CalibratedCamera]
    extrinsics: Extrinsics


def read_opencv_calibration(path: Path) -> Calibration:
    """Read a calibration file, or a folder with one file a camera, ``<camera>.json|yaml|yml``.

    Raises UserError naming file, camera and field where something is missing or impossible.
    """
    path = Path(path)
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
        content: dict[str, Any] = {"cameras": {file.stem: load_opencv(file) for file in files}}
    else:
        content = load_opencv(path)
    entries = content.get("cameras")
    if not isinstance(entries, dict) or not entries:
        raise UserError(
            f"{path}: expected 'cameras' with an entry for each camera (or a folder of files, one "
            "a camera); docs/recordings.md shows one"
        )
    master = content.get("master", next(iter(entries)))
    if not isinstance(master, str) or master not in entries:
        raise UserError(
            f"{path}: master {quoted(master)} is none of the cameras ({named(entries)}); "
            "correct the name or add the camera"
        )
    fps = _rate(content, "fps", f"{path}")
    cameras, poses = {}, {}
    for name, entry in entries.items():
        where = f"{path}: camera {quoted(name)}"
        if not isinstance(entry, dict) or not CAMERA_NAME.fullmatch(str(name)):
            raise UserError(
                f"{where}: expected a name of letters, digits, '_' and '-', and fields such as "
                "camera_matrix; correct it"
            )
        cameras[str(name)] = _camera(entry, where, fps)
        poses[str(name)] = _pose(entry, where, path, is_master=name == master)
    return Calibration(cameras, placed(path, str(master), poses))


def opencv_lens(size: tuple[int, int], matrix: Any, coefficients: Any, where: str) -> Intrinsics:
    """Make a lens of ``size`` (width, height) from a matrix (3, 3) and 4, 5 or 8 coefficients.

    Its metric radius ends where the distortion turns back, so that nothing outside the view is
    projected into the image. Raises UserError, beginning with ``where``, for what is no lens.
    """
    k, d = numbers_of(matrix, where, "camera_matrix"), numbers_of(coefficients, where, "distortion")
    d = d.ravel()
    if d.size not in COEFFICIENTS:
        more = (
            "; thin prism and tilt are not supported: calibrate with CALIB_RATIONAL_MODEL alone"
            if d.size in (12, 14)
            else ""
        )
        raise UserError(
            f"{where}: distortion_coefficients has {d.size} numbers, expected 4, 5 or 8{more}"
        )
    plain = k.shape == (3, 3) and k[0, 1] == 0 and k[1, 0] == 0 and (k[2] == [0, 0, 1]).all()
    if not plain or min(k[0, 0], k[1, 1]) <= 0:
        raise UserError(
            f"{where}: camera_matrix is no [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels; "
            "correct it"
        )
    if (np.abs(k[:2, 2] / size - 0.5) > MAX_OFF_CENTRE).any():
        raise UserError(
            f"{where}: the principal point {k[0, 2]:.0f}, {k[1, 2]:.0f} is that of images of about "
            f"{2 * k[0, 2]:.0f}x{2 * k[1, 2]:.0f}, image_size is {size[0]}x{size[1]}; give the "
            "calibration of this resolution"
        )
    distortion = np.concatenate([d, np.zeros(8 - d.size)])
    arguments = (*size, k[0, 0], k[1, 1], k[0, 2], k[1, 2], distortion)
    turn = turning_radius(distortion)
    corners = np.array([[0, 0], [size[0], 0], [0, size[1]], size]) - 0.5
    widest = np.linalg.norm(Intrinsics(*arguments, turn).unproject(corners)[:, :2], axis=1).max()
    radius = min(turn, max(1.1 * float(widest), DEFAULT_METRIC_RADIUS))
    return check_lens(Intrinsics(*arguments, radius), where)


def turning_radius(distortion: np.ndarray) -> float:
    """Return the radius up to which a point farther out is also imaged farther out.

    ``distortion`` (8,). The radial part of OpenCV's model, r d(r^2), must grow and stay finite;
    5 where it does so over all of 80 degrees.
    """
    radius = np.linspace(0, 5, 50001)
    lens = np.concatenate([(1, 1, 0, 0), distortion, (np.inf,)])
    above, below = radial_fraction(radius * radius, lens)
    with np.errstate(divide="ignore", invalid="ignore"):
        image = radius * above / below
    bad = np.flatnonzero((np.diff(image) <= 0) | (below[1:] <= 0) | ~np.isfinite(image[1:]))
    return float(radius[max(1, bad[0])] if len(bad) else radius[-1])


def _camera(entry: dict[str, Any], where: str, fps: float | None) -> CalibratedCamera:
    colour = _lens(entry, where)
    offset = numbers_of(entry.get("time_offset", 0.0), where, "time_offset")
    if offset.size != 1:
        raise UserError(
            f"{where}: time_offset is {quoted(offset.tolist())}, expected seconds; correct it"
        )
    if abs(offset.ravel()[0]) > LONGEST_OFFSET_S:
        raise UserError(
            f"{where}: time_offset is {offset.ravel()[0]:.4g}, expected seconds; correct it"
        )
    depth = entry.get("depth")
    lens, between = None, None
    if depth == ALIGNED:
        lens, between = colour, np.eye(4)
    elif isinstance(depth, dict):
        lens = _lens(depth, f"{where}, depth")
        between = numbers_of(depth.get("colour_from_depth"), where, "depth.colour_from_depth")
        if not is_rigid(between):
            raise UserError(
                f"{where}: depth.colour_from_depth is no rigid 4x4 transform (x_colour = R x_depth "
                "+ t, metres, last row 0 0 0 1); correct it"
            )
        apart = float(np.linalg.norm(between[:3, 3]))
        if apart > MAX_LENSES_APART_M:
            raise UserError(
                f"{where}: depth.colour_from_depth moves by {apart:.4g} m, expected at most "
                f"{MAX_LENSES_APART_M:.0f} m, so it is likely in millimetres; write it in metres"
            )
    elif depth is not None:
        raise UserError(
            f"{where}: depth is {quoted(depth, 40)}, expected {ALIGNED!r} or a lens with "
            "colour_from_depth; correct it"
        )
    own = _rate(entry, "fps", where)
    return CalibratedCamera(colour, lens, between, own or fps, float(offset.ravel()[0]))


def image_size_of(size: Any, where: str) -> tuple[int, int]:
    """Width and height in whole pixels; raises UserError, beginning with ``where``, otherwise."""
    numbers = numbers_of(size, where, "image_size").ravel()
    if (
        numbers.size != 2
        or (numbers < 1).any()
        or ((numbers != numbers.round()) | (numbers > MAX_SIDE)).any()
    ):
        raise UserError(
            f"{where}: image_size is {quoted(size)}, expected width and height in pixels"
        )
    return int(numbers[0]), int(numbers[1])


def _lens(entry: dict[str, Any], where: str) -> Intrinsics:
    for key in ("camera_matrix", "distortion_coefficients"):
        if key not in entry:
            raise UserError(f"{where}: has no {key}; add it")
    size = entry.get("image_size", [entry.get("image_width"), entry.get("image_height")])
    return opencv_lens(
        image_size_of(size, where), entry["camera_matrix"], entry["distortion_coefficients"], where
    )


def _pose(entry: dict[str, Any], where: str, path: Path, *, is_master: bool) -> np.ndarray:
    """World from camera (4, 4)."""
    turn, shift = (entry.get(a, entry.get(b)) for a, b in (("R", "rvec"), ("T", "tvec")))
    if turn is None and shift is None and is_master:
        return np.eye(4)
    if turn is None or shift is None:
        raise UserError(
            f"{where}: has no pose; add R (3x3, or a rotation vector) and T with x_camera = R "
            "x_world + T, metres"
        )
    camera_from_world = opencv_pose(turn, shift, where)
    check_distance(path, f"camera {where.rpartition(' ')[2]}", camera_from_world[:3, 3])
    return invert(camera_from_world)


def opencv_pose(turn: Any, shift: Any, where: str) -> np.ndarray:
    """Camera from world (4, 4) of a rotation, a matrix (3, 3) or vector (3,), and a translation.

    Raises UserError, beginning with ``where``, for what is none.
    """
    r, t = numbers_of(turn, where, "R"), numbers_of(shift, where, "T").ravel()
    r = Rotation.from_rotvec(r.ravel()).as_matrix() if r.size == 3 else r
    if t.size != 3 or r.shape != (3, 3) or not is_rigid(rigid(r, t)):
        raise UserError(
            f"{where}: R is no rotation (3x3, or a vector of 3) or T no vector of 3; correct it"
        )
    return rigid(r, t)


def _rate(entry: dict[str, Any], field: str, where: str) -> float | None:
    value = entry.get(field)
    if value is None:
        return None
    number = numbers_of(value, where, field)
    if number.size != 1 or number.ravel()[0] <= 0:
        raise UserError(f"{where}: {field} is {quoted(value)}, expected one positive number")
    check_rate(float(number.ravel()[0]), where)
    return float(number.ravel()[0])


_MATRIX_TYPES = ("opencv-matrix", "opencv-nd-matrix")  # OpenCV 5 writes vectors as the latter
_MATRIX_TAGS = [f"tag:yaml.org,2002:{name}" for name in _MATRIX_TYPES]


class _Loader(yaml_files.Loader):
    """The safe loader, which also knows OpenCV's matrices."""

    kinds = yaml_files.KINDS | dict.fromkeys(_MATRIX_TAGS, yaml.MappingNode)


def _matrix(entry: dict[Any, Any]) -> Any:
    """Nested lists of an array as ``cv2.FileStorage`` writes it."""
    try:
        shape = entry["sizes"] if "sizes" in entry else (entry["rows"], entry["cols"])
        return np.array(entry["data"], np.float64).reshape(shape).tolist()
    except (KeyError, TypeError, ValueError, OverflowError):
        return None


def _yaml_matrix(loader: yaml.SafeLoader, node: Any) -> Any:
    return _matrix(loader.construct_mapping(node, deep=True))


for _tag in _MATRIX_TAGS:
    _Loader.add_constructor(_tag, _yaml_matrix)


def _json_object(entry: dict[str, Any]) -> Any:
    return _matrix(entry) if entry.get("type_id") in _MATRIX_TYPES else entry


def load_opencv(path: Path) -> dict[str, Any]:
    """Read a JSON or YAML file, by hand or of ``cv2.FileStorage``: matrices become nested lists.

    Raises UserError where it is none, or holds no names and values.
    """
    try:
        if path.suffix.lower() == ".json":
            content = read_json(path, entry=_json_object)
        else:  # OpenCV's first line, %YAML:1.0, is none of YAML's own
            content = yaml_files.read_yaml(
                path,
                MAX_CALIBRATION_BYTES,
                loader=_Loader,
                prepared=lambda text: text.removeprefix("%YAML:1.0"),
            )
    except Unreadable as error:
        reason = re.sub("(is )?not valid (JSON|YAML)", "is not valid JSON or YAML", error.reason)
        raise UserError(f"{path}: {reason}; correct it") from None
    if not isinstance(content, dict):
        raise UserError(f"{path}: expected names and values, found {type(content).__name__}")
    return content
