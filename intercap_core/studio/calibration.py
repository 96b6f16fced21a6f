"""Azure Kinect calibration JSON of a camera: the inverse of :mod:`formats.calibration.k4a`."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from intercap_core.formats.calibration.k4a import (
    ACCELEROMETER,
    COLOUR_LOCATION,
    COLOUR_MODES,
    DEPTH_LOCATION,
    DEPTH_MODES,
    DISTORTION_POSITIONS,
    LENS_MODEL,
    Mode,
)
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera

# Rotation from the depth camera's to the accelerometer's axes, as in real devices but without their
# 6 degrees of tilt: its x is the camera's -z, its y the camera's -x, its z the camera's y (down).
ACCELEROMETER_FROM_DEPTH = np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])
GYROSCOPE = "CALIBRATION_InertialSensorType_Gyro"


def write_calibration(camera: Camera, *, colour_mode: str, depth_mode: str, serial: str) -> bytes:
    """Return the calibration JSON of ``camera`` as its device would hold it.

    Raises ValueError if the camera has no depth, or a lens has another image size than its mode.
    """
    if camera.depth is None or camera.colour_from_depth is None:
        raise ValueError(f"camera {camera.name} has no depth")
    identity = np.eye(4)
    cameras = [
        _lens(camera.depth, DEPTH_MODES[depth_mode], DEPTH_LOCATION, identity, (1024, 1024)),
        _lens(
            camera.colour,
            COLOUR_MODES[colour_mode],
            COLOUR_LOCATION,
            camera.colour_from_depth,
            (4096, 3072),
        ),
    ]
    inertial = [_inertial(kind) for kind in (GYROSCOPE, ACCELEROMETER)]
    content = {
        "CalibrationInformation": {
            "Cameras": cameras,
            "InertialSensors": inertial,
            "Metadata": {
                "SerialId": serial,
                "FactoryCalDate": "1/1/2020 12:00:00 AM GMT",
                "Version": {"Major": 1, "Minor": 2},
                "DeviceName": "AzureKinect-PV",
                "Notes": "",
            },
        }
    }
    return json.dumps(content, separators=(",", ":")).encode()


def _lens(
    lens: Intrinsics, mode: Mode, location: str, pose: np.ndarray, sensor: tuple[int, int]
) -> dict[str, Any]:
    """Camera entry of the JSON. ``pose``: location from depth; ``sensor``: its full size, px."""
    if (lens.width, lens.height) != mode.size:
        raise ValueError(f"a {lens.width}x{lens.height} lens in a mode of {mode.size}")
    width, height = mode.binned
    parameters = np.zeros(14)
    parameters[:4] = (
        (lens.cx + mode.crop[0] + 0.5) / width,
        (lens.cy + mode.crop[1] + 0.5) / height,
        lens.fx / width,
        lens.fy / height,
    )
    parameters[list(DISTORTION_POSITIONS)] = lens.distortion
    depth = location == DEPTH_LOCATION
    return {
        "Intrinsics": {
            "ModelParameterCount": 14,
            "ModelParameters": parameters.tolist(),
            "ModelType": LENS_MODEL,
        },
        "Location": location,
        "Purpose": f"CALIBRATION_CameraPurpose{'Depth' if depth else 'PhotoVideo'}",
        "MetricRadius": lens.metric_radius,
        "Rt": _rt(pose[:3, :3], pose[:3, 3]),
        "SensorHeight": sensor[1],
        "SensorWidth": sensor[0],
        "Shutter": "CALIBRATION_ShutterTypeUndefined",
        "ThermalAdjustmentParams": {"Params": [0] * 12},
    }


def _rt(rotation: np.ndarray, translation: np.ndarray) -> dict[str, list[float]]:
    return {"Rotation": rotation.ravel().tolist(), "Translation": translation.tolist()}


def _inertial(kind: str) -> dict[str, Any]:
    mixing = np.zeros((3, 3, 4))
    mixing[:, :, 0] = np.eye(3)  # the sensor mixes its axes by the identity, at any temperature
    return {
        "BiasTemperatureModel": [0.0] * 12,
        "BiasUncertainty": [0.0] * 3,
        "Id": "CALIBRATION_InertialSensorId_LSM6DSM",
        "MixingMatrixTemperatureModel": mixing.ravel().tolist(),
        "ModelTypeMask": 16,
        "Noise": [0.0] * 6,
        "Rt": _rt(ACCELEROMETER_FROM_DEPTH, np.zeros(3)),
        "SecondOrderScaling": [0.0] * 9,
        "SensorType": kind,
        "TemperatureBounds": [5, 60],
        "TemperatureC": 0,
    }
