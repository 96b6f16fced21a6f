"""Bags of Orbbec's recorder, written by ``rosbags`` to the messages of OrbbecSDK 2 (no package of
the vendor for Python records without a device)."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from intercap_core.errors import UserError
from intercap_core.formats.recordings.layouts import open_layout, recognise_recordings
from intercap_core.formats.recordings.ros.bag import Bag
from intercap_core.formats.recordings.ros.orbbec import SCHEME
from tests.formats.recordings.ros.test_standard import row
from tests.helpers.ros_files import (
    COLOUR_FROM_DEPTH,
    COLOUR_K,
    COLOUR_SIZE,
    DEPTH_K,
    DEPTH_SIZE,
    DOWN,
    PERIOD_NS,
    START_NS,
    BagFile,
    colour_image,
    depth_image,
    jpeg,
    rig_file,
)

PROFILE = """std_msgs/Header header
uint8 streamType
uint8 format
float32[9] rotationMatrix
float32[3] translationMatrix
uint16 width
uint16 height
uint16 fps
float32[4] cameraIntrinsic
float32[8] cameraDistortion
uint8 distortionModel
"""
DISPARITY = """std_msgs/Header header
float64 zpd
float64 zpps
float32 baseline
float64 fx
uint8 bitSize
float32 unit
float32 minDisparity
uint8 packMode
float32 dispOffset
int32 invalidDisp
int32 dispIntPlace
uint8 isDualCamera
"""
INERTIAL = """std_msgs/Header header
uint8 streamType
uint8 format
uint8 accelFullScaleRange
uint8 accelSampleRate
uint8 gyroFullScaleRange
uint8 gyroSampleRate
float32[9] rotationMatrix
float32[3] translationMatrix
float64 noiseDensity
float64 randomWalk
float64 referenceTemp
float64[3] bias
float64[3] gravity
float64[9] scaleMisalignment
float64[9] tempSlope
"""
# Axes x, y, z of the accelerometer are -z, -x, y of the depth camera.
DEPTH_FROM_ACCELEROMETER = np.array(
    [[0.0, -1, 0, 0.004], [0, 0, 1, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]
)
K1_TO_K6_P1_P2 = (0.1, -0.05, 0.01, 0.2, -0.03, 0.004, 0.001, -0.002)


def write(path: Path, *, model: int = 4, profiles: bool = True, disparity: bool = False) -> None:
    with BagFile(path, "bag") as bag:
        texts = {"OBStreamProfileInfo": PROFILE, "OBDisparityParam": DISPARITY,
                 "OBImuStreamProfileInfo": INERTIAL}  # fmt: skip
        for name, text in texts.items():
            bag.store.register(get_types_from_msg(text, f"custom_msg/msg/{name}"))
        # depth_units, number, three times, metadata (3 bytes), its size, bits of a pixel
        extra = struct.pack("<fQQQQI3sIB", 0.0, 7, 1, 2, 3, 3, b"abc", 3, 16)
        for t in range(3):
            at = START_NS + t * PERIOD_NS
            packed = np.frombuffer(jpeg(colour_image(t)), np.uint8)
            bag.add("/cam/sensor_2/frameType_2", "sensor_msgs/msg/Image", at, extra,
                    header=bag.header(at, ""), height=COLOUR_SIZE[1], width=COLOUR_SIZE[0],
                    encoding="mjpg", is_bigendian=0, step=COLOUR_SIZE[0], data=packed)  # fmt: skip
            bag.image("/cam/sensor_3/frameType_3", at, "", depth_image(t), "mono16", extra=extra)
        if profiles:
            profile(bag, 2, COLOUR_SIZE, COLOUR_K, model)
            profile(bag, 3, DEPTH_SIZE, DEPTH_K, model)
        inertial(bag)
        if disparity:
            bag.add("/cam/disparityParam", "custom_msg/msg/OBDisparityParam", START_NS,
                    header=bag.header(START_NS, ""), zpd=0.0, zpps=0.0, baseline=50.0, fx=38.0,
                    bitSize=12, unit=1.0, minDisparity=0.0, packMode=0, dispOffset=0.0,
                    invalidDisp=0, dispIntPlace=0, isDualCamera=1)  # fmt: skip


def profile(bag: BagFile, number: int, size: tuple[int, int], k: np.ndarray, model: int) -> None:
    pose = COLOUR_FROM_DEPTH if number == 3 else np.eye(4)
    values: dict[str, Any] = {
        "rotationMatrix": pose[:3, :3].ravel(),
        "translationMatrix": pose[:3, 3] * 1000,
        "cameraIntrinsic": np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2]]),
        "cameraDistortion": np.array(K1_TO_K6_P1_P2),
    }
    bag.add(f"/cam/streamProfileType_{number}", "custom_msg/msg/OBStreamProfileInfo", START_NS,
            header=bag.header(START_NS, ""), streamType=number, format=0, width=size[0],
            height=size[1], fps=30, distortionModel=model,
            **{name: value.astype(np.float32) for name, value in values.items()})  # fmt: skip


def inertial(bag: BagFile) -> None:
    """Samples of a device at rest, and the pose of its accelerometer."""
    up = DEPTH_FROM_ACCELEROMETER[:3, :3].T @ (-9.8 * DOWN)
    # data, its size, number, temperature, three times
    extra = struct.pack("<I3sIQfQQQ", 3, b"abc", 3, 7, 25.0, 1, 2, 3)
    for t in range(4):
        bag.inertial("/cam/sensor_4/frameType_4", START_NS + t * PERIOD_NS, "", up, extra)
    numbers = {"noiseDensity": 0.0, "randomWalk": 0.0, "referenceTemp": 0.0,
               "bias": np.zeros(3), "gravity": np.zeros(3),
               "scaleMisalignment": np.eye(3).ravel(), "tempSlope": np.zeros(9)}  # fmt: skip
    bag.add("/cam/streamProfileType_4", "custom_msg/msg/OBImuStreamProfileInfo", START_NS,
            header=bag.header(START_NS, ""), streamType=4, format=0, accelFullScaleRange=1,
            accelSampleRate=1, gyroFullScaleRange=1, gyroSampleRate=1,
            rotationMatrix=DEPTH_FROM_ACCELEROMETER[:3, :3].ravel().astype(np.float32),
            translationMatrix=(1e3 * DEPTH_FROM_ACCELEROMETER[:3, 3]).astype(np.float32),
            **numbers)  # fmt: skip


def layout_of(folder: Path) -> Any:
    return open_layout(row(folder, calibration=rig_file(folder, "k1")))


def test_streams_lenses_and_pose_are_read(tmp_path: Path) -> None:
    write(tmp_path / "k1.bag", disparity=True)
    assert recognise_recordings(tmp_path) == ("ros", ["k1"])
    with layout_of(tmp_path).open("k1") as recording:
        camera, images = recording.camera, list(recording.images())
        assert recording.gravity == pytest.approx(COLOUR_FROM_DEPTH[:3, :3] @ DOWN, abs=1e-6)
    assert camera.colour_from_depth is not None and camera.depth is not None
    assert np.allclose(camera.colour_from_depth, COLOUR_FROM_DEPTH, atol=1e-6)
    assert np.allclose(camera.colour.matrix, COLOUR_K) and np.allclose(camera.depth.matrix, DEPTH_K)
    k1, k2, k3, k4, k5, k6, p1, p2 = K1_TO_K6_P1_P2
    assert np.allclose(camera.colour.distortion, [k1, k2, p1, p2, k3, k4, k5, k6])
    depth = [image for image in images if image.kind == "depth"]
    assert all(np.array_equal(depth[t].content, depth_image(t)) for t in range(3))
    assert [i.time_us for i in depth] == [(START_NS + t * PERIOD_NS) // 1000 for t in range(3)]
    colour = [image.content for image in images if image.kind == "colour"]
    assert colour == [jpeg(colour_image(t)) for t in range(3)]
    with Bag(tmp_path / "k1.bag") as bag:
        assert SCHEME.read(bag, "", (), None).stereo_baseline_m == pytest.approx(0.05)


def test_missing_profiles_and_other_lens_models_are_named(tmp_path: Path) -> None:
    write(tmp_path / "k1.bag", profiles=False)
    with pytest.raises(UserError, match="has no message on /cam/streamProfileType_2"):
        layout_of(tmp_path).open("k1")
    (tmp_path / "k1.bag").unlink()
    write(tmp_path / "k1.bag", model=5)
    with pytest.raises(UserError, match="has distortion model 5, expected one of Brown-Conrady"):
        layout_of(tmp_path).open("k1")
