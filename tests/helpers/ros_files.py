"""Bags that ``rosbags`` writes to the published messages of ROS 1 and ROS 2."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from intercap_core.formats.calibration.extrinsics import Extrinsics, write_rig_file

Form = Literal["bag", "mcap", "db3"]
FORMS: tuple[Form, ...] = ("bag", "mcap", "db3")
COLOUR_SIZE, DEPTH_SIZE = (64, 48), (40, 30)
COLOUR_K = np.array([[60.0, 0, 32.5], [0, 61.0, 23.25], [0, 0, 1]])
DEPTH_K = np.array([[38.0, 0, 20.5], [0, 39.0, 14.25], [0, 0, 1]])
PERIOD_NS = 33_333_333
START_NS = 1_700_000_000_000_000_000


class BagFile:
    """A bag that is written; a context manager. ``bag.add`` serialises one message."""

    def __init__(self, path: Path, form: Form) -> None:
        self.path, self.ros1 = path, form == "bag"
        self.store: Any = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        if self.ros1:
            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
        self._topics: dict[str, Any] = {}
        if self.ros1:
            self._writer: Any = rosbag1.Writer(path)
        else:
            plugin = rosbag2.StoragePlugin.MCAP if form == "mcap" else rosbag2.StoragePlugin.SQLITE3
            self._writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)

    def __enter__(self) -> BagFile:
        self._writer.open()
        return self

    def __exit__(self, *error: object) -> None:
        self._writer.close()

    def compress(self, *how: Any) -> None:
        """Compress the bag, by a format of ROS 1 or by mode and format of ROS 2.

        Call before the ``with`` block.
        """
        self._writer.set_compression(*how)

    def make(self, name: str, **fields: Any) -> Any:
        return self.store.types[name](**fields)

    def add(self, topic: str, name: str, at: int, extra: bytes = b"", **fields: Any) -> None:
        """Add a message; ``extra`` follows it, as vendors append fields."""
        if topic not in self._topics:
            self._topics[topic] = self._writer.add_connection(topic, name, typestore=self.store)
        message = self.make(name, **fields)
        serialize = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self._writer.write(self._topics[topic], at, bytes(serialize(message, name)) + extra)

    def header(self, at: int, frame: str) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", sec=at // 10**9, nanosec=at % 10**9)
        fields = {"seq": 0} if self.ros1 else {}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **fields)

    def lens(self, topic: str, size: tuple[int, int], k: np.ndarray, frame: str, *,
             model: str = "plumb_bob", d: Any = (0.1, -0.05, 0.001, -0.002, 0.01),
             p: np.ndarray | None = None) -> None:  # fmt: skip
        """Add a CameraInfo."""
        roi = self.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0,
                        width=0, do_rectify=False)  # fmt: skip
        projection = np.hstack([k, np.zeros((3, 1))]) if p is None else p
        matrices = {"d": np.array(d, float), "k": k.ravel(), "r": np.eye(3).ravel(),
                    "p": projection.ravel()}  # fmt: skip
        if self.ros1:
            matrices = {name.upper(): value for name, value in matrices.items()}
        self.add(topic, "sensor_msgs/msg/CameraInfo", START_NS, header=self.header(START_NS, frame),
                 height=size[1], width=size[0], distortion_model=model, binning_x=0, binning_y=0,
                 roi=roi, **matrices)  # fmt: skip

    def image(self, topic: str, at: int, frame: str, image: np.ndarray, encoding: str,
              stamp: int | None = None, padding: int = 0, extra: bytes = b"") -> None:  # fmt: skip
        """Add an Image with ``padding`` bytes after each row."""
        rows = np.ascontiguousarray(image).view(np.uint8).reshape(len(image), -1)
        rows = np.pad(rows, ((0, 0), (0, padding)))
        self.add(topic, "sensor_msgs/msg/Image", at, extra,
                 header=self.header(at if stamp is None else stamp, frame),
                 height=image.shape[0], width=image.shape[1], encoding=encoding, is_bigendian=0,
                 step=rows.shape[1], data=rows.ravel())  # fmt: skip

    def compressed(self, topic: str, at: int, frame: str, content: bytes, text: str) -> None:
        """Add a CompressedImage."""
        self.add(topic, "sensor_msgs/msg/CompressedImage", at, header=self.header(at, frame),
                 format=text, data=np.frombuffer(content, np.uint8))  # fmt: skip

    def inertial(self, topic: str, at: int, frame: str, acceleration: np.ndarray,
                 extra: bytes = b"") -> None:  # fmt: skip
        """Add an Imu with an acceleration (3,), m/s^2, and without a rate."""
        x, y, z = np.asarray(acceleration, float).tolist()
        nothing = self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        turn = self.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
        names = ("orientation", "angular_velocity", "linear_acceleration")
        zeros = {f"{name}_covariance": np.zeros(9) for name in names}
        self.add(topic, "sensor_msgs/msg/Imu", at, extra, header=self.header(at, frame),
                 orientation=turn, angular_velocity=nothing,
                 linear_acceleration=self.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
                 **zeros)  # fmt: skip

    def transforms(self, **poses: tuple[str, np.ndarray]) -> None:
        """Add static transforms: parent and pose (4, 4) by the child's frame."""
        stamped = []
        for child, (parent, pose) in poses.items():
            x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
            place = dict(zip("xyz", pose[:3, 3].tolist(), strict=True))
            transform = self.make(
                "geometry_msgs/msg/Transform",
                translation=self.make("geometry_msgs/msg/Vector3", **place),
                rotation=self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
            )
            stamped.append(self.make(
                "geometry_msgs/msg/TransformStamped", header=self.header(START_NS, parent),
                child_frame_id=child, transform=transform,
            ))  # fmt: skip
        self.add("/tf_static", "tf2_msgs/msg/TFMessage", START_NS, transforms=stamped)


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def jpeg(image: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", image)[1].tobytes()


def colour_image(t: int) -> np.ndarray:
    """(H, W, 3) BGR with a smooth gradient."""
    y, x = np.mgrid[: COLOUR_SIZE[1], : COLOUR_SIZE[0]]
    return np.stack([3 * x + t, 4 * y, 200 - x - y], -1).astype(np.uint8)


def depth_image(t: int, seed: int = 0) -> np.ndarray:
    """(H, W) uint16 mm with runs of zeros."""
    rng = np.random.default_rng(seed + t)
    depth = rng.integers(500, 4000, DEPTH_SIZE[::-1]).astype(np.uint16)
    depth[rng.random(depth.shape) < 0.3] = 0
    depth[3:7] = 0
    return depth


def pose(turn: float, *place: float) -> np.ndarray:
    """(4, 4) with a rotation about y, radians."""
    result = np.eye(4)
    result[:3, :3] = Rotation.from_rotvec([0, turn, 0]).as_matrix()
    result[:3, 3] = place
    return result


def encode_rvl(depth: np.ndarray) -> bytes:
    """RVL as image_transport_plugins writes it: columns, rows, groups of four bits in words.

    Written from the description in Wilson 2017, with Python integers.
    """
    values = depth.ravel().tolist()
    groups: list[int] = []

    def put(number: int) -> None:
        while True:
            number, low = number >> 3, number & 7
            groups.append(low | (8 if number else 0))
            if not number:
                return

    at, previous = 0, 0
    while at < len(values):
        zeros = next((i for i, v in enumerate(values[at:]) if v), len(values) - at)
        put(zeros)
        at += zeros
        others = next((i for i, v in enumerate(values[at:]) if not v), len(values) - at)
        put(others)
        for value in values[at : at + others]:
            delta, previous = value - previous, value
            put(2 * delta if delta >= 0 else -2 * delta - 1)
        at += others
    groups += [0] * (-len(groups) % 8)
    words = [
        sum(group << (28 - 4 * place) for place, group in enumerate(groups[start : start + 8]))
        for start in range(0, len(groups), 8)
    ]
    return struct.pack(f"<ii{len(words)}I", depth.shape[1], depth.shape[0], *words)


def rig_file(folder: Path, *names: str) -> Path:
    """A rig file of cameras that are two metres apart."""
    poses = {name: pose(0.1 * i, 2.0 * i, 0, 0) for i, name in enumerate(names)}
    path = folder / "rig.json"
    write_rig_file(path, Extrinsics(names[0], poses))
    return path


DOWN = np.array([0.2, 0.9, -0.3]) / np.linalg.norm([0.2, 0.9, -0.3])  # of a tilted camera
COLOUR_FROM_DEPTH = pose(0.02, 0.032, 0.001, -0.002)


def write_camera(
    bag: BagFile,
    name: str = "k1",
    images: int = 4,
    *,
    world: np.ndarray | None = None,
    depth: bool = True,
    encoding: str = "bgr8",
) -> None:
    """Add one camera with raw colour, raw depth, lenses and transforms, as drivers publish them."""
    place = np.eye(4) if world is None else world
    poses = {f"{name}_color": ("map", place), f"{name}_depth": (f"{name}_color", COLOUR_FROM_DEPTH)}
    bag.transforms(**poses)
    bag.lens(f"/{name}/color/camera_info", COLOUR_SIZE, COLOUR_K, f"{name}_color")
    if depth:
        bag.lens(f"/{name}/depth/camera_info", DEPTH_SIZE, DEPTH_K, f"{name}_depth")
    for t in range(images):
        at = START_NS + t * PERIOD_NS
        bag.image(f"/{name}/color/image_raw", at, f"{name}_color", colour_image(t), encoding)
        if depth:
            bag.image(f"/{name}/depth/image_raw", at, f"{name}_depth", depth_image(t), "16UC1")
