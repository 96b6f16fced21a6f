"""Stage ``frames``: recordings to synchronised frame sets.

Colour packets are copied as recorded, depth is kept without loss; nothing is decoded. Memory does
not grow with the length of the recordings, apart from 8 bytes an image for its time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.camera.extrinsics_files import Extrinsics, read_extrinsics
from intercap_core.camera.intrinsics import Intrinsics
from intercap_core.camera.rig import Camera, Rig
from intercap_core.capture.k4a import Recording, imu_samples
from intercap_core.capture.synchronise import SetTable, nearest_images, synchronise
from intercap_core.config import FramesSettings, SequenceEntry
from intercap_core.errors import UserError
from intercap_core.project import digest
from intercap_core.schemas import FRAMES

COLOUR_BUFFER_BYTES = 4 << 20


@dataclass
class _View:
    """What is known of one camera: its lenses, the times of its images, and what is wrong."""

    name: str
    camera: Camera | None = None
    fps: float = 0.0
    colour_times: list[int] = field(default_factory=list)  # device time, microseconds
    depth_times: list[int] = field(default_factory=list)  # device time, microseconds
    depth_delay_us: int = 0
    gravity: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))
    truncated: bool = False
    notes: list[str] = field(default_factory=list)

    @property
    def present(self) -> bool:
        return self.camera is not None and bool(self.colour_times)


def run(
    *,
    sequence: SequenceEntry,
    output: Path,
    settings: FramesSettings,
    frames_to_drop: Sequence[int] = (),
) -> None:
    """Write the frames artefact of one sequence.

    Reads ``<camera>.mkv`` in the sequence's folder of recordings, and the camera poses of its
    calibration. A camera without a readable recording or without a pose is kept with
    ``present`` = False and a note; so are shortened recordings. The frame of the poses stays that
    of the calibration's master, also where the master's own recording is missing. Sets listed in
    ``frames_to_drop`` get no image. Raises UserError where no camera (or none with depth) can be
    used, and for an unreadable calibration or a set to drop that is not there.
    """
    extrinsics = read_extrinsics(sequence.calibration)
    names = _camera_names(sequence, extrinsics)
    with artefacts.write(output, FRAMES, settings_digest=digest(settings)) as writer:
        views = [_extract(name, sequence, extrinsics, writer) for name in names]
        _require_usable(views, sequence)
        clock = _clock_of(views, names.index(extrinsics.master))
        _set_aside_other_clocks(views, clock)
        table, depth_index = _frame_sets(views, clock, settings)
        _note_shortcomings(views, table)
        dropped = _dropped(len(table.times_us), frames_to_drop, sequence)
        colour_index, depth_index = (
            np.where(dropped[:, None], -1, index) for index in (table.index, depth_index)
        )
        skew = np.where(colour_index < 0, np.nan, table.skew_us * 1e-6)

        rig = Rig(tuple(_camera_or_placeholder(view, views, extrinsics) for view in views))
        for key, values in rig.datasets().items():
            writer.put(key, values)
        writer.put("master_from_colour", rig.master_from_colour)
        writer.put("gravity", np.stack([view.gravity for view in views]))
        writer.put("present", [view.present for view in views])
        writer.put("truncated", [view.truncated for view in views])
        writer.put("note", ["; ".join(view.notes) for view in views])
        writer.put("times", (table.times_us - table.times_us[0]) * 1e-6)
        writer.put("dropped", dropped)
        writer.put("colour_index", colour_index)
        writer.put("depth_index", depth_index)
        writer.put("skew", skew)
        writer.attributes.update(
            sequence=sequence.sequence, master=extrinsics.master, fps=views[clock].fps
        )


def _camera_names(sequence: SequenceEntry, extrinsics: Extrinsics) -> list[str]:
    """All cameras that have a pose, in the calibration's order, then those with a file alone."""
    folder = sequence.recordings
    if not folder.is_dir():
        raise UserError(
            f"{folder}: sequence {sequence.sequence!r} has no such folder of recordings; correct "
            "'recordings' in the table of sequences"
        )
    known = list(extrinsics.master_from_colour)
    return known + sorted({path.stem for path in folder.glob("*.mkv")} - set(known))


def _extract(
    name: str, sequence: SequenceEntry, extrinsics: Extrinsics, writer: artefacts.Writer
) -> _View:
    """Copy one recording's images into the artefact."""
    view = _View(name)
    path = sequence.recordings / f"{name}.mkv"
    pose = extrinsics.master_from_colour.get(name)
    if pose is None:
        view.notes.append(f"no pose in {sequence.calibration.name}; add the camera there")
        return view
    if not path.exists():
        view.notes.append(f"no recording {path.name}")
        return view
    try:
        with Recording(path) as recording:
            view.camera = recording.camera(name, pose)
            _copy_images(recording, view, writer)
    except UserError as error:
        view.notes.append(str(error).replace(f"{sequence.recordings}/", ""))
        view.camera = None
    return view


def _copy_images(recording: Recording, view: _View, writer: artefacts.Writer) -> None:
    info = recording.info
    view.fps, view.depth_delay_us = info.fps, info.depth_delay_us
    group = f"cameras/{view.name}"
    colour = writer.stream(f"{group}/colour")
    depth = None
    if view.camera is not None and view.camera.depth is not None:
        lens = view.camera.depth
        depth = writer.stream(f"{group}/depth", (lens.height, lens.width))
    offsets, buffer = [0], bytearray()
    acceleration, samples = np.zeros(3), 0
    for packet in recording.packets():
        if packet.kind == "colour":
            view.colour_times.append(packet.device_time_us)
            offsets.append(offsets[-1] + len(packet.content))
            buffer += packet.content
            if len(buffer) >= COLOUR_BUFFER_BYTES:
                colour.append(np.frombuffer(bytes(buffer), np.uint8))
                buffer.clear()
        elif packet.kind == "depth" and depth is not None:
            view.depth_times.append(packet.device_time_us)
            depth.append(recording.depth_image(packet.content)[None])
        elif packet.kind == "imu":
            values = imu_samples(packet.content)[:, :3]
            acceleration += values.sum(axis=0)
            samples += len(values)
    colour.append(np.frombuffer(bytes(buffer), np.uint8))
    writer.put(f"{group}/colour_offsets", offsets)
    writer.put(f"{group}/colour_time", np.array(view.colour_times, np.int64))
    if depth is not None:
        writer.put(f"{group}/depth_time", np.array(view.depth_times, np.int64))
    else:
        view.notes.append("no depth track")
    if info.truncated:
        view.truncated = True
        view.notes.append(
            f"the file is cut off: {len(view.colour_times)} colour and {len(view.depth_times)} "
            "depth images could be read"
        )
    elif not view.colour_times:
        view.notes.append("holds no colour image")
    if recording.broken_packets:
        view.notes.append(f"{recording.broken_packets} damaged packets left out")
    rotation = recording.colour_from_accelerometer()
    if samples and rotation is not None and np.linalg.norm(acceleration) > 0:
        # At rest the sensor feels the floor's push, which is up.
        view.gravity = rotation @ (-acceleration / np.linalg.norm(acceleration))


def _require_usable(views: list[_View], sequence: SequenceEntry) -> None:
    reasons = "; ".join(f"{view.name}: {', '.join(view.notes)}" for view in views if view.notes)
    if not any(view.present for view in views):
        raise UserError(
            f"sequence {sequence.sequence!r}: no camera in {sequence.recordings} can be used "
            f"({reasons}); put the recordings there as <camera>.mkv"
        )
    if not any(view.present and view.depth_times for view in views):
        raise UserError(
            f"sequence {sequence.sequence!r}: no camera in {sequence.recordings} has depth "
            f"({reasons}); record with a depth mode"
        )


def _clock_of(views: list[_View], master: int) -> int:
    """The camera whose images define the sets: the master, or the first that is there."""
    if views[master].present:
        return master
    clock = next(index for index, view in enumerate(views) if view.present)
    views[master].notes.append(f"frame sets follow {views[clock].name}")
    return clock


def _set_aside_other_clocks(views: list[_View], clock: int) -> None:
    """A device that ran without the sync cable counts from its own start: of no use here."""
    period_us = 1e6 / views[clock].fps
    first, last = min(views[clock].colour_times), max(views[clock].colour_times)
    for view in views:
        if not view.present:
            continue
        if min(view.colour_times) > last + period_us or max(view.colour_times) < first - period_us:
            view.notes.append(
                f"its device times ({min(view.colour_times) / 1e6:.1f} to "
                f"{max(view.colour_times) / 1e6:.1f} s) do not overlap those of "
                f"{views[clock].name} ({first / 1e6:.1f} to {last / 1e6:.1f} s); connect the sync "
                "cables and record again"
            )
            view.camera = None


def _frame_sets(
    views: list[_View], clock: int, settings: FramesSettings
) -> tuple[SetTable, np.ndarray]:
    """Return the table of colour images and the index (T, C) of the depth images beside them."""
    max_skew_us = settings.max_skew_ms * 1000
    period_us = 1e6 / views[clock].fps
    if max_skew_us >= period_us / 2:
        raise UserError(
            f"settings: frames.max_skew_ms is {settings.max_skew_ms}, the recordings have "
            f"{views[clock].fps:g} frames a second; choose less than {period_us / 2000:.1f}"
        )
    times = [np.array(view.colour_times if view.present else [], np.int64) for view in views]
    table = synchronise(times, period_us=period_us, max_skew_us=max_skew_us, master=clock)
    depth_index = np.full(table.index.shape, -1, np.int32)
    for camera, view in enumerate(views):
        if view.present:
            undelayed = np.array(view.depth_times, np.int64) - view.depth_delay_us
            depth_index[:, camera] = nearest_images(table.times_us, undelayed, max_skew_us)
    return table, depth_index


def _note_shortcomings(views: list[_View], table: SetTable) -> None:
    for camera, view in enumerate(views):
        if not view.present:
            continue
        seen = np.flatnonzero(table.index[:, camera] >= 0)
        if table.unmatched[camera]:
            view.notes.append(f"{table.unmatched[camera]} images fit no frame set")
        if not len(seen):
            continue
        holes = int(seen[-1] - seen[0] + 1 - len(seen))
        early = len(table.times_us) - 1 - int(seen[-1])
        if holes:
            view.notes.append(f"no image in {holes} frame sets between its first and last")
        if seen[0]:
            view.notes.append(f"begins {seen[0]} frame sets late")
        if early:
            view.truncated = True
            view.notes.append(f"ends {early} frame sets early")


def _dropped(count: int, frames_to_drop: Sequence[int], sequence: SequenceEntry) -> np.ndarray:
    dropped = np.zeros(count, bool)
    beyond = [frame for frame in frames_to_drop if not 0 <= frame < count]
    if beyond:
        raise UserError(
            f"sequence {sequence.sequence!r}: drop_frames holds {beyond[0]}, the recording has "
            f"frame sets 0 to {count - 1}; correct the annotation"
        )
    dropped[list(frames_to_drop)] = True
    return dropped


def _camera_or_placeholder(view: _View, views: list[_View], extrinsics: Extrinsics) -> Camera:
    """The camera, or for one that is absent a stand-in without depth that keeps the C axis whole.

    The stand-in has the image size of a camera that is there and a plain lens; ``present`` says
    that nothing of it may be used but its pose.
    """
    if view.present and view.camera is not None:
        return view.camera
    like = next(v.camera for v in views if v.present and v.camera is not None).colour
    plain = Intrinsics(like.width, like.height, like.fx, like.fy, like.cx, like.cy)
    pose = extrinsics.master_from_colour.get(view.name, np.eye(4))
    return Camera(view.name, plain, None, None, pose)
