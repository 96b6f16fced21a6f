"""Layout ``ros``: one ROS 2 bag (MCAP) for each camera, with the topics of the usual drivers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.errors import MissingPackage
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.studio.calibration import ACCELEROMETER_FROM_DEPTH
from intercap_core.studio.capture_folder import CameraFiles, CaptureFolder, Device, DeviceFrame

WORLD = "world"  # frame of the master


class RosFolder(CaptureFolder):
    """A bag ``<camera>/`` for each camera; poses are static transforms in the bags."""

    calibration = "."
    own_faults = frozenset({"backwards_clock"})

    def open(self, device: Device) -> CameraFiles:
        """Open the bag of a camera."""
        return _RosBag(self.path / device.camera.name, device)

    def write_calibration(self, claimed: Rig, fps: int) -> None:
        """Write nothing: the bags hold lenses and poses."""


class _RosBag(CameraFiles):
    """One bag: JPEG colour, PNG depth in its own lens, inertial samples, lenses and poses."""

    def __init__(self, path: Path, device: Device) -> None:
        try:
            from rosbags.rosbag2 import StoragePlugin, Writer
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise MissingPackage(
                f"{path}: writing ROS bags needs the package rosbags; install it with pip install "
                "'intercap-core[ros]'"
            ) from None
        self._store: Any = get_typestore(Stores.ROS2_HUMBLE)
        self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.open()
        self._topics: dict[str, Any] = {}
        camera, name = device.camera, device.camera.name
        self._name, start = name, device.first_us * 1000
        poses = {f"{name}_color": (WORLD, camera.master_from_colour)}
        self._write_lens("color", camera.colour, start)
        assert camera.depth is not None and camera.colour_from_depth is not None
        poses[f"{name}_depth"] = (f"{name}_color", camera.colour_from_depth)
        from_accelerometer = rigid(ACCELEROMETER_FROM_DEPTH.T, np.zeros(3))
        poses[f"{name}_imu"] = (f"{name}_depth", from_accelerometer)
        if device.depth:
            self._write_lens("depth", camera.depth, start)
        transforms = [
            self._make(
                "geometry_msgs/msg/TransformStamped",
                header=self._header(parent, start),
                child_frame_id=child,
                transform=self._transform(pose),
            )
            for child, (parent, pose) in poses.items()
        ]
        self._write("/tf_static", "tf2_msgs/msg/TFMessage", start, transforms=transforms)

    def write(self, frame: DeviceFrame) -> None:
        """Write the images of a frame set."""
        time_ns = frame.time_us * 1000
        self._write_image("color", "", "jpeg", frame.jpeg, time_ns)
        if frame.depth is not None:
            packed = cv2.imencode(".png", frame.depth, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
            content = bytes(12) + packed.tobytes()
            self._write_image("depth", "Depth", "16UC1; compressedDepth png", content, time_ns)
        unknown = np.zeros(9)
        for acceleration, rate, time_us in frame.inertial:
            self._write(
                f"/{self._name}/imu",
                "sensor_msgs/msg/Imu",
                time_us * 1000,
                header=self._header(f"{self._name}_imu", time_us * 1000),
                orientation=self._make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
                orientation_covariance=np.array([-1.0, *unknown[1:]]),  # no orientation
                angular_velocity=self._vector(rate), angular_velocity_covariance=unknown,
                linear_acceleration=self._vector(acceleration),
                linear_acceleration_covariance=unknown,
            )  # fmt: skip

    def close(self) -> None:
        """Finish the bag."""
        self._writer.close()

    def _write_image(self, stream: str, suffix: str, text: str, content: bytes, at: int) -> None:
        self._write(
            f"/{self._name}/{stream}/image_raw/compressed{suffix}",
            "sensor_msgs/msg/CompressedImage",
            at,
            header=self._header(f"{self._name}_{stream}", at),
            format=text,
            data=np.frombuffer(content, np.uint8),
        )

    def _write_lens(self, stream: str, lens: Intrinsics, at: int) -> None:
        region = self._make(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False,
        )  # fmt: skip
        projection = np.hstack([lens.matrix, np.zeros((3, 1))])
        self._write(
            f"/{self._name}/{stream}/camera_info",
            "sensor_msgs/msg/CameraInfo",
            at,
            header=self._header(f"{self._name}_{stream}", at),
            height=lens.height, width=lens.width,
            distortion_model="rational_polynomial", d=lens.distortion,
            k=lens.matrix.ravel(), r=np.eye(3).ravel(), p=projection.ravel(),
            binning_x=0, binning_y=0, roi=region,
        )  # fmt: skip

    def _transform(self, pose: np.ndarray) -> Any:
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        return self._make(
            "geometry_msgs/msg/Transform",
            translation=self._vector(pose[:3, 3]),
            rotation=self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        )

    def _vector(self, values: np.ndarray) -> Any:
        x, y, z = map(float, values)
        return self._make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def _header(self, frame: str, at: int) -> Any:
        seconds, nanoseconds = divmod(at, 1_000_000_000)
        stamp = self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        return self._make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def _make(self, type_name: str, **fields: Any) -> Any:
        return self._store.types[type_name](**fields)

    def _write(self, topic: str, type_name: str, at: int, **fields: Any) -> None:
        if topic not in self._topics:
            added = self._writer.add_connection(topic, type_name, typestore=self._store)
            self._topics[topic] = added
        content = self._store.serialize_cdr(self._make(type_name, **fields), type_name)
        self._writer.write(self._topics[topic], at, content)
