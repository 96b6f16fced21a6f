"""Lenses of ``sensor_msgs/CameraInfo`` and poses of static transforms (``/tf_static``)."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.errors import UserError
from intercap_core.formats.calibration.extrinsics import Extrinsics, relate_to_master
from intercap_core.formats.calibration.opencv import opencv_lens
from intercap_core.formats.recordings.ros.bag import Bag
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.transforms import invert, is_rigid, rigid
from intercap_core.inputs.files import quoted

STATIC_TRANSFORMS = "/tf_static"
# Distortion models in lower case whose coefficients are OpenCV's k1, k2, p1, p2, k3, ...: those of
# ROS, and those of RealSense. The RealSense SDK projects with the same polynomial; its "inverse"
# and "modified" models scale the tangential part too, by less than 0.05 px for a D400's lens.
_OPENCV_MODELS = (
    "plumb_bob", "rational_polynomial",
    "none", "brown conrady", "inverse brown conrady", "modified brown conrady",
)  # fmt: skip


def read_lens(info: Any, where: str, *, rectified: bool = False) -> Intrinsics:
    """Make a lens of a CameraInfo message.

    Raises UserError, beginning with ``where``, for a model that is not supported and for numbers
    that describe no lens.

    Args:
        info: the message.
        where: bag and topic.
        rectified: whether the images were rectified, so that the projection matrix holds.
    """
    matrix, coefficients, projection = (_numbers(info, name) for name in ("k", "d", "p"))
    model = str(info.distortion_model).strip()
    size = (int(info.width), int(info.height))
    if rectified and projection[0] > 0:
        return opencv_lens(size, projection.reshape(3, 4)[:, :3], np.zeros(4), where)
    no_distortion = not coefficients.any()
    if model.lower() not in _OPENCV_MODELS and not (model == "" and no_distortion):
        raise UserError(
            f"{where}: its distortion model is {quoted(model)}, expected plumb_bob or "
            "rational_polynomial; record images that were rectified (image_rect)"
        )
    if no_distortion:
        coefficients = np.zeros(4)
    return opencv_lens(size, matrix.reshape(3, 3), coefficients, where)


def states_lens(info: Any) -> bool:
    """Whether a CameraInfo message states a lens; drivers of uncalibrated cameras write zeros."""
    return bool(_numbers(info, "k").any() or _numbers(info, "p").any())


def _numbers(info: Any, name: str) -> np.ndarray:
    """A field of a CameraInfo message; ROS 1 names it in capitals."""
    return np.asarray(getattr(info, name, getattr(info, name.upper(), None)), np.float64)


class StaticTransforms:
    """Poses of coordinate frames relative to each other."""

    def __init__(self, bags: Iterable[Bag]) -> None:
        self._parent_of: dict[str, tuple[str, np.ndarray]] = {}
        for bag in bags:
            for _, _, message in bag.messages(STATIC_TRANSFORMS):
                for stamped in message.transforms:
                    self._add(stamped, f"{bag.path}: {STATIC_TRANSFORMS}")

    def _add(self, stamped: Any, where: str) -> None:
        child, parent = _name(stamped.child_frame_id), _name(stamped.header.frame_id)
        pose = transform_matrix(stamped.transform)
        if not is_rigid(pose):
            raise UserError(
                f"{where}: the transform from {quoted(child)} to {quoted(parent)} is not rigid; "
                "correct the node that publishes it, and record again"
            )
        self._parent_of[child] = (parent, pose)

    @property
    def is_empty(self) -> bool:
        """Whether there is no transform."""
        return not self._parent_of

    def root_from(self, frame: str) -> tuple[str, np.ndarray]:
        """Topmost frame above ``frame``, and the pose (4, 4) of ``frame`` in it, metres."""
        at, pose, seen = _name(frame), np.eye(4), set[str]()
        while at in self._parent_of and at not in seen:
            seen.add(at)
            at, step = self._parent_of[at]
            pose = step @ pose
        return at, pose

    def between(self, target: str, source: str) -> np.ndarray | None:
        """Return target_from_source (4, 4), metres; None if the frames are not connected."""
        (root, root_from_target), (other, root_from_source) = map(self.root_from, (target, source))
        return invert(root_from_target) @ root_from_source if root == other else None

    def extrinsics(self, path: Path, frames: dict[str, str]) -> Extrinsics:
        """Poses of cameras, the first of which is the master.

        Raises UserError if the cameras are not connected.

        Args:
            path: recordings, for messages.
            frames: coordinate frame of each camera's colour images by the camera's name.
        """
        poses = {}
        master, frame_of_master = next(iter(frames.items()))
        root, _ = self.root_from(frame_of_master)
        for name, frame in frames.items():
            other, poses[name] = self.root_from(frame)
            if other != root:
                raise UserError(
                    f"{path}: no static transform connects frame {quoted(frame)} of camera {name} "
                    f"with frame {quoted(frame_of_master)} of camera {master}; publish and record "
                    f"{STATIC_TRANSFORMS}, or name a rig file in the column calibration"
                )
        return relate_to_master(path, master, poses)


def transform_matrix(transform: Any) -> np.ndarray:
    """Return the matrix (4, 4) of a geometry_msgs/Transform; NaN for a quaternion of length 0."""
    q, t = transform.rotation, transform.translation
    quaternion = np.array([q.x, q.y, q.z, q.w])
    length = np.linalg.norm(quaternion)
    rotation = np.full((3, 3), np.nan)
    if np.isfinite(length) and length > 0.5:
        rotation = Rotation.from_quat(quaternion).as_matrix()
    return rigid(rotation, np.array([t.x, t.y, t.z]))


def _name(frame: str) -> str:
    """Name of a coordinate frame; tf of ROS 1 allowed a slash before it."""
    return str(frame).lstrip("/")
