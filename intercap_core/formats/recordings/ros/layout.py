"""Layout ``ros``: bags of ROS 1 and ROS 2, one for all cameras or one for each.

Schemes of topics are tried in the order of :data:`SCHEMES`; a new one is one file and one entry.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.entries import SequenceEntry
from intercap_core.errors import MissingPackage, UserError
from intercap_core.formats.calibration.extrinsics import Extrinsics, check_camera_name
from intercap_core.formats.calibration.files import (
    RecordedCameras,
    read_calibration,
    refuse_scale,
)
from intercap_core.formats.calibration.opencv import CalibratedCamera, check_rate
from intercap_core.formats.recordings.encodings import DamagedImage, encoded_size
from intercap_core.formats.recordings.ros import orbbec, realsense, standard
from intercap_core.formats.recordings.ros.bag import Bag, find_bags, is_bag, name_of
from intercap_core.formats.recordings.ros.images import decode_colour, decode_depth
from intercap_core.formats.recordings.ros.lenses import STATIC_TRANSFORMS, StaticTransforms
from intercap_core.formats.recordings.ros.streams import (
    IMAGE_TYPES,
    CameraStreams,
    Scheme,
    Stream,
    acceleration,
)
from intercap_core.formats.recordings.source import (
    Accelerometer,
    CameraRecording,
    Image,
    RecordingLayout,
    RecordingPreview,
)
from intercap_core.formats.recordings.timestamps import frame_rate
from intercap_core.geometry.camera.rig import Camera, stereo_depth_noise
from intercap_core.inputs.files import name_some, quoted

SCHEMES: tuple[Scheme, ...] = (realsense.SCHEME, orbbec.SCHEME, standard.SCHEME)
RATE_IMAGES = 16  # first images, whose times give the rate
# A topic that ends earlier than the camera's other one by more has stopped, seconds.
STOPPED_S = 1.0


@dataclass(frozen=True)
class _Place:
    """Where a camera's recording is."""

    path: Path
    """The bag."""
    name: str
    """Name of the camera in its scheme."""
    fault: str = ""
    """Why the bag cannot be read."""


def find_cameras(recordings: Path) -> list[str]:
    """Names of the cameras in the bags of a folder; raises UserError as the layout does."""
    return sorted(_find_places(recordings)) if find_bags(recordings) else []


def _find_places(recordings: Path, preferred: Sequence[str] = ()) -> dict[str, _Place]:
    """Cameras by name: in a single bag that of their topics, else that of the file.

    Raises UserError if no bag has one of the ``preferred`` topics, unless a bag cannot be read.
    """
    bags = find_bags(recordings)
    places: dict[str, _Place] = {}
    topics: dict[str, str] = {}  # types by name
    for path in bags:
        fault = ""
        try:
            with Bag(path) as bag:
                names = _scheme_of(bag).list_cameras(bag)
                topics |= {topic: info.msgtype for topic, info in bag.topics.items()}
        except MissingPackage:
            raise
        except UserError as error:
            names, fault = [""], str(error)
        for name in names:
            own = name if name and (len(bags) == 1 or len(names) > 1) else name_of(path)
            check_camera_name(path, own)
            if own in places:
                raise UserError(
                    f"{recordings}: {places[own].path.name} and {path.name} both record a camera "
                    f"{own}; rename one of them"
                )
            places[own] = _Place(path, name, fault)
    if bags and not places:
        raise UserError(
            f"{recordings}: no bag has a topic of type sensor_msgs/Image or CompressedImage; it "
            f"has {name_some(sorted(topics), 8) or 'no messages'}"
        )
    images = sorted(topic for topic, kind in topics.items() if kind in IMAGE_TYPES)
    unknown = sorted(set(preferred).difference(images))
    if unknown and not any(place.fault for place in places.values()):
        raise UserError(
            f"{recordings}: column topics names {', '.join(map(quoted, unknown))}, the topics with "
            f"images are {', '.join(images)}; correct the column"
        )
    return places


def _scheme_of(bag: Bag) -> Scheme:
    return next(scheme for scheme in SCHEMES if scheme.recognises(bag))


class RosLayout(RecordingLayout):
    """The bags in a folder, or a folder that is a bag of ROS 2.

    Poses are those of static transforms if ``calibration`` is a bag or the folder of the
    recordings, else those of a rig file or of another calibration. Lenses are those in the bags,
    else those of the calibration.
    """

    def __init__(self, sequence: SequenceEntry) -> None:
        super().__init__(sequence)
        self._preferred = (sequence.topics or "").split()
        self._places = _find_places(sequence.recordings, self._preferred)
        self.names = sorted(self._places)
        self._known: dict[str, CalibratedCamera] = {}
        path, scale = sequence.calibration, sequence.calibration_scale
        if is_bag(path) or path == sequence.recordings:
            refuse_scale(path, scale)
            self.extrinsics = self._static_poses(path)
            return
        recorded = RecordedCameras(self.names)
        calibration = read_calibration(path, recorded, scale=scale, lenses=False)
        self._known, self.extrinsics = calibration.cameras, calibration.extrinsics

    def _static_poses(self, path: Path) -> Extrinsics:
        """Poses of the cameras that can be read; raises UserError if there are none.

        The faults of the others are added to ``pose_faults``.
        """
        places = dict(sorted(self._places.items()))
        self.pose_faults = {name: place.fault for name, place in places.items() if place.fault}
        readable = {name: place for name, place in places.items() if not place.fault}
        paths = {place.path for place in readable.values()} | ({path} if is_bag(path) else set())
        frames = {}
        with contextlib.ExitStack() as opened:
            bags = {path: opened.enter_context(Bag(path)) for path in sorted(paths)}
            for name, place in readable.items():
                try:
                    frames[name] = self._streams(bags[place.path], name).frame
                except UserError as error:
                    self.pose_faults[name] = str(error)
            if not frames:
                raise UserError(next(iter(self.pose_faults.values())))
            transforms = StaticTransforms(bags.values())
        if transforms.is_empty or not all(frames.values()):
            raise UserError(
                f"{path}: holds no static transforms of cameras ({STATIC_TRANSFORMS}); record that "
                "topic, or name a rig file in the column calibration"
            )
        return transforms.extrinsics(path, frames)

    def _streams(self, bag: Bag, name: str) -> CameraStreams:
        known = self._known.get(name)
        return _scheme_of(bag).read(bag, self._places[name].name, self._preferred, known)

    def open(self, name: str) -> CameraRecording:
        """Open the camera's streams.

        Raises UserError for a damaged bag, and if lenses are missing or topics are ambiguous.
        """
        place = self._places[name]
        if place.fault:
            raise UserError(place.fault)
        bag = Bag(place.path)
        try:
            streams = self._streams(bag, name)
            return RosRecording(bag, streams, name, self.extrinsics)
        except BaseException:
            bag.close()
            raise


class RosRecording(CameraRecording):
    """The two streams of one camera."""

    def __init__(self, bag: Bag, streams: CameraStreams, name: str, extrinsics: Extrinsics) -> None:
        self._bag, self._streams = bag, streams
        depth = streams.depth
        camera = Camera(
            name,
            streams.colour.lens,
            None if depth is None else depth.lens,
            streams.colour_from_depth,
            extrinsics.master_from_colour[name],
            stereo_depth_noise(depth.lens, streams.stereo_baseline_m) if depth else 0.0,
        )
        colour = streams.colour
        first = list(islice(bag.messages(colour.topic), RATE_IMAGES))
        times = np.array([_time_us(colour, recorded, message) for _, recorded, message in first])
        rate = round(frame_rate(times) or 30.0, 2)  # times are whole microseconds
        check_rate(rate, f"{bag.path}: {colour.topic}")
        super().__init__(bag.path, camera, fps=rate, serial=streams.serial)
        if not colour.times_us and not any(_stamp_ns(message) for _, _, message in first):
            self.timing = "by time of recording"
            self.notes.append("its headers state no times; images have the times of recording")

    def close(self) -> None:
        """Close the bag."""
        self._bag.close()

    def preview(self) -> RecordingPreview:
        """Inspect the first image and the number of messages."""
        topic = self._streams.colour.topic
        size, remark = None, ""
        with contextlib.suppress(DamagedImage):
            content, remark = decode_colour(self._bag.first(topic))
            size = encoded_size(content)
        count = self._bag.topics[topic].msgcount
        remarks = (f"colour images {remark}",) if remark else ()
        return RecordingPreview(size, count, (count - 1) / self.fps, remarks=remarks)

    def images(self) -> Iterator[Image]:
        """Yield the images of both topics; damaged colour becomes an empty image."""
        streams = {s.topic: s for s in (self._streams.colour, self._streams.depth) if s is not None}
        remarks: Counter[str] = Counter()
        last_ns: dict[str, int] = {}
        damaged, accelerometer = 0, Accelerometer()
        inertial = self._streams.accelerometer
        for topic, recorded, message in self._bag.messages(*streams, *[inertial] * bool(inertial)):
            if topic == inertial:
                accelerometer.add(acceleration(message)[None])
                continue
            stream, last_ns[topic] = streams[topic], recorded
            time_us = _time_us(stream, recorded, message)
            if stream is self._streams.depth:
                try:
                    yield Image("depth", time_us, decode_depth(message, stream.unit_m))
                except DamagedImage:
                    damaged += 1
                continue
            content, remark = b"", ""
            with contextlib.suppress(DamagedImage):
                content, remark = decode_colour(message)
            remarks[remark] += bool(remark)
            yield Image("colour", time_us, content)
        self.notes += [f"{n} colour images {text}" for text, n in remarks.items() if n]
        if damaged:
            self.notes.append(f"{damaged} damaged depth images left out")
        self._note_stop(last_ns)
        rotation, note = self._streams.colour_from_accelerometer, ""
        if rotation is not None:
            self.gravity, note = accelerometer.gravity(rotation)
        elif inertial:
            note = f"no pose of its accelerometer ({inertial}) is recorded: gravity is not used"
        self.notes += [note] if note else []

    def _note_stop(self, last_ns: dict[str, int]) -> None:
        """Note a topic that stops before the other one."""
        if len(last_ns) < 2:
            return
        (early, first), (late, last) = sorted(last_ns.items(), key=lambda item: item[1])
        if (last - first) * 1e-9 > STOPPED_S:
            self.notes.append(f"topic {early} stops {(last - first) * 1e-9:.1f} s before {late}")


def _time_us(stream: Stream, recorded: int, message: Any) -> int:
    """Device time of an image; its time of recording if the header states none."""
    known = stream.times_us.get(recorded)
    return known if known is not None else (_stamp_ns(message) or recorded) // 1000


def _stamp_ns(message: Any) -> int:
    """Time in the header, nanoseconds; 0 = not set."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
