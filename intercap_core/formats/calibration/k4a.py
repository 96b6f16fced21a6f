"""Lenses of Azure Kinects from their calibration JSON, for every colour and depth mode.

Lenses in the JSON are normalised. Multiplied by the size of the binned sensor (4:3 for colour,
square for depth), they are in pixels with (0, 0) at the *corner* of the first pixel. Each mode then
crops. Sizes and crops are those of the Azure Kinect Sensor SDK (MIT), ``src/transformation``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.calibration.lens_checks import MIN_METRIC_RADIUS, find_lens_fault
from intercap_core.formats.calibration.opencv import (
    MAX_LENSES_APART_M,
)
from intercap_core.geometry.camera.intrinsics import DEFAULT_METRIC_RADIUS, Intrinsics
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import invert, is_rigid, rigid
from intercap_core.inputs.documents import parse_json
from intercap_core.inputs.files import quoted

# Names in the JSON.
DEPTH_LOCATION = "CALIBRATION_CameraLocationD0"
COLOUR_LOCATION = "CALIBRATION_CameraLocationPV0"
LENS_MODEL = "CALIBRATION_LensDistortionModelBrownConrady"
ACCELEROMETER = "CALIBRATION_InertialSensorType_Accelerometer"


@dataclass(frozen=True)
class Mode:
    """How the image of a mode is cut from the binned sensor. Pairs are x and y, pixels."""

    binned: tuple[int, int]
    """Size of the binned sensor."""
    crop: tuple[int, int]
    """Columns and rows that are cut off at the left and at the top."""
    size: tuple[int, int]
    """Size of the image."""


COLOUR_MODES = {
    "720P": Mode((1280, 960), (0, 120), (1280, 720)),
    "1080P": Mode((1920, 1440), (0, 180), (1920, 1080)),
    "1440P": Mode((2560, 1920), (0, 240), (2560, 1440)),
    "1536P": Mode((2048, 1536), (0, 0), (2048, 1536)),
    "2160P": Mode((3840, 2880), (0, 360), (3840, 2160)),
    "3072P": Mode((4096, 3072), (0, 0), (4096, 3072)),
}
DEPTH_MODES = {
    "NFOV_2X2BINNED": Mode((512, 512), (96, 90), (320, 288)),
    "NFOV_UNBINNED": Mode((1024, 1024), (192, 180), (640, 576)),
    "WFOV_2X2BINNED": Mode((512, 512), (0, 0), (512, 512)),
    "WFOV_UNBINNED": Mode((1024, 1024), (0, 0), (1024, 1024)),
}
# Positions of k1, k2, p1, p2, k3, k4, k5, k6 among the ModelParameters of the JSON that an Azure
# Kinect stores. Their order is cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, codx, cody, p2, p1.
DISTORTION_POSITIONS = (4, 5, 13, 12, 6, 7, 8, 9)


def make_lens(entry: dict[str, Any], mode: Mode) -> Intrinsics:
    """Make the lens of one camera entry of the JSON in ``mode``.

    Raises ValueError, KeyError or TypeError if the entry is not as the SDK writes it, and
    ValueError for a lens that no camera has.
    """
    intrinsics = entry["Intrinsics"]
    if intrinsics["ModelType"] != LENS_MODEL:
        raise ValueError(
            f"its lens model is {quoted(intrinsics['ModelType'])}, expected {LENS_MODEL!r}"
        )
    values = np.array(intrinsics["ModelParameters"], np.float64)
    if values.ndim != 1 or len(values) < 14 or not np.all(np.isfinite(values)):
        raise ValueError(f"its lens has {values.size} parameters, expected 14 finite numbers")
    if np.any(values[10:12] != 0):
        raise ValueError("its centre of distortion (codx, cody) is not 0, which is not supported")
    (binned_w, binned_h), (crop_x, crop_y) = mode.binned, mode.crop
    radius = float(entry.get("MetricRadius", 0.0))
    # The negated comparison keeps a radius of NaN, which find_lens_fault rejects below.
    lens = Intrinsics(
        *mode.size,
        fx=values[2] * binned_w,
        fy=values[3] * binned_h,
        cx=values[0] * binned_w - crop_x - 0.5,
        cy=values[1] * binned_h - crop_y - 0.5,
        distortion=values[list(DISTORTION_POSITIONS)],
        metric_radius=radius if not radius <= MIN_METRIC_RADIUS else DEFAULT_METRIC_RADIUS,
    )
    fault = find_lens_fault(lens)
    if fault is not None:
        raise ValueError(fault)
    return lens


def _pose_of(entry: dict[str, Any]) -> np.ndarray:
    """Return sensor_from_reference (4, 4), metres, of one sensor's entry."""
    rt = entry["Rt"]
    rotation = np.array(rt["Rotation"], np.float64).reshape(3, 3)
    translation = np.array(rt["Translation"], np.float64)
    if translation.shape != (3,) or not is_rigid(pose := rigid(rotation, translation), 1e-3):
        raise ValueError("its Rt is not a rigid transform")
    if np.linalg.norm(translation) > MAX_LENSES_APART_M:
        raise ValueError(
            f"its Rt moves a sensor by {np.linalg.norm(translation):.4g} m, expected at most "
            f"{MAX_LENSES_APART_M:g} m within one device"
        )
    return pose


def parse_camera(
    content: bytes,
    *,
    colour_mode: str,
    depth_mode: str | None,
    name: str,
    source: str,
    master_from_colour: np.ndarray | None = None,
) -> Camera:
    """Make a :class:`Camera` of a calibration JSON as Azure Kinect recordings hold it.

    Raises UserError naming ``source`` if the JSON is broken.

    Args:
        content: the JSON.
        colour_mode: key of ``COLOUR_MODES``.
        depth_mode: key of ``DEPTH_MODES``; None for a recording without depth.
        name: name of the camera.
        source: the recording, for messages.
        master_from_colour: pose (4, 4), metres; None = the identity.
    """
    pose = np.eye(4) if master_from_colour is None else master_from_colour
    try:
        cameras = _sensors(content, "Cameras", "Location")
        colour = make_lens(cameras[COLOUR_LOCATION], COLOUR_MODES[colour_mode])
        if depth_mode is None:
            return Camera(name, colour, None, None, pose)
        depth = make_lens(cameras[DEPTH_LOCATION], DEPTH_MODES[depth_mode])
        colour_from_depth = _pose_of(cameras[COLOUR_LOCATION]) @ invert(
            _pose_of(cameras[DEPTH_LOCATION])
        )
    except (ValueError, KeyError, TypeError) as error:
        raise _broken(source, error) from error
    return Camera(name, colour, depth, colour_from_depth, pose)


def colour_from_accelerometer(content: bytes, *, source: str) -> np.ndarray | None:
    """Rotation (3, 3) from the accelerometer to the colour camera; None without an accelerometer.

    Raises UserError naming ``source`` if the JSON is broken.
    """
    try:
        sensors = _sensors(content, "InertialSensors", "SensorType")
        if ACCELEROMETER not in sensors:
            return None
        colour = _pose_of(_sensors(content, "Cameras", "Location")[COLOUR_LOCATION])
        return colour[:3, :3] @ _pose_of(sensors[ACCELEROMETER])[:3, :3].T
    except (ValueError, KeyError, TypeError) as error:
        raise _broken(source, error) from error


def _sensors(content: bytes, group: str, key: str) -> dict[str, dict[str, Any]]:
    """Entries of the JSON's list ``group``, by the value of their field ``key``."""
    # Some firmware pads the JSON with zero bytes.
    parsed = parse_json(content.rstrip(b"\0").decode("utf-8"))
    information = parsed["CalibrationInformation"]
    if not isinstance(information, dict):
        raise ValueError(f"CalibrationInformation is {quoted(information, 40)}, expected an object")
    entries = {entry[key]: entry for entry in information.get(group, [])}
    if not all(isinstance(entry, dict) for entry in entries.values()):
        raise ValueError(f"{group} lists an entry that is no sensor")
    return entries


def _broken(source: str, error: Exception) -> UserError:
    reason = f"lacks {error}" if isinstance(error, KeyError) else str(error)[:400]
    return UserError(
        f"{source}: the Azure Kinect calibration cannot be used ({reason}); take the recording "
        "again, or put back the calibration.json of the same device"
    )
