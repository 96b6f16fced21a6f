"""Recordings by the studio's writer, read by other programs."""

from __future__ import annotations

import json
from itertools import cycle
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from intercap_core.formats.calibration.k4a import (
    COLOUR_MODES,
    DEPTH_MODES,
    colour_from_accelerometer,
    parse_camera,
)
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.studio.calibration import write_calibration
from intercap_core.studio.mkv import MkvWriter

START_US = 5_000_000
PERIOD_US = 33_333
FRAMES = 6


def make_images() -> tuple[list[bytes], list[np.ndarray]]:
    rng = np.random.default_rng(0)
    jpegs, depths = [], []
    for _ in range(FRAMES):
        small = rng.integers(0, 255, (9, 16, 3)).astype(np.uint8)
        image = cv2.resize(small, (1280, 720))
        jpegs.append(cv2.imencode(".jpg", image)[1].tobytes())
        depths.append(rng.integers(0, 65536, (288, 320)).astype(np.uint16))
    return jpegs, depths


def write_recording(path: Path, with_imu: bool = True) -> tuple[list[bytes], list[np.ndarray]]:
    jpegs, depths = make_images()
    options = dict(
        calibration_json=b'{"made": "up"}', colour_mode="720P", depth_mode="NFOV_2X2BINNED",
        fps=30, serial="000111", start_offset_ns=START_US * 1000, depth_delay_ns=160_000,
        wired_sync_mode="SUBORDINATE", with_ir=True, with_imu=with_imu,
    )  # fmt: skip
    with MkvWriter(path, **options) as writer:
        for index, (jpeg, depth) in enumerate(zip(jpegs, depths, strict=True)):
            time_us = START_US + 1000 + index * PERIOD_US
            for sample in range(4 * with_imu):
                writer.write_imu([0, 0, -9.8], [0.1, 0.2, 0.3], time_us - 900 + sample * 600)
            writer.write_colour(jpeg, time_us)
            writer.write_depth(depth, time_us + 160)
            writer.write_ir(depth + 1, time_us + 160)
    return jpegs, depths


def packets_of(path: Path, title: str) -> list[tuple[int, bytes]]:
    with av.open(str(path)) as container:
        stream = next(s for s in container.streams if s.metadata.get("title") == title)
        return [(p.pts, bytes(p)) for p in container.demux(stream) if p.size]


def test_pyav_reads_back_the_same_bytes_and_times(tmp_path):
    jpegs, depths = write_recording(tmp_path / "k1.mkv")
    colour = packets_of(tmp_path / "k1.mkv", "COLOR")
    assert [content for _, content in colour] == jpegs
    assert [time for time, _ in colour] == [1000 + i * PERIOD_US for i in range(FRAMES)]
    depth = packets_of(tmp_path / "k1.mkv", "DEPTH")
    assert [time for time, _ in depth] == [1160 + i * PERIOD_US for i in range(FRAMES)]
    for (_, content), image in zip(depth, depths, strict=True):
        assert np.array_equal(np.frombuffer(content, ">u2").reshape(288, 320), image)
    assert len(packets_of(tmp_path / "k1.mkv", "IR")) == FRAMES
    imu = packets_of(tmp_path / "k1.mkv", "IMU")
    assert len(imu) == 4 * FRAMES and all(len(content) == 40 for _, content in imu)


def test_tags_attachment_and_rates(tmp_path):
    write_recording(tmp_path / "k1.mkv")
    with av.open(str(tmp_path / "k1.mkv")) as container:
        tags = dict(container.metadata)
        streams = {s.metadata.get("title") or s.metadata.get("filename"): s
                   for s in container.streams}  # fmt: skip
        assert tags["K4A_START_OFFSET_NS"] == str(START_US * 1000)
        assert tags["K4A_DEPTH_DELAY_NS"] == "160000"
        assert tags["K4A_WIRED_SYNC_MODE"] == "SUBORDINATE"
        assert tags["K4A_DEVICE_SERIAL_NUMBER"] == "000111"
        assert streams["COLOR"].metadata["K4A_COLOR_MODE"] == "MJPG_720P"
        assert streams["DEPTH"].metadata["K4A_DEPTH_MODE"] == "NFOV_2X2BINNED"
        assert bytes(streams["calibration.json"].data) == b'{"made": "up"}'
        assert streams["COLOR"].average_rate == 30
        last_imu_us = 1000 - 900 + 3 * 600 + (FRAMES - 1) * PERIOD_US
        assert container.duration == last_imu_us


@pytest.mark.parametrize(("colour_mode", "depth_mode"), zip(COLOUR_MODES, cycle(DEPTH_MODES)))
def test_calibration_round_trip_in_every_mode(colour_mode, depth_mode):
    rng = np.random.default_rng(1)

    def lens(size):
        focal = 0.5 * size[0] + rng.uniform(0, 9, 2)
        centre = np.array(size) / 2 + rng.uniform(-5, 5, 2)
        return Intrinsics(*size, *focal, *centre, rng.normal(0, 0.1, 8), 1.5)

    turn = cv2.Rodrigues(np.array([0.1, 0.002, -0.001]))[0]
    camera = Camera(
        "k3",
        lens(COLOUR_MODES[colour_mode].size),
        lens(DEPTH_MODES[depth_mode].size),
        rigid(turn, np.array([-0.032, -0.002, 0.004])),
        np.eye(4),
    )
    modes = dict(colour_mode=colour_mode, depth_mode=depth_mode)
    content = write_calibration(camera, serial="000111", **modes)
    again = parse_camera(content, name="k3", source="k3.mkv", **modes)
    assert np.allclose(again.colour.parameters, camera.colour.parameters, rtol=0, atol=1e-9)
    assert np.allclose(again.depth.parameters, camera.depth.parameters, rtol=0, atol=1e-9)
    assert np.allclose(again.colour_from_depth, camera.colour_from_depth, atol=1e-12)
    assert len(json.loads(content)["CalibrationInformation"]["InertialSensors"]) == 2
    down = colour_from_accelerometer(content, source="k3.mkv") @ [0, 0, 1]
    assert np.allclose(down, turn @ [0, 1, 0])
