"""Calibrations of COLMAP: a folder with ``cameras`` and ``images``, both ``.bin`` or both ``.txt``.

Poses are x_camera = R x_world + T with OpenCV's axes; R is a quaternion w x y z. The unit of length
is arbitrary. COLMAP's centre of the first pixel is (0.5, 0.5); in this package it is (0, 0).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.calibration.files import (
    CalibrationReader,
    RecordedCameras,
    group_images_by_camera,
    to_calibration,
)
from intercap_core.formats.calibration.opencv import MAX_SIDE, Calibration, opencv_lens
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.inputs.documents import parse_integer
from intercap_core.inputs.files import (
    MAX_FILE_BYTES,
    decode_text,
    printable,
    quoted,
    read_bytes,
    read_text,
)


class LensModel(NamedTuple):
    """A camera model of COLMAP (src/colmap/sensor/models.h)."""

    name: str
    parameters: int
    """How many parameters it has."""
    matrix: tuple[int, int, int, int]
    """Positions of fx, fy, cx, cy among the parameters."""
    distortion: tuple[int, ...]
    """Positions of OpenCV's coefficients k1, k2, p1, p2, k3, ... among the parameters."""


# By COLMAP's number of the model.
MODELS = {
    0: LensModel("SIMPLE_PINHOLE", 3, (0, 0, 1, 2), ()),
    1: LensModel("PINHOLE", 4, (0, 1, 2, 3), ()),
    2: LensModel("SIMPLE_RADIAL", 4, (0, 0, 1, 2), (3,)),
    3: LensModel("RADIAL", 5, (0, 0, 1, 2), (3, 4)),
    4: LensModel("OPENCV", 8, (0, 1, 2, 3), (4, 5, 6, 7)),
    6: LensModel("FULL_OPENCV", 12, (0, 1, 2, 3), (4, 5, 6, 7, 8, 9, 10, 11)),
}
# Models whose distortion cannot be converted to OpenCV's rational model.
UNSUPPORTED = {
    5: "OPENCV_FISHEYE", 7: "FOV", 8: "SIMPLE_RADIAL_FISHEYE", 9: "RADIAL_FISHEYE",
    10: "THIN_PRISM_FISHEYE", 11: "RAD_TAN_THIN_PRISM_FISHEYE",
}  # fmt: skip
NUMBERS = {model.name: number for number, model in MODELS.items()}


class _Image(NamedTuple):
    """One image of the model: quaternion and translation (7 numbers), camera's number, path."""

    pose: list[float]
    camera: int
    name: str


def _suffix(folder: Path) -> str | None:
    """Suffix of the model's files; None = no model. Binary files go first, as in COLMAP itself."""
    for suffix in (".bin", ".txt"):
        if all((folder / f"{name}{suffix}").is_file() for name in ("cameras", "images")):
            return suffix
    return None


def _read(folder: Path, recorded: RecordedCameras, scale: float | None) -> Calibration:
    """Read a sparse model; raises UserError naming file, camera or image."""
    suffix = _suffix(folder)
    lenses_file, images_file = folder / f"cameras{suffix}", folder / f"images{suffix}"
    if suffix == ".bin":
        lenses = dict(_binary_lenses(_Bytes(lenses_file), lenses_file))
        images = list(_binary_images(_Bytes(images_file)))
    else:
        lenses = dict(_text_lenses(lenses_file))
        images = list(_text_images(images_file))
    posed = []
    for image in images:
        if image.camera not in lenses:
            raise UserError(
                f"{images_file}: image {quoted(image.name)} is of camera {image.camera}, which "
                f"{lenses_file.name} does not have; export the model again"
            )
        posed.append((image.name, lenses[image.camera], _pose(image, images_file)))
    cameras = group_images_by_camera(folder, posed, recorded, scale=scale)
    unit = "its reconstruction is known but for its size"
    return to_calibration(
        folder, "COLMAP", cameras, recorded, scale=scale, unit=unit, as_stored=True
    )


READER = CalibrationReader(
    tool="COLMAP",
    rank=1,
    recognises=lambda path: _suffix(path) is not None,
    read=_read,
    parts=("cameras.txt", "images.txt", "cameras.bin", "images.bin"),
)


def _pose(image: _Image, path: Path) -> np.ndarray:
    """Camera from world (4, 4), in the model's unit of length."""
    quaternion, translation = np.split(np.array(image.pose), [4])
    if not np.isfinite(image.pose).all() or abs(np.linalg.norm(quaternion) - 1) > 0.01:
        raise UserError(
            f"{path}: image {quoted(image.name)} has no unit quaternion and translation; export "
            "the model again"
        )
    from scipy.spatial.transform import Rotation  # slow import; all readers are imported

    return rigid(Rotation.from_quat(quaternion, scalar_first=True).as_matrix(), translation)


def _lens(number: int, size: tuple[int, int], values: list[float], where: str) -> Intrinsics:
    """The lens of model ``number`` from its parameters ``values``; ``where`` begins messages."""
    model = MODELS[number]
    if len(values) != model.parameters:
        raise UserError(
            f"{where}: model {model.name} has {len(values)} parameters, expected "
            f"{model.parameters}; export the model again"
        )
    fx, fy, cx, cy = (values[at] for at in model.matrix)
    matrix = [[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]]
    distortion = [values[at] for at in model.distortion]
    if not all(0 < n <= MAX_SIDE for n in size):
        raise UserError(f"{where}: images of {size[0]}x{size[1]} pixels; export the model again")
    return opencv_lens(size, matrix, distortion + [0.0] * max(0, 4 - len(distortion)), where)


def _unsupported(model: str, where: str) -> UserError:
    return UserError(
        f"{where}: model {model} cannot be represented, expected {', '.join(NUMBERS)}; undistort "
        "the recordings (colmap image_undistorter), or reconstruct with one of these models"
    )


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    text = read_text(path, MAX_FILE_BYTES, advice="export the model again")
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.lstrip().startswith("#"):
            yield number, line.strip()


def _text_lenses(path: Path) -> Iterator[tuple[int, Intrinsics]]:
    """Yield number and lens of each camera: CAMERA_ID MODEL WIDTH HEIGHT and parameters."""
    for number, line in _lines(path):
        if not line:
            continue
        where = f"{path}, line {number}"
        try:
            identity, model, width, height, *rest = line.split()
            camera, size = parse_integer(identity), (parse_integer(width), parse_integer(height))
            values = [float(word) for word in rest]
        except ValueError:
            raise UserError(
                f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT and parameters; export the model "
                "again"
            ) from None
        if model not in NUMBERS:
            raise _unsupported(printable(model[:40]), where)
        yield camera, _lens(NUMBERS[model], size, values, where)


def _text_images(path: Path) -> Iterator[_Image]:
    """Yield the images. Each has a line of pose, camera and name, and a line of points."""
    lines = _lines(path)
    for number, line in lines:
        if not line:
            continue
        try:
            _, *numbers, camera, name = line.split(maxsplit=9)
            values = [float(word) for word in numbers]
            identity = parse_integer(camera)
        except ValueError:
            values = []
        if len(values) != 7:
            raise UserError(
                f"{path}, line {number}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME; "
                "export the model again"
            )
        yield _Image(values, identity, name)
        next(lines, None)  # the line of the image's points, which may be empty


class _Bytes:
    """A little-endian file, read from its start; raises UserError if the file ends too early."""

    def __init__(self, path: Path) -> None:
        self._path, self._at = path, 0
        self._content = read_bytes(path, advice="export the model again")

    def take(self, form: str) -> tuple[Any, ...]:
        """Read the next values; ``form`` is a format of :mod:`struct` without byte order."""
        return struct.unpack("<" + form, self.skip(struct.calcsize("<" + form)))

    def skip(self, size: int) -> bytes:
        """Read the next ``size`` bytes."""
        first, self._at = self._at, self._at + size
        if self._at > len(self._content):
            raise UserError(f"{self._path}: is cut off; copy or export it again")
        return self._content[first : self._at]

    def name(self) -> str:
        """Read a text that ends with a zero byte."""
        end = self._content.find(b"\0", self._at, self._at + 4096)  # paths are shorter
        if end < 0:
            raise UserError(f"{self._path}: an image has no name; copy or export it again")
        name = decode_text(self._path, self._content[self._at : end])
        self._at = end + 1
        return name


def _binary_lenses(content: _Bytes, path: Path) -> Iterator[tuple[int, Intrinsics]]:
    """Yield number and lens of each camera: numbers of camera and model, size, parameters."""
    for _ in range(content.take("Q")[0]):
        camera, model, width, height = content.take("iiQQ")
        where = f"{path}: camera {camera}"
        if model not in MODELS:
            raise _unsupported(UNSUPPORTED.get(model, f"number {model}"), where)
        values = list(content.take(f"{MODELS[model].parameters}d"))
        yield camera, _lens(model, (width, height), values, where)


def _binary_images(content: _Bytes) -> Iterator[_Image]:
    """Yield the images: number, pose, camera, name and points, which are skipped."""
    for _ in range(content.take("Q")[0]):
        _, *values, camera = content.take("i7di")
        name = content.name()
        content.skip(24 * content.take("Q")[0])  # points: x, y and an identity, 8 bytes each
        yield _Image(values, camera, name)
