"""Bags without lenses, whose calibration states them, and accelerometers in bags."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from intercap_core.errors import UserError
from intercap_core.formats.recordings.layouts import open_layout
from intercap_core.geometry.camera.transforms import invert
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
    pose,
    write_camera,
)

IMU_FROM_COLOUR = pose(0.4, 0.01, -0.02, 0.03)
UP = IMU_FROM_COLOUR[:3, :3] @ (-9.8 * DOWN)


def write_without_lenses(folder: Path, *, zeros: bool = False) -> None:
    """Bag of a camera without transforms; with ``zeros``, its CameraInfo states no lens."""
    with BagFile(folder / "walk", "mcap") as bag:
        if zeros:
            bag.lens("/k1/color/camera_info", COLOUR_SIZE, np.zeros((3, 3)), "k1", d=())
        for t in range(3):
            at = START_NS + t * PERIOD_NS
            bag.image("/k1/color/image_raw", at, "k1", colour_image(t), "bgr8")
            bag.image("/k1/depth/image_raw", at, "k1", depth_image(t), "16UC1")


def calibration(folder: Path, *, depth: bool = True) -> Path:
    """Calibration in OpenCV's terms."""

    def lens(size: tuple[int, int], matrix: np.ndarray) -> dict[str, object]:
        return {"image_size": size, "camera_matrix": matrix.tolist(),
                "distortion_coefficients": [0.1, -0.05, 0, 0, 0]}  # fmt: skip

    entry = lens(COLOUR_SIZE, COLOUR_K) | {"R": [0, 0, 0], "T": [0, 0, 0]}
    if depth:
        entry["depth"] = lens(DEPTH_SIZE, DEPTH_K) | {
            "colour_from_depth": COLOUR_FROM_DEPTH.tolist()
        }
    path = folder / "lenses.json"
    path.write_text(json.dumps({"cameras": {"k1": entry}}))
    return path


@pytest.mark.parametrize("zeros", [False, True])
def test_lenses_that_a_bag_lacks_are_those_of_the_calibration(tmp_path: Path, zeros: bool) -> None:
    write_without_lenses(tmp_path, zeros=zeros)
    layout = open_layout(row(tmp_path, calibration=calibration(tmp_path)))
    with layout.open("k1") as recording:
        camera = recording.camera
        kinds = [image.kind for image in recording.images()]
    assert camera.depth is not None and camera.colour_from_depth is not None
    assert np.array_equal(camera.colour.matrix, COLOUR_K) and camera.colour.distortion[0] == 0.1
    assert np.array_equal(camera.depth.matrix, DEPTH_K)
    assert np.array_equal(camera.colour_from_depth, COLOUR_FROM_DEPTH)
    assert kinds.count("colour") == kinds.count("depth") == 3


def test_a_calibration_without_the_depth_lens_is_named(tmp_path: Path) -> None:
    write_without_lenses(tmp_path)
    layout = open_layout(row(tmp_path, calibration=calibration(tmp_path, depth=False)))
    with pytest.raises(
        UserError, match=r"walk: has no message on /k1/depth/.*state the depth lens"
    ):
        layout.open("k1")


def gravity_of(folder: Path, *samples: tuple[str, str, np.ndarray]) -> tuple[np.ndarray, str]:
    """Gravity and notes of a recording with samples of (topic, frame, acceleration)."""
    with BagFile(folder / "walk", "mcap") as bag:
        write_camera(bag)
        bag.transforms(k1_imu=("k1_color", invert(IMU_FROM_COLOUR)))
        for t in range(4):
            for topic, frame, value in samples:
                bag.inertial(topic, START_NS + t * PERIOD_NS, frame, value)
    with open_layout(row(folder)).open("k1") as recording:
        assert len([i for i in recording.images() if i.kind == "colour"]) == 4
        return recording.gravity, " ".join(recording.notes)


def test_gravity_is_measured_by_the_accelerometer_of_the_camera(tmp_path: Path) -> None:
    """Neither by a gyroscope's topic, which comes first by name, nor by another camera's."""
    gravity, _ = gravity_of(
        tmp_path,
        ("/k1/a_gyroscope", "k1_imu", np.zeros(3)),
        ("/k1/imu", "k1_imu", UP),
        ("/k10/imu", "k1_imu", -UP),
    )
    assert gravity == pytest.approx(DOWN, abs=1e-9)


@pytest.mark.parametrize(
    ("frame", "value", "note"),
    [
        ("k1_imu", 0.02 * UP, "accelerometer measures 0.2 m/s^2 in the mean, expected 9.8"),
        ("elsewhere", UP, "no pose of its accelerometer (/k1/imu) is recorded"),
    ],
)
def test_a_sensor_that_does_not_show_gravity_is_noted(
    tmp_path: Path, frame: str, value: np.ndarray, note: str
) -> None:
    gravity, notes = gravity_of(tmp_path, ("/k1/imu", frame, value))
    assert np.isnan(gravity).all()
    assert note in notes
