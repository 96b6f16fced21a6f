"""Assigns every image to the frame set whose moment it shows.

Corrects three errors of device times: cameras that started late (:mod:`.start_times`), images that
are whole frames late (:mod:`.slips`), and sub-frame offsets (:mod:`.keypoint_timing`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from intercap_core.formats.detections.read import PeopleOfImages
from intercap_core.formats.recordings.synchronise import frame_interval, images_of_moments
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.solve.robust import OUTLIER_SIGMAS
from intercap_core.scene.keypoint_timing import TimeOffsets, find_offsets
from intercap_core.scene.slips import Slips, constant_slip, find_slips
from intercap_core.scene.start_times import find_starts
from intercap_core.scene.starts import (
    AlignedPeople,
    StartTimes,
    StatedStarts,
    describe_start,
    shift_images,
)
from intercap_core.scene.subject_views import SubjectViews, find_subject_views


def check_stated_starts(
    starts: StartTimes, stated: StatedStarts, slips: Slips, timing: TimeOffsets
) -> StartTimes:
    """Reject stated starts that slips and time offsets contradict.

    Args:
        starts: starts found so far.
        stated: starts from sound or the user.
        slips: late images, counted after correction of ``starts``.
        timing: time offsets, counted after correction of ``starts`` and ``slips``.
    """
    late, sigma = starts.late.copy(), starts.sigma.copy()
    rejected, step = starts.rejected.copy(), starts.step_s
    constant = constant_slip(slips.slip)
    for c in np.flatnonzero(stated.known & ~rejected):
        start_sigma = timing.sigma[c]
        if not np.isfinite(start_sigma):
            if constant[c] == 0:
                continue
            start_sigma = step / 2
        start = (starts.sets[c] + constant[c]) * step - timing.offset[c]
        away = np.hypot(start_sigma, stated.sigma[c])
        if abs(start - stated.late[c]) > OUTLIER_SIGMAS * away:
            rejected[c], sigma[c] = True, np.nan
            late[c] = starts.sets[c] * step - timing.offset[c]
        elif constant[c] != 0:
            late[c] = stated.late[c] - constant[c] * step
            sigma[c] = stated.sigma[c]
    return replace(
        starts,
        late=late,
        sigma=sigma,
        rejected=rejected,
        apart=starts.apart or bool(rejected.any()),
    )


def name_doubtful_delays(starts: StartTimes, slips: Slips) -> StartTimes:
    """Name the cameras whose usual delay beyond ``starts.sets`` the searches of starts and slips
    estimate differently. A set of difference is left to the time offsets."""
    if starts.short is None:
        return starts
    differ = np.abs(starts.short - np.median(slips.slip, axis=0)) > 1
    return replace(
        starts,
        undetermined=tuple(
            reason or ("two estimates of a short delay differ" if doubt else "")
            for reason, doubt in zip(starts.undetermined, differ, strict=True)
        ),
    )


def describe_stated_start(
    stated: StatedStarts,
    starts: StartTimes,
    slips: Slips,
    camera: int,
    offset: float,
    offset_sigma: float,
) -> str:
    """Describe how a stated start was used; "" if there is nothing to report.

    ``offset``, ``offset_sigma``: time offset that remains after correction by whole sets, and its
    standard deviation, seconds.
    """
    if not stated.known[camera]:
        return ""
    source, late = stated.source[camera], float(stated.late[camera])
    whole = starts.sets[camera] + constant_slip(slips.slip)[camera]
    start = float(whole * starts.step_s - offset)
    if starts.rejected[camera]:
        return (
            f"{source} states that it started {describe_start(late)}; the keypoints contradict "
            f"this and were used instead: {describe_start(start)}"
        )
    if not offset_sigma < 0.5 * stated.sigma[camera]:  # the keypoints add little
        return (
            f"its start is that of {source}: {describe_start(start)}, known to "
            f"{offset_sigma:.3f} s; the keypoints do not determine it"
        )
    if whole == 0:
        return ""
    return (
        f"it started {describe_start(start)} according to {source} and the keypoints; its images "
        "were moved"
    )


@dataclass(frozen=True, eq=False)
class Moments:
    """Assignment of images to the moments that they show."""

    starts: StartTimes
    """Start of each camera."""
    slips: Slips
    """Late images, counted after correction of ``starts``."""
    slip: np.ndarray
    """(T, C) total delay by start and slip: whole sets by which images are older than their set."""
    image_of: np.ndarray
    """(T, C) set whose image shows each set's moment; -1 = none."""
    timing: TimeOffsets
    """Time offsets from the keypoints."""
    subject: SubjectViews
    """The subject by moment."""


def find_moments(
    detections: PeopleOfImages,
    rig: Rig,
    times: np.ndarray,
    fps: float,
    available: np.ndarray,
    *,
    master: int,
    stated: StatedStarts | None = None,
    search: bool = True,
) -> Moments:
    """Synchronise the views: starts of recordings, then late images, then sub-frame offsets.

    Images of a camera in doubt (:attr:`StartTimes.in_doubt`) are not assigned to any moment.

    Args:
        times: (T,) seconds of the sets.
        fps: nominal sets per second.
        available: (T, C) bool, the set has an image of the camera.
        stated: starts from other sources than the keypoints.
        search: estimate starts from the keypoints; otherwise keep stated starts and device times.
    """
    stated = stated or StatedStarts.nothing(len(rig))
    starts = (
        find_starts(detections, rig, times, available, master=master, stated=stated)
        if search
        else StartTimes.as_stated(stated, frame_interval(times))
    )
    subject = find_subject_views(AlignedPeople(detections, starts), rig, times)
    slips = find_slips(subject.keypoints, rig, times, fps, master=master)
    starts = name_doubtful_delays(starts, slips)
    slip = starts.with_slips(slips.slip)
    image_of = images_of_moments(slip, available & ~starts.in_doubt)
    keypoints = shift_images(subject.keypoints, -starts.sets)
    timing = find_offsets(keypoints, slip, rig, times, master=master, start=starts.offset)
    starts = check_stated_starts(starts, stated, slips, timing)
    shown = replace(subject, keypoints=keypoints).showing(image_of, rig)
    return Moments(starts, slips, slip, image_of, timing, shown)
