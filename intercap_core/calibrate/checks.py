"""Evidence and poses that `intercap calibrate` refuses, each with what to record instead."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from intercap_core.calibrate.evidence import CORNERS, JOINTS, MIN_SEEN, Views
from intercap_core.calibrate.found_rig import FoundRig
from intercap_core.calibrate.placement import Placement
from intercap_core.errors import UserError
from intercap_core.formats.calibration.boards import Board
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig

MIN_WALK_M = 0.4  # extent of the person's way; less moves every joint within its detector's errors
# Pose2Sim's demonstration lasts 1.6 s; its cameras, 3 to 7 m apart, are found to 62 mm (real_rigs).
MIN_WALK_S = 1.5
SURE_WALK_S = 3.0  # in less, errors of a detector hardly change, so estimated errors lack them
# Largest median error of a camera's joints or corners over that of all cameras; those of the
# studio's rigs are below 2, with left and right exchanged above 10
MAX_ERROR_RATIO = 4.0
MAX_GRAVITY_DEG = 5.0  # between gravity sensors; one of a Kinect is within a degree


def require_images(opened: Sequence[Frames]) -> None:
    """Raise UserError unless all recordings have the same cameras and each has an image."""
    names = opened[0].rig.names
    for frames in opened:
        if frames.rig.names != names:
            raise UserError(
                f"recording {frames.sequence!r} has cameras {', '.join(frames.rig.names)}, the "
                f"first has {', '.join(names)}; record all with the same rig and names"
            )
    absent = [n for c, n in enumerate(names) if not any(f.available[:, c].any() for f in opened)]
    if absent:
        raise UserError(
            f"camera {absent[0]!r} has no image in any frame set; `intercap check` says why"
        )


def require_evidence(rig: Rig, views: Views, board: Board | None) -> None:
    """Raise UserError if neither a person nor the board is seen by two cameras."""
    joints = (views.confidence[:, :, JOINTS] > 0).sum(2) >= MIN_SEEN
    corners = (views.confidence[:, :, CORNERS] > 0).any(2)
    people, boards = int(joints.any(0).sum()), int(corners.any(0).sum())
    if board is not None and boards < 2:
        names = [rig.names[c] for c in np.flatnonzero(corners.any(0))]
        raise UserError(
            f"the board is visible to {f'camera {names[0]} only' if names else 'no camera'}: check "
            "the numbers of --board (columns, rows, dictionary), and hold the board still, close "
            "and facing each camera, so that two cameras at a time see it"
        )
    if people < 2 and boards < 2:
        raise UserError(
            f"a person is detected by {people} of {len(rig)} cameras; name the folder of keypoints "
            "in the table of sequences (or a keypoint model in the settings), let somebody walk "
            "through the views, or show a board (--board)"
        )


def describe_unplaced(rig: Rig, placed: Sequence[int], left: Sequence[Placement]) -> str:
    """Message on the cameras that share too little with the others."""
    names = rig.names
    tried = {option.camera: option for option in left}
    reasons = []
    for c in range(len(rig)):
        if c in placed:
            continue
        option = tried.get(c)
        if option is None:
            reasons.append(f"{names[c]} sees too few points that others know at the same time")
        else:
            reasons.append(
                f"{names[c]}: {100 * option.share:.0f} % of {option.points} points agree"
            )
    known = ", ".join(names[c] for c in placed) or "none"
    return (
        f"not all cameras could be placed (placed: {known}; {'; '.join(reasons)}). Walk to and fro "
        "where these cameras and a placed one see you at the same time, for ten seconds or more, "
        "or show both a board; then calibrate again. The background places a camera only if two "
        "other depth cameras see the same furniture. Nothing was written"
    )


def check_walk(found: FoundRig, views: Views) -> None:
    """Raise UserError if a camera without board and background shares no walk; note short walks."""
    joints = (views.confidence[:, :, JOINTS] > 0).sum(2) >= MIN_SEEN
    common = joints & (joints.sum(1, keepdims=True) >= 2) & np.isfinite(found.residuals.walk[:, :1])
    for c in np.flatnonzero(found.boards == 0).tolist():
        if c in found.by_background:
            continue
        rows = common[:, c]
        extent = lasts = 0.0
        if rows.any():
            low, high = np.quantile(found.residuals.walk[rows], (0.02, 0.98), axis=0)
            extent = float(np.linalg.norm(high - low))
            own = [views.times[rows & (views.recording == k)] for k in np.unique(views.recording)]
            lasts = max(float(np.ptp(times)) for times in own if len(times))
        if extent < MIN_WALK_M or lasts < MIN_WALK_S:
            raise UserError(
                f"camera {found.rig.names[c]} and another one see the person together for "
                f"{lasts:.1f} s and {extent:.2f} m of its way, expected at least {MIN_WALK_S:g} s "
                f"and {MIN_WALK_M:g} m: let the person walk through the whole area that the "
                "cameras share, or show a board. Nothing was written"
            )
        if lasts < SURE_WALK_S:
            found.notes.append(
                f"camera {found.rig.names[c]} and another one see the person together for only "
                f"{lasts:.1f} s: its error may be larger than estimated; let the person walk for "
                "ten seconds"
            )


def check_agreement(found: FoundRig) -> None:
    """Raise UserError if the joints or corners of a camera contradict its pose."""
    residuals = found.residuals
    for points, errors in (("joints", residuals.joint_px), ("corners", residuals.corner_px)):
        usual = float(np.nanmedian(errors)) if np.isfinite(errors).any() else np.inf
        for c in np.flatnonzero(errors > MAX_ERROR_RATIO * usual).tolist():
            raise UserError(
                f"camera {found.rig.names[c]}: its {points} are {errors[c]:.1f} px from where the "
                f"other cameras see them, whose median is {usual:.1f} px. Its keypoints may be of "
                "another person or have left and right exchanged, its lens may be wrong, or it was "
                "moved; correct that and calibrate again. Nothing was written"
            )


def check_gravity(rig: Rig, gravity: np.ndarray) -> None:
    """Raise UserError if the gravity sensors contradict the rotations of the cameras."""
    measured = np.flatnonzero(np.isfinite(gravity).all(1))
    if len(measured) < 2:
        return
    down = np.einsum("cij,cj->ci", rig.master_from_colour[measured, :3, :3], gravity[measured])
    middle = np.median(down, axis=0)
    off = np.degrees(np.arccos(np.clip(down @ (middle / np.linalg.norm(middle)), -1, 1)))
    worst = int(off.argmax())
    if off[worst] > MAX_GRAVITY_DEG:
        raise UserError(
            f"camera {rig.names[measured[worst]]}: its gravity sensor contradicts its found pose "
            f"by {off[worst]:.0f} degrees, expected at most {MAX_GRAVITY_DEG:g}; record a longer "
            "walk in the common view, or show a board. Nothing was written"
        )
