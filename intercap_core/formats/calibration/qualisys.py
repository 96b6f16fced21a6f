"""Calibrations of Qualisys Track Manager (``*.qca.txt``), which Pose2Sim converts: XML.

A camera has ``transform``: its centre in millimetres and, in rows, the axes x, y, z of a camera
that looks along -z with y up; and ``intrinsic``: focal lengths and principal point in 1/64 pixels
of the sensor, of which ``fov_video`` is recorded. The coefficients of distortion are OpenCV's k1,
k2, p1, p2: they agree with those that OpenCV finds for the cameras of Pose2Sim's demonstration
(k1 -0.046 and -0.053, k2 0.140 and 0.151). Pose2Sim divides them by 64.
"""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.calibration.extrinsics import parse_pose
from intercap_core.formats.calibration.files import (
    CalibrationReader,
    RecordedCameras,
    ToolCamera,
    only_file,
    refuse_scale,
    to_calibration,
)
from intercap_core.formats.calibration.opencv import (
    Calibration,
    opencv_lens,
    parse_image_size,
)
from intercap_core.inputs.files import (
    MAX_TEXT_BYTES,
    UnreadableFile,
    printable,
    quoted,
    read_bytes,
)

STEPS_PER_PIXEL = 64


def _qca_files(path: Path) -> list[Path]:
    if path.is_dir():
        return sorted(path.glob("[!.]*.qca.txt"))
    return [path] if path.name.lower().endswith(".qca.txt") else []


def _read(path: Path, recorded: RecordedCameras, scale: float | None) -> Calibration:
    """Read a file, or the only one of a folder; raises UserError naming camera and field."""
    path = only_file(path, _qca_files(path))
    refuse_scale(path, scale)
    cameras = [
        _camera(path, element)
        for element in _parse(path).iterfind("cameras/camera")
        # The others record markers alone.
        if any(kind in element.get("model", "none").lower() for kind in ("video", "none"))
    ]
    return to_calibration(path, "Qualisys", cameras, recorded, scale=None, unit=None)


def _parse(path: Path) -> ElementTree.Element:
    try:
        content = read_bytes(path, MAX_TEXT_BYTES)
        # Without the zeros of UTF-16. Comments and CDATA also begin with "<!".
        if re.search(rb"<!\s*(DOCTYPE|ENTITY)", content.replace(b"\0", b"")):
            raise UserError(f"{path}: declares a document type or entities; remove them")
        return ElementTree.fromstring(content)
    except UnreadableFile as error:
        raise UserError(f"{path}: {error.reason}; export the calibration again") from None
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise UserError(
            f"{path}: is no XML ({printable(str(error))[:200]}); export the calibration again"
        ) from None


def _camera(path: Path, element: ElementTree.Element) -> ToolCamera:
    name = element.get("serial", "")
    where = f"{path}: camera {quoted(name)}"

    def numbers(tag: str, *keys: str) -> np.ndarray:
        part = element.find(tag)
        values = [None if part is None else part.get(key) for key in keys]
        try:
            return np.array([float(value or "") for value in values])
        except ValueError:
            raise UserError(
                f"{where}: {tag} has {quoted(values)} as {', '.join(keys)}, expected numbers; "
                "export the calibration again"
            ) from None

    left, top, right, bottom = numbers("fov_video", "left", "top", "right", "bottom")
    size = parse_image_size([right - left + 1, bottom - top + 1], where)
    fx, fy, cx, cy = STEPS_PER_PIXEL**-1 * numbers(
        "intrinsic", "focalLengthU", "focalLengthV", "centerPointU", "centerPointV"
    )
    distortion = numbers(
        "intrinsic", "radialDistortion1", "radialDistortion2", "tangentalDistortion1",
        "tangentalDistortion2",
    )  # fmt: skip
    matrix = np.array([[fx, 0, cx - left], [0, fy, cy - top], [0, 0, 1]])
    axes = numbers("transform", *(f"r{row}{column}" for row in "123" for column in "123"))
    turn = np.diag([1.0, -1.0, -1.0]) @ axes.reshape(3, 3)  # to OpenCV's axes
    centre = 1e-3 * numbers("transform", "x", "y", "z")
    pose = parse_pose(turn, -turn @ centre, where)
    return ToolCamera((name,), opencv_lens(size, matrix, distortion, where), pose)


READER = CalibrationReader(
    tool="Qualisys", rank=4, recognises=lambda path: bool(_qca_files(path)), read=_read
)
