"""Stage ``frames``: recordings to synchronised frame sets.

Colour images are copied in their recorded encoding, depth is stored without loss. Memory does not
grow with the length of the recordings, except by 8 bytes for the time of each image.

The *clock* is the camera whose device times define the frame sets, usually the master. An *epoch*
is a stretch of images between two resets of a device's clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.config import FramesSettings, digest
from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.calibration.extrinsics import Extrinsics
from intercap_core.formats.recordings.extract import ExtractedCamera, extract
from intercap_core.formats.recordings.layouts import open_layout
from intercap_core.formats.recordings.sound_delays import sound_starts
from intercap_core.formats.recordings.synchronise import (
    OUTLIER,
    SetTable,
    choose_epoch,
    clock_drift_us,
    distance_to,
    find_clock_jumps,
    nearest_images,
    split_into_epochs,
    synchronise,
)
from intercap_core.formats.recordings.timestamps import frame_rate
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.schemas import FRAMES


def run(
    *,
    sequence: SequenceEntry,
    output: Path,
    settings: FramesSettings,
    frames_to_drop: Sequence[int] = (),
) -> None:
    """Write the frames artefact of one sequence.

    A camera that has no usable recording or no pose, or that the settings exclude, keeps its index
    with ``present`` = False and a note. Poses are in the frame of the calibration's master, even if
    its recording is missing. Sets in ``frames_to_drop`` get no image.

    Raises:
        UserError: no camera can be used; the calibration is unreadable; a set to drop or a camera
            named in the settings does not exist.
    """
    layout = open_layout(sequence)
    extrinsics = layout.extrinsics
    known = list(extrinsics.master_from_colour)
    names = known + [name for name in layout.names if name not in known]
    used = _used(names, settings, sequence)
    with artefacts.write(output, FRAMES, settings_digest=digest(settings)) as writer:
        views = [
            extract(
                name,
                layout,
                writer,
                depth=settings.depth,
                stereo_baseline_m=settings.stereo_baseline_m,
            )
            if name in used
            else ExtractedCamera(name, notes=["left out (frames.cameras)"])
            for name in names
        ]
        _note_same_devices(views)
        _require_usable(views, sequence)
        master = names.index(extrinsics.master)
        _straighten_clocks(views, master)
        clock = _clock_of(views, master)
        _exclude_other_clocks(views, clock)
        table, depth_index = _frame_sets(views, clock, settings)
        _note_defects(views, table, clock)
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
        for key, values in _stated_world(sequence, extrinsics).items():
            writer.put(key, values)
        writer.put("present", [view.present for view in views])
        writer.put("truncated", [view.truncated for view in views])
        writer.put("note", ["; ".join(view.notes) for view in views])
        started, sigma = sound_starts([view.sound if view.present else None for view in views])
        if np.isfinite(started).any():
            writer.put("sound_start", started)
            writer.put("sound_start_sigma", sigma)
        writer.put("times", (table.times_us - table.times_us[0]) * 1e-6)
        writer.put("dropped", dropped)
        writer.put("colour_index", colour_index)
        writer.put("depth_index", depth_index)
        writer.put("skew", skew)
        writer.attributes.update(
            sequence=sequence.sequence, master=extrinsics.master, fps=views[clock].fps
        )


def _stated_world(sequence: SequenceEntry, extrinsics: Extrinsics) -> dict[str, np.ndarray]:
    """Up direction and floor point (3,) that the row of the sequence states, master's frame.

    Empty if the row states none.
    """
    axis = sequence.calibration_up
    if axis is None:
        return {}
    up = np.array([float(axis[-1] == name) for name in "xyz"]) * (-1 if axis[0] == "-" else 1)
    rotation = extrinsics.master_from_world[:3, :3]
    translation = extrinsics.master_from_world[:3, 3]
    stated = {"stated_up": rotation @ up}
    if sequence.calibration_floor is not None:
        stated["stated_floor"] = rotation @ (sequence.calibration_floor * up) + translation
    return stated


def _used(names: Sequence[str], settings: FramesSettings, sequence: SequenceEntry) -> set[str]:
    """The cameras that the settings include."""
    unknown = [name for name in settings.cameras if name not in names]
    if unknown:
        raise UserError(
            f"settings: frames.cameras names {unknown[0]!r}, the cameras of sequence "
            f"{sequence.sequence!r} are {', '.join(names)}; correct the settings"
        )
    return set(settings.cameras or names)


def _note_same_devices(views: list[ExtractedCamera]) -> None:
    """Note recordings with equal serial numbers; of two with the same images, exclude the
    second."""
    for first, second in combinations([view for view in views if view.present], 2):
        if first.source is None or second.source is None or first.serial != second.serial:
            continue
        if not (first.present and second.present):
            continue
        files = (first.source.name, second.source.name)
        cameras = f"cameras {first.name} ({files[0]}) and {second.name} ({files[1]})"
        note = ""
        if first.fingerprint == second.fingerprint and np.array_equal(
            first.colour_times, second.colour_times
        ):
            note = f"{cameras} hold the same images: {second.name} is left out"
            second.camera = None
        elif first.serial:
            note = (
                f"{cameras} have the same serial number {first.serial}: check which camera "
                "each was recorded with"
            )
        for view in (first, second):
            view.notes += [note] * bool(note)


def _require_usable(views: list[ExtractedCamera], sequence: SequenceEntry) -> None:
    """Raise UserError if no camera is present."""
    reasons = "; ".join(f"{view.name}: {', '.join(view.notes)}" for view in views if view.notes)
    if not any(view.present for view in views):
        raise UserError(
            f"sequence {sequence.sequence!r}: no camera in {sequence.recordings} can be used "
            f"({reasons}); put the recordings there as docs/recordings.md says"
        )


def _straighten_clocks(views: list[ExtractedCamera], master: int) -> None:
    """Undo jumps ahead of single clocks; if a clock was reset, keep only the epoch that overlaps
    the other cameras in time."""
    present = [view for view in views if view.present]
    _undo_jumps_ahead(present)
    epochs = {view.name: split_into_epochs(view.usable_times) for view in present}
    straight = [view for view in present if epochs[view.name].max() == 0]
    if not straight:
        first = views[master] if views[master].present else present[0]
        _keep_one_epoch(first, epochs[first.name], np.zeros(0))
        straight = [first]
        present.remove(first)
    reference = np.concatenate([view.usable_times for view in straight])
    for view in present:
        _keep_one_epoch(view, epochs[view.name], reference)


def _undo_jumps_ahead(views: list[ExtractedCamera]) -> None:
    """Move the images after a jump ahead of one camera's clock back by the jump, with a note."""
    times = [view.usable_times for view in views]
    for camera, view in enumerate(views):
        others = times[:camera] + times[camera + 1 :]
        for jump in find_clock_jumps(times[camera], others, 1e6 / view.fps):
            image = int(np.flatnonzero(view.colour_usable)[jump.image])
            view.notes.append(
                f"its device times jump ahead by {jump.ahead_us / 1e6:.1f} s before image {image}, "
                "those of the other cameras do not: later images were moved back by this; set no "
                "clock (NTP, PTP) during a recording"
            )
            view.colour_times = jump.undo(view.colour_times)
            view.depth_times = jump.undo(view.depth_times)


def _keep_one_epoch(view: ExtractedCamera, epoch: np.ndarray, reference_us: np.ndarray) -> None:
    """Mark images outside the best epoch as unusable.

    Args:
        epoch: epoch of each usable colour image, from 0; OUTLIER = time out of order.
        reference_us: device times of the other cameras' images.
    """
    period_us = 1e6 / view.fps
    kept = choose_epoch(view.usable_times, epoch, np.sort(reference_us), period_us)
    resets = int(epoch.max())
    wrong = int((epoch == OUTLIER).sum())
    if wrong:
        view.notes.append(f"{wrong} images with device times out of order left out")
    if resets:
        others = int(((epoch != kept) & (epoch != OUTLIER)).sum())
        view.notes.append(
            f"its device times jump back {resets} times: {others} images outside the stretch of "
            f"{int((epoch == kept).sum())} in the other cameras' time left out"
        )
    view.colour_usable[view.colour_usable] = epoch == kept
    if not len(view.depth_times):
        return
    depth = split_into_epochs(view.depth_times)
    if depth.max() != resets:
        kept = choose_epoch(view.depth_times, depth, view.usable_times, period_us)
    view.depth_usable &= depth == kept


def _overlap(view: ExtractedCamera, other: ExtractedCamera) -> bool:
    """Whether two cameras recorded at the same time, by their device times."""
    period_us = 1e6 / view.fps
    mine, others = view.usable_times, other.usable_times
    return bool(others.min() <= mine.max() + period_us and others.max() >= mine.min() - period_us)


def _clock_of(views: list[ExtractedCamera], master: int) -> int:
    """Index of the camera whose images define the sets: it overlaps most other cameras in time.

    Of several such cameras it is the master, or the first that is present.
    """
    present = [index for index, view in enumerate(views) if view.present]
    overlaps = {i: sum(_overlap(views[i], views[other]) for other in present) for i in present}
    clock = max(present, key=lambda index: (overlaps[index], index == master))
    if clock != master:
        views[master].notes.append(f"frame sets follow {views[clock].name}")
    return clock


def _exclude_other_clocks(views: list[ExtractedCamera], clock: int) -> None:
    """Exclude cameras whose device times do not overlap those of the clock.

    Without a sync cable, a device counts time from its own start.
    """
    for view in [view for view in views if view.present]:
        if _overlap(views[clock], view):
            continue
        mine, other = (
            times[[0, -1]] / 1e6 for times in (view.usable_times, views[clock].usable_times)
        )
        view.notes.append(
            f"its device times ({mine[0]:.1f} to {mine[1]:.1f} s) do not overlap those of "
            f"{views[clock].name} ({other[0]:.1f} to {other[1]:.1f} s); give times of one clock, "
            "or connect the sync cables and record again"
        )
        view.camera = None


def _frame_sets(
    views: list[ExtractedCamera], clock: int, settings: FramesSettings
) -> tuple[SetTable, np.ndarray]:
    """Return the table of colour images and the index (T, C) of the depth images; -1 = none.

    Indices count all recorded images of a camera, usable or not.
    """
    max_skew_us = settings.max_skew_ms * 1000
    period_us = 1e6 / views[clock].fps
    if max_skew_us >= period_us / 2:
        raise UserError(
            f"settings: frames.max_skew_ms is {settings.max_skew_ms}, the recordings have "
            f"{views[clock].fps:g} frames a second; choose less than {period_us / 2000:.1f}"
        )
    no_images = np.zeros(0, np.int64)
    times = [view.usable_times if view.present else no_images for view in views]
    table = synchronise(times, period_us=period_us, max_skew_us=max_skew_us, master=clock)
    depth_index = np.full(table.index.shape, -1, np.int32)
    for camera, view in enumerate(views):
        if not view.present:
            continue
        # from numbers among the usable images to numbers among all images
        has = table.index[:, camera] >= 0
        table.index[has, camera] = np.flatnonzero(view.colour_usable)[table.index[has, camera]]
        undelayed = view.depth_times[view.depth_usable] - view.depth_delay_us
        index = nearest_images(table.times_us, undelayed, max_skew_us)
        has = index >= 0
        depth_index[has, camera] = np.flatnonzero(view.depth_usable)[index[has]]
    return table, depth_index


def _note_defects(views: list[ExtractedCamera], table: SetTable, clock: int) -> None:
    """Note gaps, other frame rates, unmatched images, clock drift, and late or early ends."""
    period_us = 1e6 / views[clock].fps
    sets_per_s = frame_rate(table.times_us) or views[clock].fps
    views[clock].notes += table.describe_gaps(period_us)
    for camera, view in enumerate(views):
        if not view.present:
            continue
        seen = np.flatnonzero(table.index[:, camera] >= 0)
        own = frame_rate(view.usable_times) or sets_per_s
        ratio = own / sets_per_s
        half_way = 1.5  # ratio of rates between equal (1) and double (2)
        if not 1 / half_way < ratio < half_way:
            view.notes.append(_other_rate(own, sets_per_s, int(table.unmatched[camera])))
        if table.unmatched[camera] and ratio < half_way:
            used = np.zeros(len(view.colour_times), bool)
            used[table.index[seen, camera]] = True
            left_out = view.colour_times[view.colour_usable & ~used]
            apart = float(np.median(distance_to(left_out, table.times_us))) / 1000
            view.notes.append(
                f"{table.unmatched[camera]} images fit no frame set: their device times are "
                f"{apart:.1f} ms from the nearest one (frames.max_skew_ms)"
            )
        if not len(seen):
            continue
        drift = clock_drift_us(table.times_us, table.skew_us[:, camera])
        if abs(drift) > 1000.0:  # microseconds; smaller drifts are below an image's exposure time
            view.notes.append(
                f"its clock runs away from {views[clock].name}'s by {drift / 1e3:.1f} "
                "ms over the recording"
            )
        off = table.skew_us[seen, camera]
        uneven = float(np.median(np.abs(off - np.median(off))))
        if uneven > 2000.0:  # microseconds: a walking person moves by some millimetres meanwhile
            view.notes.append(
                f"the skew of its images varies by {uneven / 1e3:.1f} ms (median): fits use one "
                "time offset for all of them"
            )
        holes = int(seen[-1] - seen[0] + 1 - len(seen))
        early = len(table.times_us) - 1 - int(seen[-1])
        if holes:
            view.notes.append(f"no image in {holes} frame sets between its first and last")
        tolerated = max(1.0, 1 / ratio)  # sets before the first image, or after the last one
        if seen[0] >= tolerated:
            view.notes.append(f"begins {seen[0]} frame sets late")
        if early >= tolerated:
            view.truncated = True
            view.notes.append(f"ends {early} frame sets early")


def _other_rate(own: float, sets: float, unmatched: int) -> str:
    """Note on a camera with ``own`` images per second, unlike the rate ``sets`` of the frame
    sets."""
    text = f"it has {own:.3g} images a second beside {sets:.3g} frame sets"
    if own > sets:
        return (
            f"{text}: {unmatched} images are left out; name it as the calibration's master to use "
            "them"
        )
    return f"{text}: those between its images lack it"


def _dropped(count: int, frames_to_drop: Sequence[int], sequence: SequenceEntry) -> np.ndarray:
    """Mask (T,) of the sets that the annotation drops."""
    dropped = np.zeros(count, bool)
    beyond = [frame for frame in frames_to_drop if not 0 <= frame < count]
    if beyond:
        raise UserError(
            f"sequence {sequence.sequence!r}: drop_frames holds {beyond[0]}, the recording has "
            f"frame sets 0 to {count - 1}; correct the annotation"
        )
    dropped[list(frames_to_drop)] = True
    if dropped.all():
        raise UserError(
            f"annotation of sequence {sequence.sequence!r}: drop_frames drops all {count} frames; "
            "exclude the sequence in the settings instead"
        )
    return dropped


def _camera_or_placeholder(
    view: ExtractedCamera, views: list[ExtractedCamera], extrinsics: Extrinsics
) -> Camera:
    """The camera, or for an absent camera a placeholder, so that camera indices stay the same.

    The placeholder has the image size and focal length of a present camera, no distortion and no
    depth. Only its pose may be used.
    """
    if view.present and view.camera is not None:
        return view.camera
    like = next(v.camera for v in views if v.present and v.camera is not None).colour
    plain = Intrinsics(like.width, like.height, like.fx, like.fy, like.cx, like.cy)
    pose = extrinsics.master_from_colour.get(view.name, np.eye(4))
    return Camera(view.name, plain, None, None, pose)
