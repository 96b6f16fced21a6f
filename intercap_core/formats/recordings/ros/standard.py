"""Topics as nodes of ROS publish them: ``<camera>/<stream>/<image>`` and ``camera_info``.

Drivers of RealSense, Orbbec and Azure Kinect, and image_transport, name them so. ``<image>`` may
be followed by ``compressed`` or ``compressedDepth``.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.calibration.opencv import CalibratedCamera
from intercap_core.formats.recordings.ros.bag import Bag
from intercap_core.formats.recordings.ros.images import Kind
from intercap_core.formats.recordings.ros.lenses import StaticTransforms, read_lens, states_lens
from intercap_core.formats.recordings.ros.streams import (
    IMAGE,
    IMAGE_TYPES,
    IMU,
    CameraStreams,
    Scheme,
    Stream,
    acceleration,
    choose_topic,
    kind_of_topic,
)
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.inputs.files import quoted

# Topics of a compressed transport, below the topic of the images.
_TRANSPORT = re.compile(r"/(compressed|compressedDepth)$")
# Last part of the folder of a stream, which is not part of the camera's name.
_STREAM = re.compile(r"(.*_)?(rgb|colou?r|depth|stereo)(_.*|\d*)", re.IGNORECASE)
# Streams of a camera that are neither colour nor depth.
_OTHER_STREAM = re.compile(r"(^|[/_])(ir|infra\w*|confidence|mask|disparity)([/_\d]|$)", re.I)


def list_cameras(bag: Bag) -> list[str]:
    """Names of the cameras with images; of several, the last part of their topics if it differs."""
    paths = sorted(_cameras(bag))
    last = [path.rpartition("/")[2] for path in paths]
    if len(set(last)) == len(last):
        return last
    return [path.strip("/").replace("/", "_") for path in paths]


def read(
    bag: Bag, name: str, preferred: Sequence[str], known: CalibratedCamera | None
) -> CameraStreams:
    """Read the streams of a camera of :func:`list_cameras`.

    What the bag does not state of lenses and of the depth camera's pose is that of ``known``.
    Raises UserError for a camera without colour, without lens, with several streams of one kind,
    and with depth whose pose is unknown.
    """
    path = sorted(_cameras(bag))[list_cameras(bag).index(name)]
    topics: dict[Kind, list[str]] = {"colour": [], "depth": [], "other": []}
    for topic in _cameras(bag)[path]:
        topics[kind_of_topic(bag, topic)].append(topic)
    if not topics["colour"]:
        raise UserError(
            f"{bag.path}: has no colour images of camera {path or '/'}, only "
            f"{', '.join(_cameras(bag)[path])}; record its colour topic too"
        )
    transforms = StaticTransforms([bag])
    lens, depth_lens = (known.colour, known.depth) if known else (None, None)
    colour, frame = _stream(bag, "colour", topics["colour"], preferred, lens)
    accelerometer, rotation = _accelerometer(bag, path, frame, transforms)
    streams = CameraStreams(
        colour, frame=frame, accelerometer=accelerometer, colour_from_accelerometer=rotation
    )
    if not topics["depth"]:
        return streams
    depth, depth_frame = _stream(bag, "depth", topics["depth"], preferred, depth_lens)
    pose = np.eye(4) if frame == depth_frame else transforms.between(frame, depth_frame)
    if depth.lens is depth_lens or pose is None:
        pose = known.colour_from_depth if known else None
    if pose is None:
        raise UserError(
            f"{bag.path}: {depth.topic} is in frame {quoted(depth_frame)}, {colour.topic} in "
            f"{quoted(frame)}, and no static transform connects them; record /tf_static, or depth "
            "that is aligned to colour, or state the depth of the camera in column calibration"
        )
    return replace(streams, depth=depth, colour_from_depth=pose)


def _accelerometer(
    bag: Bag, path: str, frame: str, transforms: StaticTransforms
) -> tuple[str, np.ndarray | None]:
    """Topic below a camera's path whose first message has an acceleration; "" if there is none.

    Also returns the rotation (3, 3) from its axes to those of ``frame``; None if no static
    transform connects them.
    """
    for topic in sorted(bag.topics):
        if bag.topics[topic].msgtype == IMU and topic.startswith(f"{path}/"):
            message = bag.first(topic)
            if acceleration(message).any():
                pose = transforms.between(frame, message.header.frame_id)
                return topic, None if pose is None else pose[:3, :3]
    return "", None


def _cameras(bag: Bag) -> dict[str, list[str]]:
    """Topics with images by the path of their camera; of a stream's transports, raw images."""
    found: dict[str, dict[str, str]] = {}
    for name, topic in bag.topics.items():
        base = _TRANSPORT.sub("", name)
        if topic.msgtype not in IMAGE_TYPES or _OTHER_STREAM.search(base):
            continue
        folder = posixpath.dirname(base)
        is_stream = _STREAM.fullmatch(posixpath.basename(folder))
        streams = found.setdefault(posixpath.dirname(folder) if is_stream else folder, {})
        if base not in streams or topic.msgtype == IMAGE:
            streams[base] = name
    return {path.rstrip("/"): sorted(streams.values()) for path, streams in found.items()}


def _stream(
    bag: Bag, kind: str, topics: Sequence[str], preferred: Sequence[str], known: Intrinsics | None
) -> tuple[Stream, str]:
    """The stream of a kind and the coordinate frame of its images.

    ``known`` is the lens of a bag without CameraInfo, or with one that states no lens.
    """
    topic = choose_topic(bag, kind, topics, preferred)
    base = _TRANSPORT.sub("", topic)
    where = f"{posixpath.dirname(base)}/camera_info"
    info = bag.first(where)
    frame = bag.first(topic).header.frame_id or (info.header.frame_id if info else "")
    if info is not None and states_lens(info):
        rectified = "rect" in posixpath.basename(base)
        lens = read_lens(info, f"{bag.path}: {where}", rectified=rectified)
    elif known is not None:
        lens = known
    else:
        found = "has no message on" if info is None else "states no lens in"
        raise UserError(
            f"{bag.path}: {found} {where}, which belongs to {topic}; record this topic of a "
            f"calibrated camera, or state the {kind} lens in column calibration (in OpenCV's terms)"
        )
    return Stream(topic, lens), frame.lstrip("/")


SCHEME = Scheme(lambda bag: True, list_cameras, read)
