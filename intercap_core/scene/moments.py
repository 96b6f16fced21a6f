"""Assigns every image to the frame set whose moment it shows: late starts, slips, time offsets."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from intercap_core.formats.detections.read import PeopleOfImages
from intercap_core.formats.recordings.synchronise import images_of_moments
from intercap_core.geometry.camera.rig import Rig
from intercap_core.scene.keypoint_timing import TIMING_INFLATION, TimeOffsets, find_offsets
from intercap_core.scene.slips import Slips, constant_slip, find_slips
from intercap_core.scene.start_times import find_starts
from intercap_core.scene.starts import (
    DENIED_SIGMAS,
    AlignedPeople,
    StartTimes,
    StatedStarts,
    describe_start,
)
from intercap_core.scene.subject_views import SubjectViews, find_subject_views

LITTLE_ADDED = 0.5  # of a stated deviation that is left: the start rests on what was stated


def check_stated_starts(
    starts: StartTimes, stated: StatedStarts, slips: Slips, timing: TimeOffsets
) -> StartTimes:
    """The starts once slips and offsets are known: without what was stated of cameras whose
    keypoints say otherwise.

    ``slips`` were found with the cameras in step, ``timing`` beside both.
    """
    late, sigma = starts.late.copy(), starts.sigma.copy()
    denied, step = starts.denied.copy(), starts.step_s
    constant = constant_slip(slips.slip)
    for c in np.flatnonzero(stated.known & ~denied):
        found_sigma = TIMING_INFLATION * timing.sigma[c]
        if not np.isfinite(found_sigma):
            if constant[c] == 0:
                continue
            found_sigma = step / 2
        found = (starts.sets[c] + constant[c]) * step - timing.offset[c]
        away = np.hypot(found_sigma, stated.sigma[c])
        if abs(found - stated.late[c]) > DENIED_SIGMAS * away:
            denied[c], sigma[c] = True, np.nan
            late[c] = starts.sets[c] * step - timing.offset[c]
        elif constant[c] != 0:
            late[c] = stated.late[c] - constant[c] * step
            sigma[c] = stated.sigma[c]
    return replace(
        starts, late=late, sigma=sigma, denied=denied, apart=starts.apart or bool(denied.any())
    )


def describe_stated_start(
    stated: StatedStarts,
    starts: StartTimes,
    slips: Slips,
    camera: int,
    offset: float,
    offset_sigma: float,
) -> str:
    """What became of a stated start, in words; "" where there is nothing to tell. ``offset`` s,
    with its standard deviation, is what is left beside whole sets."""
    if not stated.known[camera]:
        return ""
    source, late = stated.source[camera], float(stated.late[camera])
    whole = starts.sets[camera] + constant_slip(slips.slip)[camera]
    found = float(whole * starts.step_s - offset)
    if starts.denied[camera]:
        return (
            f"{source} has it start {describe_start(late)}; the keypoints deny that and were "
            f"followed: {describe_start(found)}"
        )
    if not offset_sigma < LITTLE_ADDED * stated.sigma[camera]:
        return (
            f"its start rests on {source}: {describe_start(found)}, known to {offset_sigma:.3f} s; "
            "the keypoints tell too little"
        )
    if whole == 0:
        return ""
    return (
        f"it started {describe_start(found)}, and was brought into step: so say {source} and the "
        "keypoints"
    )


@dataclass(frozen=True, eq=False)
class Moments:
    """``slip`` (T, C) whole sets by which images are older than their set says, by ``starts`` and
    ``slips`` together; ``image_of`` (T, C) the set whose image shows each set's moment, -1 = none;
    what the keypoints say of the cameras' ``timing``; the ``subject`` by moment."""

    starts: StartTimes
    slips: Slips
    slip: np.ndarray
    image_of: np.ndarray
    timing: TimeOffsets
    subject: SubjectViews


def find_moments(
    detections: PeopleOfImages,
    rig: Rig,
    times: np.ndarray,
    fps: float,
    available: np.ndarray,
    *,
    master: int,
    stated: StatedStarts | None = None,
) -> Moments:
    """Bring the views into step: whole recordings first, then images, then parts of a frame.

    ``times`` (T,) s of the sets; ``available`` (T, C): the set has an image of the camera. A camera
    whose start cannot be told shows no moment. ``stated``: when they started, beside the keypoints.
    """
    stated = stated or StatedStarts.nothing(len(rig))
    starts = find_starts(detections, rig, times, available, master=master, stated=stated)
    subject = find_subject_views(AlignedPeople(detections, starts), rig, times)
    slips = find_slips(subject.keypoints, rig, times, fps, master=master)
    slip = starts.with_slips(slips.slip)
    image_of = images_of_moments(slip, available & ~starts.in_doubt)
    keypoints = starts.of_images(subject.keypoints)
    timing = find_offsets(keypoints, slip, rig, times, master=master, start=starts.offset)
    starts = check_stated_starts(starts, stated, slips, timing)
    shown = replace(subject, keypoints=keypoints).showing(image_of, rig)
    return Moments(starts, slips, slip, image_of, timing, shown)
