"""What becomes of stated starts once the keypoints have told their times: kept, or denied."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from intercap_core.scene.constants import DENIED_SIGMAS, LITTLE_ADDED, TIMING_INFLATION
from intercap_core.scene.keypoint_timing import Offsets
from intercap_core.scene.slips import Slips, constant_slip
from intercap_core.scene.start_times import Starts
from intercap_core.scene.stated_starts import StatedStarts, when


def weighed(starts: Starts, stated: StatedStarts, slips: Slips, timing: Offsets) -> Starts:
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


def note_of_stated(
    stated: StatedStarts,
    starts: Starts,
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
            f"{source} has it start {when(late)}; the keypoints deny that and were followed: "
            f"{when(found)}"
        )
    if not offset_sigma < LITTLE_ADDED * stated.sigma[camera]:
        return (
            f"its start rests on {source}: {when(found)}, known to {offset_sigma:.3f} s; the "
            "keypoints tell too little"
        )
    if whole == 0:
        return ""
    return f"it started {when(found)}, and was brought into step: so say {source} and the keypoints"
