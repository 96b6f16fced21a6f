"""Bags of Orbbec's recorder: ``ob::RecordDevice`` of OrbbecSDK 2, and Orbbec Viewer 2.

Images are on ``/cam/sensor_<n>/frameType_<n>``, lenses and the pose of the depth camera on
``/cam/streamProfileType_<n>``. Source: src/media/ros and 3rdparty/rosbag of OrbbecSDK_v2 (MIT).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.calibration.opencv import CalibratedCamera, opencv_lens
from intercap_core.formats.recordings.ros.bag import Bag
from intercap_core.formats.recordings.ros.streams import (
    CameraStreams,
    Scheme,
    Stream,
    first_or_refuse,
    kind_of_topic,
)
from intercap_core.geometry.camera.transforms import is_rigid, rigid

# OBSensorType, OBFrameType and OBStreamType have the same numbers.
_COLOUR, _DEPTH, _ACCELEROMETER = 2, 3, 4
# OBCameraDistortionModel: none, modified, (plain) and of six coefficients Brown-Conrady. The
# modified model scales the tangential part too, by less than 0.05 px. Inverse and fisheye models
# are not OpenCV's.
_OPENCV_MODELS = (0, 1, 3, 4)
# cameraDistortion holds k1 to k6, p1, p2; OpenCV's order is k1, k2, p1, p2, k3, ...
_ORDER = [0, 1, 6, 7, 2, 3, 4, 5]


def _topic(stream: int) -> str:
    return f"/cam/sensor_{stream}/frameType_{stream}"


def read(
    bag: Bag, name: str, preferred: Sequence[str], known: CalibratedCamera | None
) -> CameraStreams:
    """Read the streams of the device; raises UserError as the scheme says."""
    if _topic(_COLOUR) not in bag.topics:
        raise UserError(f"{bag.path}: was recorded without colour; record with the colour stream")
    colour, _ = _stream(bag, _COLOUR)
    device = bag.first("/cam/deviceInfo")
    serial = "" if device is None else str(device.sn)
    if _topic(_DEPTH) not in bag.topics:
        return CameraStreams(colour, serial=serial)
    depth, profile = _stream(bag, _DEPTH)
    pose = _pose(profile)
    if not is_rigid(pose, 1e-3):
        raise UserError(
            f"{bag.path}: the pose of the depth camera is no rigid transform; record colour and "
            "depth in one recording"
        )
    disparity = bag.first("/cam/disparityParam")  # of stereo cameras alone
    baseline_mm = 0.0 if disparity is None else abs(disparity.baseline * disparity.unit)
    streams = CameraStreams(
        colour, depth, pose, serial=serial, stereo_baseline_m=float(baseline_mm) * 1e-3
    )
    inertial = bag.first(f"/cam/streamProfileType_{_ACCELEROMETER}")
    if inertial is None or not is_rigid(_pose(inertial), 1e-3):
        return streams
    rotation = (pose @ _pose(inertial))[:3, :3]  # the profile's pose is that in the depth camera
    return replace(
        streams, accelerometer=_topic(_ACCELEROMETER), colour_from_accelerometer=rotation
    )


def _pose(profile: Any) -> np.ndarray:
    """Pose (4, 4) that a profile states, metres."""
    rotation = np.asarray(profile.rotationMatrix, np.float64).reshape(3, 3)
    return rigid(rotation, np.asarray(profile.translationMatrix, np.float64) * 1e-3)  # of mm


def _stream(bag: Bag, number: int) -> tuple[Stream, Any]:
    """A stream and its profile."""
    topic, where = _topic(number), f"/cam/streamProfileType_{number}"
    kind_of_topic(bag, topic)
    profile = first_or_refuse(bag, where, f"the lens of {topic}")
    distortion = np.asarray(profile.cameraDistortion, np.float64)[_ORDER]
    if profile.distortionModel not in _OPENCV_MODELS and distortion.any():
        raise UserError(
            f"{bag.path}: {where} has distortion model {profile.distortionModel}, expected one of "
            "Brown-Conrady (0, 1, 3, 4); record colour of another mode"
        )
    fx, fy, cx, cy = np.asarray(profile.cameraIntrinsic, np.float64)
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    size = (int(profile.width), int(profile.height))
    return Stream(topic, opencv_lens(size, matrix, distortion, f"{bag.path}: {where}")), profile


SCHEME = Scheme(
    lambda bag: _topic(_COLOUR) in bag.topics or _topic(_DEPTH) in bag.topics,
    lambda bag: [""],
    read,
)
