"""Annotation of a sequence: contact, object poses, floor, subject, cameras' starts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import (
    Discriminator,
    Field,
    Tag,
    model_validator,
)

from intercap_core.config_types import CameraName, FrameNumber, Model, Position, Radians, Seconds
from intercap_core.schemas import CONTACT_REGIONS

MIN_FLOOR_SPREAD_M = 0.02  # points closer to one line do not determine a plane

# A start that is read off a time code or a clap has the uniform error of one frame,
# 1/25/sqrt(12) s = 12 ms, once in the image and once on the clock: together 16 ms, rounded up.
START_SIGMA_S = 0.02

StartSigma = Annotated[float, Field(strict=True, gt=0.0, le=10.0)]

ANY_REGION = "any"

ContactPart = Literal[(*CONTACT_REGIONS, ANY_REGION)]  # type: ignore[valid-type]


class ContactInterval(Model):
    """Interval in which one body part touches the object."""

    part: ContactPart
    """Contact region of the body; any = the region is unknown, and no region is in contact outside
    of the annotated intervals."""
    start: FrameNumber
    """First frame set in contact, from 0."""
    end: FrameNumber
    """First frame set after the contact. An interval with end = start is ignored with a warning."""
    uncertain: Literal["start", "end", "both"] | None = None
    """Ends that the observed distance may move by ``joint.annotation_uncertainty_frames``; absent =
    none: the statement holds exactly."""

    @model_validator(mode="after")
    def _forward(self) -> ContactInterval:
        if self.end < self.start:
            raise ValueError(f"interval is reversed: start {self.start}, end {self.end}")
        return self

    @property
    def ends(self) -> tuple[tuple[int, bool], tuple[int, bool]]:
        """Frame of the start and of the end, each with whether it is uncertain."""
        return (
            (self.start, self.uncertain in ("start", "both")),
            (self.end, self.uncertain in ("end", "both")),
        )


class ObjectPose(Model):
    """The object's pose in one frame, in the master camera's frame."""

    frame: FrameNumber = 0
    """Frame set of the pose."""
    rotation_vector: tuple[Radians, Radians, Radians]
    """Rotation of master_from_object, axis times angle, radians."""
    translation: Position
    """Translation of master_from_object (position of the mesh's origin), metres."""
    sigma_m: Annotated[float, Field(gt=0.0, le=1.0)] = 0.01
    """Standard deviation of the object's centre along each axis, metres."""
    sigma_degrees: Annotated[float, Field(gt=0.0, le=90.0)] = 5.0
    """Standard deviation of the rotation about each axis, degrees."""


class ExchangedSides(Model):
    """Frames in which a detector exchanged the subject's left and right."""

    start: FrameNumber
    """First frame set of the interval, from 0."""
    end: FrameNumber
    """First frame set after the interval."""
    camera: CameraName | None = None
    """Name of the camera, as in the calibration; absent = all cameras."""

    @model_validator(mode="after")
    def _forward(self) -> ExchangedSides:
        if self.end <= self.start:
            raise ValueError(f"no frame from start {self.start} to end {self.end}")
        return self


class SubjectPoint(Model):
    """A pixel on the subject, for recordings of several people."""

    camera: str
    """Name of the camera, as in the calibration."""
    frame: FrameNumber = 0
    """Frame set of the image."""
    x: float
    """Pixels from the left edge of the recorded colour image."""
    y: float
    """Pixels from the upper edge of the recorded colour image."""

    def fault(self, sizes: Mapping[str, tuple[int, int]]) -> str | None:
        """Error message if the point is in no image, otherwise None.

        Args:
            sizes: width and height of each camera's images, pixels.
        """
        if self.camera not in sizes:
            return _no_camera(self.camera, list(sizes))
        width, height = sizes[self.camera]
        if not (0 <= self.x < width and 0 <= self.y < height):
            return (
                f"is at x {self.x:g}, y {self.y:g}; camera {self.camera} has {width} x {height} "
                "pixels"
            )
        return None


def _no_camera(name: str, names: Sequence[str]) -> str:
    return f"names camera {name!r}; the recording has {', '.join(names)}"


def floor_spread(points: Sequence[Position] | np.ndarray) -> float:
    """Root mean square distance of points (N, 3) from their best-fitting line, metres.

    It is measured within their best-fitting plane.
    """
    at = np.array(points, np.float64)
    values = np.linalg.svd(at - at.mean(0), compute_uv=False)
    return float(values[1] / np.sqrt(len(at)))


class StatedStart(Model):
    """Start of one camera."""

    seconds: Seconds
    """Time of its first image on a clock shared by all cameras, seconds."""
    sigma: StartSigma | None = None
    """Standard deviation, seconds; absent = starts_sigma."""


Start = Annotated[
    Annotated[Seconds, Tag("number")] | Annotated[StatedStart, Tag("entries")],
    Discriminator(lambda value: "number" if not isinstance(value, dict | Model) else "entries"),
]


class RecordingExtent(NamedTuple):
    """Extent of a recording, within which annotations must lie."""

    frames: int
    """Number of frame sets."""
    sizes: dict[str, tuple[int, int]]
    """Width and height of each camera's images, pixels."""
    master: str
    """Name of the master camera."""


STATED_EMPTY = ("contact",)  # sections in which an empty list is not the same as no list


class Annotation(Model):
    """annotations/<sequence>.yaml; every section is optional."""

    contact: tuple[ContactInterval, ...] | None = None
    """Intervals in which body parts touch the object; absent = detect contact; an empty list = no
    contact in the whole sequence."""
    object_poses: tuple[ObjectPose, ...] = ()
    """Object poses in some frames. The track agrees with them within their deviations and is
    extrapolated from them in frames that show nothing of the object; empty = search."""
    object_pose: ObjectPose | None = None
    """Short form of ``object_poses`` for a single frame."""
    floor: tuple[Position, ...] | None = None
    """Three or more points of the floor in the master camera's frame, metres; absent = estimate."""
    subject: tuple[SubjectPoint, ...] = ()
    """Points on the subject, for recordings of several people; several points if the subject
    leaves and returns. Absent = the person who handles the object, otherwise the one seen most."""
    left_right: tuple[ExchangedSides, ...] = ()
    """Intervals in which a detector exchanged left and right; the stage person exchanges them
    back."""
    drop_frames: tuple[FrameNumber, ...] = ()
    """Frame sets to treat as not recorded."""
    starts: dict[CameraName, Start] | None = None
    """Time of each camera's first image on one clock with any origin, seconds, optionally with a
    standard deviation. Must include the master. Absent = estimated from motion and sound."""
    starts_sigma: StartSigma = START_SIGMA_S
    """Standard deviation of starts without their own, seconds."""

    @model_validator(mode="after")
    def _starts_of_several_cameras(self) -> Annotation:
        if self.starts is None and "starts_sigma" in self.model_fields_set:
            raise ValueError("starts_sigma is set without starts")
        if self.starts is not None and len(self.starts) < 2:
            raise ValueError("starts names fewer than two cameras; name the master and others")
        return self

    @model_validator(mode="after")
    def _floor_points(self) -> Annotation:
        if self.floor is not None and len(self.floor) < 3:
            raise ValueError(f"floor has {len(self.floor)} points, a plane needs 3 or more")
        if self.floor is not None and floor_spread(self.floor) < MIN_FLOOR_SPREAD_M:
            raise ValueError(
                f"the floor points lie on one line within {MIN_FLOOR_SPREAD_M * 1000:.0f} mm; add "
                "a point away from it"
            )
        return self

    @model_validator(mode="after")
    def _one_pose_a_frame(self) -> Annotation:
        if self.object_pose is not None and self.object_poses:
            raise ValueError("object_pose and object_poses are both given; move it into the list")
        first: dict[int, int] = {}
        for index, pose in enumerate(self.object_poses):
            other = first.setdefault(pose.frame, index)
            if other != index:
                raise ValueError(
                    f"object_poses[{other}] and object_poses[{index}] both describe frame "
                    f"{pose.frame}; keep one"
                )
        return self

    @property
    def poses(self) -> tuple[ObjectPose, ...]:
        """The object's annotated poses, ordered by frame."""
        given = self.object_poses if self.object_pose is None else (self.object_pose,)
        return tuple(sorted(given, key=lambda pose: pose.frame))

    def check_object(self, name: str | None) -> str | None:
        """Error message if the sequence has no object (``name`` None) but annotations of one."""
        if name is None:
            for section in ("contact", "object_pose", "object_poses"):
                if getattr(self, section):
                    return f"{section} is annotated, and the sequence names no object"
        return None

    @property
    def names_cameras(self) -> bool:
        """Whether an entry names a camera."""
        return bool(self.subject or self.starts) or any(sides.camera for sides in self.left_right)

    @property
    def stated_starts(self) -> dict[str, tuple[float, float]]:
        """Start and its standard deviation by camera, seconds; empty without annotated starts."""
        stated = {}
        for name, start in (self.starts or {}).items():
            if isinstance(start, StatedStart):
                stated[name] = (start.seconds, start.sigma or self.starts_sigma)
            else:
                stated[name] = (start, self.starts_sigma)
        return stated

    def check_cameras(self, names: Sequence[str], master: str) -> str | None:
        """Error message if an entry names an unknown camera or ``starts`` lacks the master."""
        for index, point in enumerate(self.subject):
            if point.camera not in names:
                return f"subject[{index}] {_no_camera(point.camera, names)}"
        for index, sides in enumerate(self.left_right):
            if sides.camera is not None and sides.camera not in names:
                return f"left_right[{index}] {_no_camera(sides.camera, names)}"
        for name in self.starts or ():
            if name not in names:
                return f"starts {_no_camera(name, names)}"
        if self.starts and master not in self.starts:
            return (
                f"starts lacks {master}, the master; add its start (0 if the others are relative "
                "to it)"
            )
        return None

    def check_recording(self, recorded: RecordingExtent) -> str | None:
        """Error message if an entry lies outside of the recording, otherwise None."""
        problem = self.check_frames(recorded.frames)
        if problem:
            return problem
        for index, point in enumerate(self.subject):
            problem = point.fault(recorded.sizes)
            if problem:
                return f"subject[{index}] {problem}"
        return self.check_cameras(list(recorded.sizes), recorded.master)

    def check_frames(self, count: int) -> str | None:
        """Error message if an entry lies beyond the recording's ``count`` frame sets, or None."""
        limits = [  # entry, its number, and the largest number that the recording allows
            *((f"contact[{i}].end is", c.end, count) for i, c in enumerate(self.contact or ())),
            *((f"object_poses[{i}].frame is", p.frame, count - 1)
              for i, p in enumerate(self.object_poses)),
            *((f"left_right[{i}].end is", s.end, count) for i, s in enumerate(self.left_right)),
            *((f"subject[{i}].frame is", s.frame, count - 1) for i, s in enumerate(self.subject)),
            *(("drop_frames holds", frame, count - 1) for frame in self.drop_frames),
        ]  # fmt: skip
        if self.object_pose is not None:
            limits.append(("object_pose.frame is", self.object_pose.frame, count - 1))
        for entry, number, largest in limits:
            if number > largest:
                return f"{entry} {number}, the recording has {count} frames"
        if count and len(set(self.drop_frames)) == count:
            return f"drop_frames drops all {count} frames of the recording"
        return None
