"""Which moment every image shows: cameras that started apart, images that slipped, offsets."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from intercap_core.formats.detections.read import PeopleOfImages
from intercap_core.formats.recordings.synchronise import images_of_moments
from intercap_core.geometry.camera.rig import Rig
from intercap_core.scene.keypoint_timing import Offsets, keypoint_offsets
from intercap_core.scene.slips import Slips, find_slips
from intercap_core.scene.start_times import InStep, Starts, find_starts
from intercap_core.scene.start_verdicts import weighed
from intercap_core.scene.stated_starts import StatedStarts
from intercap_core.scene.subject_views import SubjectViews, subject_views


@dataclass(frozen=True, eq=False)
class Moments:
    """``slip`` (T, C) whole sets by which images are older than their set says, by ``starts`` and
    ``slips`` together; ``image_of`` (T, C) the set whose image shows each set's moment, -1 = none;
    what the keypoints say of the cameras' ``timing``; the ``subject`` by moment."""

    starts: Starts
    slips: Slips
    slip: np.ndarray
    image_of: np.ndarray
    timing: Offsets
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
    subject = subject_views(InStep(detections, starts), rig, times)
    slips = find_slips(subject.keypoints, rig, times, fps, master=master)
    slip = starts.with_slips(slips.slip)
    image_of = images_of_moments(slip, available & ~starts.in_doubt)
    keypoints = starts.of_images(subject.keypoints)
    timing = keypoint_offsets(keypoints, slip, rig, times, master=master, start=starts.offset)
    starts = weighed(starts, stated, slips, timing)
    shown = replace(subject, keypoints=keypoints).showing(image_of, rig)
    return Moments(starts, slips, slip, image_of, timing, shown)
