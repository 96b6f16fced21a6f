"""Interface of the schemes by which recorders name topics: one file each, listed in :mod:`.layout`.

A :class:`Scheme` finds the cameras of a bag and the two streams of each.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.calibration.opencv import CalibratedCamera
from intercap_core.formats.recordings.ros.bag import Bag
from intercap_core.formats.recordings.ros.images import Kind, kind_of
from intercap_core.geometry.camera.intrinsics import Intrinsics

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
IMAGE_TYPES = (IMAGE, COMPRESSED_IMAGE)
IMU = "sensor_msgs/msg/Imu"


@dataclass(frozen=True, eq=False)
class Stream:
    """The images of one topic."""

    topic: str
    """Name of the topic."""
    lens: Intrinsics
    """Lens of the images."""
    unit_m: float = 0.001
    """Metres for one unit of depth of 16 bits."""
    times_us: Mapping[int, int] = field(default_factory=dict)
    """Device time, microseconds, by the time of recording, ns. Images that are not listed have the
    time in their header."""


@dataclass(frozen=True, eq=False)
class CameraStreams:
    """One camera of a bag."""

    colour: Stream
    depth: Stream | None = None
    colour_from_depth: np.ndarray | None = None
    """(4, 4), metres; None without depth."""
    frame: str = ""
    """Coordinate frame of the colour images; "" = not stated."""
    serial: str = ""
    """Serial number of the device; "" = not stated."""
    stereo_baseline_m: float = 0.0
    """Distance of the two infrared lenses of a stereo camera; 0 = time of flight, or not stated."""
    accelerometer: str = ""
    """Topic of type :data:`IMU` with accelerations; "" = none."""
    colour_from_accelerometer: np.ndarray | None = None
    """Rotation (3, 3); None without accelerometer, or if it is not known."""


@dataclass(frozen=True)
class Scheme:
    """How one recorder names its topics."""

    recognises: Callable[[Bag], bool]
    """Whether a bag has such topics."""
    list_cameras: Callable[[Bag], list[str]]
    """Names of the cameras with images; "" if the topics state none."""
    read: Callable[[Bag, str, Sequence[str], CalibratedCamera | None], CameraStreams]
    """Reads the camera of this name. The other arguments are topics that the user prefers, and what
    the calibration states of the camera, for bags without lenses. Raises UserError if lenses are
    missing, or if topics are ambiguous."""


def choose_topic(bag: Bag, kind: str, topics: Sequence[str], preferred: Sequence[str]) -> str:
    """Return the only topic, or the one that is preferred.

    Raises UserError if several remain.
    """
    chosen = [topic for topic in topics if topic in preferred] or list(topics)
    if len(chosen) > 1:
        raise UserError(
            f"{bag.path}: holds {len(chosen)} streams of {kind} of one camera: "
            f"{', '.join(chosen)}; name the one to use in the column topics of the table of "
            "sequences"
        )
    return chosen[0]


def kind_of_topic(bag: Bag, topic: str) -> Kind:
    """Kind of a topic's images; raises UserError for an encoding that is not supported."""
    message = bag.first(topic)
    try:
        return kind_of(message)
    except UserError as error:
        raise UserError(f"{bag.path}: topic {topic} {error}") from None


def acceleration(message: Any) -> np.ndarray:
    """Acceleration (3,), m/s^2, of an :data:`IMU` message; zero in those of gyroscopes."""
    value = message.linear_acceleration
    return np.array([value.x, value.y, value.z])


def first_or_refuse(bag: Bag, topic: str, purpose: str) -> Any:
    """Return the first message of a topic that is needed; raises UserError if there is none."""
    message = bag.first(topic)
    if message is None:
        raise UserError(
            f"{bag.path}: has no message on {topic}, which states {purpose}; record this topic too"
        )
    return message
