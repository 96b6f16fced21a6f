"""Bags of RealSense's recorder: ``rs.recorder``, ``config.enable_record_to_file``, the viewer.

Topics are ``/device_<n>/sensor_<n>/<Stream>_<n>/...``: messages of ROS 1 in ``.bag``, of ROS 2 with
text in ``.db3`` (from 2.58 on). Source: src/media/ros of librealsense (Apache 2.0), and files that
``pyrealsense2`` wrote.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.calibration.opencv import CalibratedCamera
from intercap_core.formats.recordings.ros.bag import Bag
from intercap_core.formats.recordings.ros.lenses import read_lens, transform_matrix
from intercap_core.formats.recordings.ros.streams import (
    CameraStreams,
    Scheme,
    Stream,
    choose_topic,
    first_or_refuse,
    kind_of_topic,
)
from intercap_core.geometry.camera.transforms import invert, is_rigid, rigid
from intercap_core.inputs.files import parse_numbers

_IMAGES = re.compile(
    r"((/device_\d+)/sensor_\d+)/((Color|Depth)_\d+)/image/data(/compressed(Depth)?)?"
)

_ACCELERATION = re.compile(r"/device_\d+/sensor_\d+/(Accel|Motion)_\d+/imu/data")


def list_cameras(bag: Bag) -> list[str]:
    """Names of the devices; "" if there is one, since topics state no name."""
    devices = sorted({match[2] for topic in bag.topics if (match := _IMAGES.fullmatch(topic))})
    return [""] if len(devices) == 1 else [device.strip("/") for device in devices]


def read(
    bag: Bag, name: str, preferred: Sequence[str], known: CalibratedCamera | None
) -> CameraStreams:
    """Read the streams of a device of :func:`list_cameras`; raises UserError as the scheme says."""
    matches = [match for topic in bag.topics if (match := _IMAGES.fullmatch(topic))]
    of_device = [m for m in matches if name in ("", m[2].strip("/"))]
    colour_topics, depth_topics = (
        [m[0] for m in of_device if m[4] == kind] for kind in ("Color", "Depth")
    )
    if not colour_topics:
        raise UserError(f"{bag.path}: was recorded without colour; record with the colour stream")
    device = of_device[0][2]
    colour = _stream(bag, choose_topic(bag, "colour", colour_topics, preferred))
    serial = _text_of(bag, f"{device}/info").get("Serial Number", "")
    streams = CameraStreams(colour, serial=serial)
    inertial = [topic for topic in bag.topics if _ACCELERATION.fullmatch(topic)]
    for topic in (topic for topic in inertial if topic.startswith(f"{device}/")):
        pose = _pose_in(bag, colour.topic, topic)
        rotation = None if pose is None else pose[:3, :3]
        streams = replace(streams, accelerometer=topic, colour_from_accelerometer=rotation)
    if not depth_topics:
        return streams
    topic = choose_topic(bag, "depth", depth_topics, preferred)
    match = _IMAGES.fullmatch(topic)
    assert match is not None
    unit = _option(bag, match[1], "Depth_Units")
    depth = _stream(bag, topic, 0.001 if unit is None else unit)
    baseline_mm = _option(bag, match[1], "Stereo_Baseline")
    colour_from_depth = _pose_in(bag, colour.topic, topic)
    if colour_from_depth is None:
        raise UserError(
            f"{bag.path}: the poses of {colour.topic} and {topic} have no common reference; record "
            "both streams in one recording of one device"
        )
    return replace(
        streams,
        depth=depth,
        colour_from_depth=colour_from_depth,
        stereo_baseline_m=abs(baseline_mm or 0.0) * 1e-3,
    )


def _stream(bag: Bag, topic: str, unit_m: float = 0.001) -> Stream:
    prefix = topic.partition("/image/")[0]
    kind_of_topic(bag, topic)
    where = f"{prefix}/info/camera_info"
    if where not in bag.topics:
        where = f"{prefix}/camera_info"
    info = first_or_refuse(bag, where, f"the lens of {topic}")
    if hasattr(info, "data"):  # ROS 2: width=64;height=48;fx=60;...
        info = _lens_of_text(_pairs(info.data), f"{bag.path}: {where}")
    lens = read_lens(info, f"{bag.path}: {where}")
    times = {}
    if bag.path.suffix != ".bag":  # headers hold the time of recording
        for _, recorded, message in bag.messages(f"{prefix}/image/metadata"):
            milliseconds = _pairs(message.data).get("timestamp", "")
            if re.fullmatch(r"\d{1,15}(\.\d*)?", milliseconds):
                times[recorded] = round(float(milliseconds) * 1000)
    return Stream(topic, lens, unit_m, times)


def _lens_of_text(values: dict[str, str], where: str) -> Any:
    """The text of a lens in the form of a CameraInfo message."""
    numbers = {
        name: parse_numbers(values.get(name, "").split(","), where, name)
        for name in ("width", "height", "fx", "fy", "ppx", "ppy", "coeffs")
    }
    single = {name: float(value[0]) for name, value in numbers.items()}
    k = [single["fx"], 0, single["ppx"], 0, single["fy"], single["ppy"], 0, 0, 1]
    return SimpleNamespace(
        k=k, d=numbers["coeffs"], p=np.zeros(12), distortion_model=values.get("model", ""),
        width=single["width"], height=single["height"],
    )  # fmt: skip


def _pose_in(bag: Bag, colour: str, topic: str) -> np.ndarray | None:
    """Pose (4, 4) of a stream in the frame of the colour stream; None if it is not recorded."""
    (reference, colour_from_reference), (other, from_reference) = (
        _pose(bag, name) for name in (colour, topic)
    )
    return colour_from_reference @ invert(from_reference) if reference == other else None


def _pose(bag: Bag, topic: str) -> tuple[str, np.ndarray]:
    """Number of the reference stream, and the pose (4, 4) of the reference in a stream's frame.

    Without a recorded pose, the reference is the stream itself.
    """
    prefix = f"{'/'.join(topic.split('/')[:4])}/tf/"
    where = next((name for name in bag.topics if name.startswith(prefix)), "")
    if not where:
        return topic, np.eye(4)
    message = bag.first(where)
    if hasattr(message, "data"):
        values = _pairs(message.data)
        rotation, translation = (
            parse_numbers(values.get(name, "").split(","), f"{bag.path}: {where}", name)
            for name in ("rotation", "translation")
        )
        valid = rotation.shape == (9,) and translation.shape == (3,)
        # The nine numbers are the columns of the rotation.
        pose = rigid(rotation.reshape(3, 3).T, translation) if valid else np.zeros((4, 4))
    else:
        pose = transform_matrix(message)
    if not is_rigid(pose, 1e-3):
        raise UserError(f"{bag.path}: {where} is no rigid transform; record again")
    return where.removeprefix(prefix).removeprefix("ref_"), pose


def _option(bag: Bag, sensor: str, name: str) -> float | None:
    """Value of an option of a sensor; None if it was not recorded.

    Recorders until the middle of 2019 wrote spaces instead of underscores.
    """
    topics = (f"{sensor}/option/{own}/value" for own in (name, name.replace("_", " ")))
    message = next((bag.first(topic) for topic in topics if topic in bag.topics), None)
    return None if message is None else round(float(message.data), 8)  # of single precision


def _text_of(bag: Bag, topic: str) -> dict[str, str]:
    """Keys and values of a device."""
    values: dict[str, str] = {}
    for _, _, message in bag.messages(topic):
        values |= _pairs(message.data) if hasattr(message, "data") else {message.key: message.value}
    return values


def _pairs(text: str) -> dict[str, str]:
    """Parse ``key=value;key=value``."""
    return dict(pair.split("=", 1) for pair in text.split(";") if "=" in pair)


SCHEME = Scheme(
    lambda bag: any(_IMAGES.fullmatch(topic) for topic in bag.topics),
    list_cameras,
    read,
)
