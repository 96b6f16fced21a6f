"""Errors in recordings made under field conditions: scene artefact and choice of the subject.

The conditions: cameras that start at different times, rooms whose measured surface is mostly floor,
feet that leave the floor, a second person in the room.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.evaluation.body import FOOT_JOINTS
from intercap_core.evaluation.motion import Floor
from intercap_core.evaluation.scene_errors import (
    CUBE_SIDE_M,
    MEDIAN_CHI_1,
    displacement,
    rig_centre,
)
from intercap_core.evaluation.truth import match_times
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.schemas import FRAMES, PERSON, SCENE, TRUTH

WORSE_M = 0.001  # by more than this a camera ends worse than it was given


@dataclass(frozen=True, eq=False)
class FieldScene:
    """Of one recording's cameras (N,) but the master, those that have images.

    ``apart_s`` true time by which a camera's images are older than its sets say; ``late_s`` the
    error of the stated one, the median over images, ``sigma_s`` its stated deviation;
    ``set_aside``: the scene says that it cannot tell. ``before`` and ``after`` of the extrinsics
    and their ``stated`` deviation, metres, RMS displacement over a 2 m cube. ``floor_m`` by how
    much the floor is off under the true feet, in the mean, and ``tilt_deg`` its tilt; NaN without
    a floor.
    """

    sequence: str
    fps: float
    apart_s: np.ndarray
    late_s: np.ndarray
    sigma_s: np.ndarray
    set_aside: np.ndarray
    before: np.ndarray
    after: np.ndarray
    stated: np.ndarray
    floor_m: float
    tilt_deg: float


def measure(frames: Path, scene: Path, truth: Path) -> FieldScene:
    """Compare one scene with its truth; raises UserError where an artefact cannot be read."""
    with (
        artefacts.read(frames, FRAMES) as recorded,
        artefacts.read(scene, SCENE) as found,
        artefacts.read(truth, TRUTH) as true,
    ):
        fps, names = float(found.attributes["fps"]), found.text("camera_names")
        at = match_times(truth, true["times"], found["times"], fps)
        order = [true.text("camera_names").index(name) for name in names]
        master = names.index(str(found.attributes["master"]))
        index: np.ndarray = recorded["colour_index"]
        available = index >= 0
        late, true_late = (
            np.where(available, slip / fps - offset, np.nan)
            for slip, offset in (
                (found["slip"], found["time_offset"]),
                (true["slip"][at][:, order], true["time_offset"][order]),
            )
        )
        apart = np.nanmedian(true_late, axis=0)
        error = np.nanmedian(late - true_late, axis=0)
        unseen = np.asarray((found["image_of"] < 0).all(axis=0))
        poses = true["master_from_colour"][order]
        before, after = (
            displacement(found[key], poses, master)
            for key in ("master_from_colour_start", "master_from_colour")
        )
        stated = stated_displacement(found["master_from_colour"], found["camera_covariance"])
        feet = true["joints"][at][:, FOOT_JOINTS].reshape(-1, 3)
        floor_m, tilt_deg = floor_error(
            found["ground_point"],
            found["ground_normal"],
            Floor(true["ground_normal"], float(true.attributes["ground_offset"])),
            feet,
        )
        counted = available.any(axis=0) & (np.arange(len(names)) != master)
        return FieldScene(
            str(found.attributes["sequence"]),
            fps,
            (apart - apart[master])[counted],
            (error - error[master])[counted],
            found["time_offset_sigma"][counted],
            unseen[counted],
            before[counted],
            after[counted],
            stated[counted],
            floor_m,
            tilt_deg,
        )


def floor_error(
    point: np.ndarray, normal: np.ndarray, true: Floor, feet: np.ndarray
) -> tuple[float, float]:
    """How far a floor through ``point`` (3,) with ``normal`` (3,) is from the ``true`` one, in the
    mean over the places of the true floor under ``feet`` (N, 3), metres, and the angle between
    them, degrees. NaN without a floor."""
    if not np.isfinite(normal).all():
        return float("nan"), float("nan")
    under = feet - true.height(feet)[:, None] * true.normal
    angle = np.degrees(np.arccos(np.clip(normal @ true.normal, -1.0, 1.0)))
    return float(np.abs((under - point) @ normal).mean()), float(angle)


def stated_displacement(master_from_camera: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """RMS displacement (C,) over the points of a 2 m cube at the rig's centre, metres, that the
    covariance (C, 7, C, 7) of rotation about the camera's centre, translation and depth bias
    states."""
    arms = rig_centre(master_from_camera) - master_from_camera[:, :3, 3]
    result = np.empty(len(arms))
    for c, arm in enumerate(arms):
        own = covariance[c, :6, c, :6]
        across = np.cross(np.eye(3), arm)  # row i: the shift of the arm by a turn about axis i
        by_pose = np.concatenate([across.T, np.eye(3)], axis=1)
        at_centre = np.trace(by_pose @ own @ by_pose.T)
        turn = np.trace(own[:3, :3])
        result[c] = np.sqrt(at_centre + CUBE_SIDE_M**2 / 12 * 2 * turn)
    return result


def start_figures(scenes: Sequence[FieldScene]) -> dict[str, float]:
    """Of recordings whose cameras started apart; milliseconds.

    A camera is solved where its images show the right set: the error is below half a set's time.
    One that is not, and that the scene does not set aside, is ``offset_wrong``.
    """
    if not scenes:
        return {}
    late, sigma, aside, step = (
        np.concatenate([values(s) for s in scenes])
        for values in (
            lambda s: np.abs(s.late_s),
            lambda s: s.sigma_s,
            lambda s: s.set_aside,
            lambda s: np.full(len(s.late_s), 1 / s.fps),
        )
    )
    solved = ~aside & (late < step / 2)
    found = {
        "offset_solved_share": float(solved.mean()),
        "offset_wrong": float((~solved & ~aside).sum()),
        "offset_cameras": float(len(late)),
    }
    if solved.any():
        found["offset_error_ms"] = 1e3 * float(late[solved].mean())
        found["offset_error_worst_ms"] = 1e3 * float(late[solved].max())
    known = solved & (sigma > 0)
    if known.any():
        found["offset_sigma_ms"] = 1e3 * float(np.median(sigma[known]))
        found["offset_normalised"] = float(np.median(late[known] / sigma[known])) / MEDIAN_CHI_1
    return found


def floor_figures(scenes: Sequence[FieldScene]) -> dict[str, float]:
    """Of rooms whose measured surface is mostly floor; millimetres."""
    if not scenes:
        return {}
    before, after, stated = (
        np.concatenate([getattr(s, name) for s in scenes]) for name in ("before", "after", "stated")
    )
    known = stated > 0
    found = {
        "extrinsics_floor_heavy_given_mm": 1e3 * float(before.mean()),
        "extrinsics_floor_heavy_mm": 1e3 * float(after.mean()),
        "extrinsics_floor_heavy_worst_mm": 1e3 * float(after.max()),
        "extrinsics_worse_cameras": float((after > before + WORSE_M).sum()),
    }
    if known.any():
        found["extrinsics_normalised"] = float(np.median(after[known] / stated[known]))
    return found


def beam_figures(scenes: Sequence[FieldScene]) -> dict[str, float]:
    """Of people whose feet leave the floor: the floor under them, millimetres and degrees."""
    if not scenes:
        return {}
    height = np.array([s.floor_m for s in scenes])
    found = {"beam_floor_missing": float(np.isnan(height).sum())}
    if np.isfinite(height).any():
        found["beam_floor_mm"] = 1e3 * float(np.nanmean(height))
        found["beam_floor_worst_mm"] = 1e3 * float(np.nanmax(height))
        found["beam_tilt_deg"] = float(np.nanmean([s.tilt_deg for s in scenes]))
    return found


APART_M = 0.3  # in the median over limbs, beside the ray: another person; people pass at 0.8 m
_LIMBS = [
    f"{side}_{part}"
    for side in ("left", "right")
    for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
]
_KEYPOINTS = [KEYPOINT_NAMES.index(name) for name in _LIMBS]
_JOINTS = [JOINT_INDEX[name] for name in _LIMBS]
_OTHER_SIDE = np.r_[len(_LIMBS) // 2 : len(_LIMBS), : len(_LIMBS) // 2]


def measure_subject_share(person: Path, scene: Path, truth: Path) -> float:
    """The share of the images with a chosen person in which it is the subject; NaN without any.

    The chosen keypoints are compared with the true joints as the true cameras see them, sides
    exchanged where that is nearer: a detector that exchanges them still shows the subject.
    Raises UserError where an artefact cannot be read or they are of different recordings.
    """
    with (
        artefacts.read(person, PERSON) as chosen,
        artefacts.read(scene, SCENE) as found,
        artefacts.read(truth, TRUTH) as true,
    ):
        fps = float(found.attributes["fps"])
        at = match_times(truth, true["times"], found["times"], fps)
        rig = Rig.from_artefact(found)
        order = [true.text("camera_names").index(name) for name in rig.names]
        camera_from_master = invert(true["master_from_colour"][order])
        joints = true["joints"][at][:, _JOINTS]
        keypoints = chosen["keypoints"][:, :, _KEYPOINTS]
        right = [
            _apart(keypoints[t, c], rig[c], apply(camera_from_master[c], joints[t])) < APART_M
            for t, c in np.argwhere(chosen["person"] >= 0)
        ]
        return float(np.mean(right)) if right else float("nan")


def _apart(keypoints: np.ndarray, camera: Camera, joints: np.ndarray) -> float:
    """Median distance, metres beside the ray, of keypoints (K, 3) x, y, confidence from joints
    (K, 3) in the camera's frame; infinite where nothing is seen."""
    rays, seen = camera.colour.unproject(keypoints[:, :2]), keypoints[:, 2] > 0
    if not seen.any():
        return np.inf
    sides = (np.arange(len(_LIMBS)), _OTHER_SIDE)
    return min(
        float(np.median(np.linalg.norm((rays * joints[side, 2:] - joints[side])[seen, :2], axis=1)))
        for side in sides
    )
