"""Topics as nodes of ROS publish them: ``<camera>/<stream>/<image>`` and ``camera_info``.

Drivers of RealSense, Orbbec and Azure Kinect, and image_transport, name them so. ``<image>`` may
be followed by ``compressed`` or ``compressedDepth``.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Sequence

import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.recordings.ros.bag import Bag
from intercap_core.formats.recordings.ros.images import Kind
from intercap_core.formats.recordings.ros.lenses import StaticTransforms, read_lens
from intercap_core.formats.recordings.ros.streams import (
    IMAGE,
    IMAGE_TYPES,
    CameraStreams,
    Scheme,
    Stream,
    choose_topic,
    first_or_refuse,
    kind_of_topic,
)
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


def read(bag: Bag, name: str, preferred: Sequence[str]) -> CameraStreams:
    """Read the streams of a camera of :func:`list_cameras`.

    Raises UserError for a camera without colour, without CameraInfo, with several streams of one
    kind, and with depth in another coordinate frame that no static transform connects.
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
    colour, frame = _stream(bag, "colour", topics["colour"], preferred)
    if not topics["depth"]:
        return CameraStreams(colour, None, None, frame)
    depth, depth_frame = _stream(bag, "depth", topics["depth"], preferred)
    pose = np.eye(4) if frame == depth_frame else transforms.between(frame, depth_frame)
    if pose is None:
        raise UserError(
            f"{bag.path}: {depth.topic} is in frame {quoted(depth_frame)}, {colour.topic} in "
            f"{quoted(frame)}, and no static transform connects them; record /tf_static, or depth "
            "that is aligned to colour"
        )
    return CameraStreams(colour, depth, pose, frame)


def _cameras(bag: Bag) -> dict[str, list[str]]:
    """Topics with images by the path of their camera; of a stream's transports, raw images."""
    found: dict[str, dict[str, str]] = {}
    for topic in bag.topics.values():
        base = _TRANSPORT.sub("", topic.name)
        if topic.type not in IMAGE_TYPES or _OTHER_STREAM.search(base):
            continue
        folder = posixpath.dirname(base)
        is_stream = _STREAM.fullmatch(posixpath.basename(folder))
        streams = found.setdefault(posixpath.dirname(folder) if is_stream else folder, {})
        if base not in streams or topic.type == IMAGE:
            streams[base] = topic.name
    return {path.rstrip("/"): sorted(streams.values()) for path, streams in found.items()}


def _stream(
    bag: Bag, kind: str, topics: Sequence[str], preferred: Sequence[str]
) -> tuple[Stream, str]:
    """The stream of a kind and the coordinate frame of its images."""
    topic = choose_topic(bag, kind, topics, preferred)
    base = _TRANSPORT.sub("", topic)
    where = f"{posixpath.dirname(base)}/camera_info"
    info = first_or_refuse(bag, where, f"the lens of {topic}")
    rectified = "rect" in posixpath.basename(base)
    lens = read_lens(info, f"{bag.path}: {where}", rectified=rectified)
    frame = bag.first(topic).header.frame_id or info.header.frame_id
    return Stream(topic, lens), frame.lstrip("/")


SCHEME = Scheme("ROS", lambda bag: True, list_cameras, read)
