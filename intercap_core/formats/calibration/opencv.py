"""Calibration files in OpenCV's terms, and the checks of every lens that a file states.

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
    relate_to_master,
    rotation_matrix,
)
from intercap_core.geometry.camera.intrinsics import DEFAULT_METRIC_RADIUS, Intrinsics
from intercap_core.geometry.camera.projection import radial_fraction
from intercap_core.geometry.camera.transforms import invert, is_rigid, rigid
from intercap_core.inputs.documents import YamlLoader, read_json, read_yaml
from intercap_core.inputs.files import UnreadableFile, parse_numbers, quoted

MIN_METRIC_RADIUS = 1e-4  # the Azure Kinect Sensor SDK takes a smaller radius as "not stated"
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


def check_resolution(centre: np.ndarray, size: tuple[int, int], most: float, where: str) -> None:
    """Raise UserError if a principal point (2,), px, is too far from the image's middle.

    The calibration is then of another resolution. ``most`` is the largest distance allowed, as a
    share of the image's width or height. Cameras have up to about 0.03.
    """
    if (np.abs(centre / size - 0.5) > most).any():
        x, y = centre
        raise UserError(
            f"{where}: the principal point {x:.0f}, {y:.0f} is that of images of about "
            f"{2 * x:.0f}x{2 * y:.0f}, the images have {size[0]}x{size[1]}; give the calibration "
            "of this resolution"
        )


def pad_distortion(coefficients: np.ndarray) -> np.ndarray:
    """Distortion (8,) of 4, 5 or 8 coefficients; raises ValueError for another number."""
    if coefficients.shape not in ((4,), (5,), (8,)):
        raise ValueError(f"{coefficients.size} coefficients, expected 4, 5 or 8")
    return np.concatenate([coefficients, np.zeros(8 - coefficients.size)])


def turning_radius(distortion: np.ndarray) -> float:
    """Radius in the normalised image plane up to which the distorted radius increases.

    The result is at most 5, which is 79 degrees off the axis. ``distortion`` has the shape (8,).
    """
    radius = np.linspace(0, 5, 50001)
    bad = np.flatnonzero(~_distort_radius(radius, distortion)[1])
    return float(radius[max(1, bad[0])] if len(bad) else radius[-1])


def _distort_radius(radius: np.ndarray, distortion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Apply the radial part of OpenCV's model, r d(r^2), to increasing radii (N,).

    Returns the distorted radii (N,), and for each interval (N - 1,) whether they grow and stay
    finite.
    """
    # A lens as radial_fraction takes it: fx, fy, cx, cy, distortion, metric radius.
    lens = np.concatenate([(1, 1, 0, 0), distortion, (np.inf,)])
    with np.errstate(all="ignore"):
        above, below = radial_fraction(radius * radius, lens)
        image = radius * above / below
        grows = (np.diff(image) > 0) & (below[1:] > 0) & np.isfinite(image[1:])
    return image, grows


def check_lens(lens: Intrinsics, where: str) -> Intrinsics:
    """Return the lens; raises UserError, beginning with ``where``, if no camera has such a lens."""
    fault = find_lens_fault(lens)
    if fault is not None:
        raise UserError(f"{where}: {fault}; calibrate again, or give this camera's own calibration")
    return lens


def find_lens_fault(lens: Intrinsics) -> str | None:
    """Why the lens is impossible, for a message; None if it is possible."""
    if not np.isfinite(lens.parameters).all():
        return "the lens has a value that is not a finite number"
    # A focal length of 0.2 sides sees 136 degrees, about the limit of a pinhole with distortion
    # (the wide depth mode of the Azure Kinect has 0.49). 20 sides see 3 degrees, like an 800 mm
    # lens on a full-frame sensor.
    side = max(lens.width, lens.height)
    low, high = 0.2 * side, 20.0 * side
    for name, focal in (("fx", lens.fx), ("fy", lens.fy)):
        if not low <= focal <= high:
            return (
                f"{name} is {focal:.4g} px, expected {low:.0f} to {high:.0f} for images of "
                f"{lens.width}x{lens.height}"
            )
    if not 0.5 <= lens.fx / lens.fy <= 2.0:  # anamorphic lenses squeeze by 2
        return f"fx {lens.fx:.4g} and fy {lens.fy:.4g} differ by more than 2 times"
    for name, centre, size in (("cx", lens.cx, lens.width), ("cy", lens.cy, lens.height)):
        if not -size <= centre <= 2 * size:  # outside only if the image is cropped
            return f"{name} is {centre:.4g} px, far outside the image's {size}"
    largest = 10.0  # at 84 degrees; the Azure Kinect's is 1.7
    if not MIN_METRIC_RADIUS <= lens.metric_radius <= largest:
        return (
            f"its metric radius is {lens.metric_radius:.4g}, expected {MIN_METRIC_RADIUS:g} to "
            f"{largest:g}"
        )
    return _distortion_fault(lens)


def _distortion_fault(lens: Intrinsics) -> str | None:
    """Why the distortion is impossible; None if it is possible.

    The distorted radius must increase up to a quarter of the shorter side from the centre;
    otherwise the coefficients are in another order or of another lens. Within half of the shorter
    side, the scale and the tangential shift are limited.
    """
    focal = min(lens.fx, lens.fy)
    edge = min(lens.width, lens.height) / 2 / focal  # radius of the normalised image plane
    distortion = np.asarray(lens.distortion, np.float64)
    radius = np.concatenate([[0], np.geomspace(1e-6, 1e-2, 200), np.linspace(0.01, 5, 4992)[1:]])
    image, grows = _distort_radius(radius, distortion)
    turn = int(np.argmin(grows)) if not grows.all() else len(grows)
    covered = float(image[turn]) if np.isfinite(image[turn]) else 0.0
    shown = np.array2string(distortion, precision=4, max_line_width=200)
    if covered < 0.5 * edge:
        return (
            f"the distortion {shown} turns back {covered * focal:.0f} px from the centre of images "
            f"of {lens.width}x{lens.height}"
        )
    inside = image[: turn + 1] <= edge
    slope = np.diff(image[: turn + 1]) / np.diff(radius[: turn + 1])
    steepest = float(slope[inside[:-1]].max(initial=1.0))
    if steepest > 4:  # measured lenses: a quarter to 2 (130 degrees of a GoPro: 0.3 at the corner)
        return (
            f"the distortion {shown} scales the image's edge {steepest:.3g} times its centre, "
            "expected at most 4"
        )
    # p (r^2 + 2 x^2) is at most 3 p r^2, divided by r.
    tangential = 3 * float(np.abs(distortion[2:4]).max()) * min(edge, radius[turn])
    if tangential > 0.5:  # of the image's radius; a lens that is mounted askew has 0.01
        return f"the tangential distortion {shown} moves the image's edge by {tangential:.0%}"
    return None


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


def opencv_pose(rotation: Any, translation: Any, where: str) -> np.ndarray:
    """Camera from world (4, 4) of a rotation and a translation (3,).

    The rotation is a matrix (3, 3) or a rotation vector (3,).

    Raises UserError, beginning with ``where``, for numbers that are no pose.
    """
    r, t = parse_numbers(rotation, where, "R"), parse_numbers(translation, where, "T").ravel()
    r = rotation_matrix(where, r.ravel()) if r.size == 3 else r
    if t.size != 3 or r.shape != (3, 3) or not is_rigid(rigid(r, t)):
        raise UserError(
            f"{where}: R is no rotation (3x3, or a vector of 3) or T no vector of 3; correct it"
        )
    return rigid(r, t)


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
    camera_from_world = opencv_pose(rotation, translation, where)
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
