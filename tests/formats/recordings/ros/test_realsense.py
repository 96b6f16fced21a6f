"""Bags of RealSense's recorder: written by ``pyrealsense2`` from a software device.

The installed release decides whether the file is a ``.bag`` or a ``.db3``.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from intercap_core.errors import UserError
from intercap_core.formats.recordings.layouts import open_layout, recognise_recordings
from intercap_core.formats.recordings.ros.bag import Bag
from intercap_core.formats.recordings.ros.streams import acceleration
from tests.formats.recordings.ros.test_standard import row
from tests.helpers.ros_files import (
    COLOUR_SIZE,
    DEPTH_SIZE,
    DOWN,
    BagFile,
    colour_image,
    depth_image,
    png,
    pose,
    rig_file,
)

rs = pytest.importorskip("pyrealsense2", reason="RealSense's library has no package here")
IMAGES, UNIT_M, BASELINE_MM = 6, 0.0005, 50.0
COLOUR_FROM_DEPTH = pose(0.03, 0.0148, 0.0003, -0.0002)
# Of a D455's colour camera, rounded.
COEFFICIENTS = [-0.055, 0.066, -0.0008, 0.0004, -0.021]


def lens(size: tuple[int, int], focal: float, model: Any, coefficients: list[float]) -> Any:
    result = rs.intrinsics()
    result.width, result.height = size
    result.ppx, result.ppy = size[0] / 2 + 0.5, size[1] / 2 - 0.25
    result.fx, result.fy, result.model, result.coeffs = focal, focal + 1, model, coefficients
    return result


def stream(kind: Any, number: int, form: Any, pixel_bytes: int, intrinsics: Any) -> Any:
    result = rs.video_stream()
    result.type, result.index, result.uid, result.fps = kind, 0, number, 30
    result.width, result.height = intrinsics.width, intrinsics.height
    result.bpp, result.fmt, result.intrinsics = pixel_bytes, form, intrinsics
    return result


def frame(profile: Any, image: np.ndarray, number: int) -> Any:
    result = rs.software_video_frame()
    result.pixels, result.bpp = image, image[0, 0].nbytes
    result.stride = image.strides[0]
    result.timestamp, result.frame_number = 5000.0 + number * 100 / 3, number + 1
    result.domain, result.profile = rs.timestamp_domain.hardware_clock, profile
    return result


def motion(profile: Any, acceleration: np.ndarray, number: int) -> Any:
    result = rs.software_motion_frame()
    value = rs.vector()
    value.x, value.y, value.z = acceleration.tolist()
    result.data = value
    result.timestamp, result.frame_number = 5000.0 + number * 10, number + 1
    result.domain, result.profile = rs.timestamp_domain.hardware_clock, profile
    return result


class Recorded:
    """A recording of a software device with depth, colour and accelerometer."""

    def __init__(self, path: Path, colour_model: Any = None, with_depth: bool = True) -> None:
        device = rs.software_device()
        device.register_info(rs.camera_info.name, "Intel RealSense D455")
        device.register_info(rs.camera_info.serial_number, "012345")
        depth_sensor = device.add_sensor("Stereo Module")
        colour_sensor = device.add_sensor("RGB Camera")
        depth_sensor.add_read_only_option(rs.option.depth_units, UNIT_M)
        depth_sensor.add_read_only_option(rs.option.stereo_baseline, BASELINE_MM)
        self.depth_lens = lens(DEPTH_SIZE, 38.0, rs.distortion.brown_conrady, [0.0] * 5)
        model = rs.distortion.inverse_brown_conrady if colour_model is None else colour_model
        self.colour_lens = lens(COLOUR_SIZE, 60.0, model, COEFFICIENTS)
        depth = depth_sensor.add_video_stream(
            stream(rs.stream.depth, 1, rs.format.z16, 2, self.depth_lens)
        )
        colour = colour_sensor.add_video_stream(
            stream(rs.stream.color, 2, rs.format.rgb8, 3, self.colour_lens)
        )
        extrinsics = rs.extrinsics()
        extrinsics.rotation = COLOUR_FROM_DEPTH[:3, :3].T.ravel().tolist()  # by columns
        extrinsics.translation = COLOUR_FROM_DEPTH[:3, 3].tolist()
        depth.register_extrinsics_to(colour, extrinsics)
        motion_sensor = device.add_sensor("Motion Module")
        inertial = rs.motion_stream()
        inertial.type, inertial.index, inertial.uid, inertial.fps = rs.stream.accel, 0, 3, 100
        inertial.fmt = rs.format.motion_xyz32f
        accelerometer = motion_sensor.add_motion_stream(inertial)
        recorder = rs.recorder(str(path), device)
        queue = rs.frame_queue(2 * IMAGES)
        used = [(depth_sensor, depth)] * with_depth + [(colour_sensor, colour)]
        used += [(motion_sensor, accelerometer)]
        opened = recorder.query_sensors()
        opened = opened if with_depth else opened[1:]
        for sensor, (_, profile) in zip(opened, used, strict=True):
            sensor.open(profile)
            sensor.start(queue)
        for t in range(IMAGES):
            sample = motion(accelerometer.as_motion_stream_profile(), -9.8 * DOWN, t)
            motion_sensor.on_motion_frame(sample)
            for software, profile in used[:-1]:
                image = depth_image(t) if profile is depth else colour_image(t)[..., ::-1].copy()
                software.on_video_frame(frame(profile.as_video_stream_profile(), image, t))
            time.sleep(0.02)  # the recorder writes in a thread of its own
        for sensor in opened:
            sensor.stop()
            sensor.close()


def file_written(folder: Path) -> Path:
    """``k1`` with the suffix of the installed release: ``.bag``, or later ``.db3``."""
    try:
        rs.recorder(str(folder / "other.bag"), rs.software_device())
    except RuntimeError:  # "Output file must have .db3 extension"
        return folder / "k1.db3"
    (folder / "other.bag").unlink()
    return folder / "k1.bag"


def test_a_software_device_is_read_as_recorded(tmp_path: Path) -> None:
    path = file_written(tmp_path)
    recorded = Recorded(path)
    assert recognise_recordings(tmp_path) == ("ros", ["k1"])
    with open_layout(row(tmp_path, calibration=rig_file(tmp_path, "k1"))).open("k1") as recording:
        camera, images = recording.camera, list(recording.images())
        assert recording.serial == "012345"
        assert recording.fps == pytest.approx(30.0, rel=1e-3)
        # A software device states no pose of its accelerometer; a D435i does, see below.
        assert "no pose of its accelerometer" in " ".join(recording.notes)
    with Bag(path) as bag:
        sample = bag.first("/device_0/sensor_2/Accel_0/imu/data")
    assert acceleration(sample) == pytest.approx(-9.8 * DOWN, abs=1e-6)
    assert camera.colour_from_depth is not None and camera.depth is not None
    assert np.allclose(camera.colour_from_depth, COLOUR_FROM_DEPTH, atol=1e-5)
    points = np.random.default_rng(0).uniform((-0.45, -0.35, 0.9), (0.45, 0.35, 1.5), (50, 3))
    for found, true in ((camera.colour, recorded.colour_lens), (camera.depth, recorded.depth_lens)):
        expected = [rs.rs2_project_point_to_pixel(true, point) for point in points.tolist()]
        assert np.abs(found.project(points) - expected).max() < 0.02
    depth = [image for image in images if image.kind == "depth"]
    colour = [image for image in images if image.kind == "colour"]
    # A software device may drop its first images before the recorder has started.
    assert len(depth) >= IMAGES - 2 and len(colour) >= IMAGES - 2
    numbers = [round((image.time_us - 5_000_000) * 0.03 / 1000) for image in depth]
    assert [image.time_us for image in depth] == pytest.approx(
        [5_000_000 + n * 100_000 / 3 for n in numbers], abs=2
    )
    for number, image in zip(numbers, depth, strict=True):
        expected = np.rint(depth_image(number) * (UNIT_M * 1000)).astype(np.uint16)
        assert np.array_equal(image.content, expected)
    shown = cv2.imdecode(np.frombuffer(colour[-1].content, np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(shown.astype(int) - colour_image(IMAGES - 1)).mean() < 3


def test_fisheye_colour_is_refused(tmp_path: Path) -> None:
    Recorded(file_written(tmp_path), rs.distortion.kannala_brandt4)
    with pytest.raises(UserError, match=r"Color_0/.*camera_info: its distortion model is 'Kannala"):
        open_layout(row(tmp_path, calibration=rig_file(tmp_path, "k1"))).open("k1")


@pytest.mark.parametrize("space", ["_", " "])
def test_text_in_bags_of_ros_2_is_read(tmp_path: Path, space: str) -> None:
    """Topics and text as release 2.59 of the recorder wrote them to a ``.db3``.

    Names of options had spaces until 2019.
    """
    prefix, times = "/device_0/sensor_0", [5_000_000, 5_033_333]
    rotation = ",".join(f"{value:.6f}" for value in COLOUR_FROM_DEPTH[:3, :3].T.ravel())
    translation = ",".join(f"{value:.6f}" for value in COLOUR_FROM_DEPTH[:3, 3])
    numbers = ",".join(map(str, COEFFICIENTS))
    texts = {
        "/device_0/info": "Name=Intel RealSense D455;Serial Number=012345",
        f"{prefix}/option/Depth{space}Units/value": "0.000500",
        f"{prefix}/option/Stereo{space}Baseline/value": "95.000000",
        f"{prefix}/Depth_0/camera_info": "width=40;height=30;fx=38;ppx=20.5;fy=39;ppy=14.75;"
        "model=Brown Conrady;coeffs=0,0,0,0,0",
        "/device_0/sensor_1/Color_0/camera_info": "width=64;height=48;fx=60;ppx=32.5;fy=61;"
        f"ppy=23.75;model=Inverse Brown Conrady;coeffs={numbers}",
        f"{prefix}/Depth_0/tf/ref_1": "rotation=1,0,0,0,1,0,0,0,1;translation=0,0,0",
        "/device_0/sensor_1/Color_0/tf/ref_1": f"rotation={rotation};translation={translation}",
    }
    from_depth = pose(0.3, -0.02, 0.0, 0.01)  # of the accelerometer
    rotation = ",".join(f"{value:.6f}" for value in from_depth[:3, :3].T.ravel())
    motion = "/device_0/sensor_2/Accel_0"
    texts[f"{motion}/tf/ref_1"] = f"rotation={rotation};translation=-0.02,0,0.01"
    with BagFile(tmp_path / "k1", "db3") as bag:
        bag.inertial(f"{motion}/imu/data", 701, "Accel_0", from_depth[:3, :3] @ (-9.8 * DOWN))
        for topic, text in texts.items():
            bag.add(topic, "std_msgs/msg/String", 0, data=text)
        for t, time_us in enumerate(times):
            at = t * 40_000_000 + 701  # time of recording, since the start
            for topic, content, text in (
                (
                    f"{prefix}/Depth_0",
                    bytes(12) + png(depth_image(t)),
                    "16UC1; compressedDepth png",
                ),
                ("/device_0/sensor_1/Color_0", png(colour_image(t)), "rgb8; png compressed bgr8"),
            ):
                transport = "Depth" if "Depth" in text else ""
                where = f"{topic}/image/data/compressed{transport}"
                bag.compressed(where, at, topic[-7:-2], content, text)
                stated = f"Frame number={t};system_time=0.000000;timestamp={time_us / 1000:.6f};"
                bag.add(f"{topic}/image/metadata", "std_msgs/msg/String", at, data=stated)
    with open_layout(row(tmp_path, calibration=rig_file(tmp_path, "k1"))).open("k1") as recording:
        camera, images = recording.camera, list(recording.images())
    assert camera.depth is not None and camera.colour_from_depth is not None
    assert np.allclose(camera.colour_from_depth, COLOUR_FROM_DEPTH, atol=1e-5)
    assert recording.gravity == pytest.approx(COLOUR_FROM_DEPTH[:3, :3] @ DOWN, abs=1e-5)
    assert np.allclose(camera.colour.distortion[:5], COEFFICIENTS)
    assert camera.depth_noise == pytest.approx(0.08 / (38.0 * 0.095))
    for kind in ("colour", "depth"):
        assert [image.time_us for image in images if image.kind == kind] == times
    depth = [image.content for image in images if image.kind == "depth"]
    assert np.array_equal(depth[1], np.rint(depth_image(1) * 0.5).astype(np.uint16))
    assert [i.content for i in images if i.kind == "colour"][1] == png(colour_image(1))
