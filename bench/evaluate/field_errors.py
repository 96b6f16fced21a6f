"""Errors in recordings made under field conditions: scene artefact and choice of the subject.

The conditions: cameras that start at different times, rooms whose measured surface is mostly floor,
feet that leave the floor, a second person in the room.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.evaluate.faulty_rigs import NamedFault
from bench.evaluate.start_windows import WindowErrors
from intercap_core import artefacts
from intercap_core.body.joints import FOOT_JOINTS, JOINT_INDEX
from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.evaluation.known import Figures, finite, over_known
from intercap_core.evaluation.motion import Floor
from intercap_core.evaluation.scene_errors import CUBE_SIDE_M, displacement, rig_centre
from intercap_core.evaluation.truth import match_times
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.solve.robust import SIGMA_PER_MAD
from intercap_core.scene.starts import NOT_DETERMINED
from intercap_core.schemas import FRAMES, PERSON, SCENE, TRUTH


@dataclass(frozen=True, eq=False)
class FieldScene:
    """Errors of one recording's scene artefact; N cameras with images, without the master.

    Displacements are RMS over the points of a 2 m cube at the rig's centre. The delay of an image
    is how much older it is than the time of its frame set, relative to the master's delay.
    """

    fps: float
    """Frame sets per second."""
    late_s: np.ndarray
    """(N,) error of the estimated delay, median over images, seconds."""
    sigma_s: np.ndarray
    """(N,) stated standard deviation of the delay, seconds."""
    set_aside: np.ndarray
    """(N,) bool: the scene stage states that the camera's delay is undetermined."""
    before: np.ndarray
    """(N,) displacement by the given extrinsics, metres."""
    after: np.ndarray
    """(N,) displacement by the refined extrinsics, metres."""
    stated: np.ndarray
    """(N,) stated standard deviation of the displacement, metres."""
    floor_m: float
    """Mean height error of the floor under the true feet; NaN without a floor."""
    tilt_deg: float
    """Angle between estimated and true floor normal; NaN without a floor."""
    faults: tuple[NamedFault, ...] = ()
    """Cameras that were named in faulty variants of the recording."""
    windows: WindowErrors | None = None
    """Starts in windows of the recording; None = not measured."""

    @property
    def worse(self) -> np.ndarray:
        """Mask (N,) of the cameras whose error grew by more than 1 mm."""
        return self.after > self.before + 0.001


def measure(frames: Path, scene: Path, truth: Path) -> FieldScene:
    """Compare a scene artefact with its truth.

    Raises UserError if an artefact cannot be read.
    """
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
        error = np.nanmedian(late - true_late, axis=0)
        unseen = np.asarray((found["image_of"] < 0).all(axis=0))
        named = np.array([NOT_DETERMINED in note for note in found.text("note")])
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
            fps,
            (error - error[master])[counted],
            found["time_offset_sigma"][counted],
            (unseen | named)[counted],
            before[counted],
            after[counted],
            stated[counted],
            floor_m,
            tilt_deg,
        )


def floor_error(
    point: np.ndarray, normal: np.ndarray, true: Floor, feet: np.ndarray
) -> tuple[float, float]:
    """Mean distance of a floor from the true floor, metres, and the angle between them, degrees.

    The mean is over the projections of ``feet`` (N, 3) onto the true floor. NaN without a floor.

    Args:
        point, normal: (3,) the estimated floor.
    """
    if not np.isfinite(normal).all():
        return float("nan"), float("nan")
    under = feet - true.height(feet)[:, None] * true.normal
    angle = np.degrees(np.arccos(np.clip(normal @ true.normal, -1.0, 1.0)))
    return float(np.abs((under - point) @ normal).mean()), float(angle)


def stated_displacement(master_from_camera: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """RMS displacement (C,) of the points of a 2 m cube at the rig's centre, metres, by the stated
    covariance of each camera.

    Args:
        master_from_camera: (C, 4, 4).
        covariance: (C, 7, C, 7) of rotation about the camera's centre, translation, depth bias.
    """
    arms = rig_centre(master_from_camera) - master_from_camera[:, :3, 3]
    result = np.empty(len(arms))
    for c, arm in enumerate(arms):
        own = covariance[c, :6, c, :6]
        # row i: displacement of the arm by a rotation about axis i
        across = np.cross(np.eye(3), arm)
        by_pose = np.concatenate([across.T, np.eye(3)], axis=1)
        at_centre = np.trace(by_pose @ own @ by_pose.T)
        turn = np.trace(own[:3, :3])
        # The matrix of a small rotation w has the squared Frobenius norm 2 |w|^2; see displacement.
        result[c] = np.sqrt(at_centre + CUBE_SIDE_M**2 / 12 * 2 * turn)
    return result


def start_figures(scenes: Sequence[FieldScene]) -> Figures:
    """Figures of recordings whose cameras started at different times; milliseconds.

    A camera is solved if the error of its delay is below half a frame period. ``offset_wrong``
    counts the cameras that are neither solved nor reported as undetermined.
    ``offset_normalised`` is 1 if the stated standard deviations are calibrated.
    """
    if not scenes:
        return {}
    late, sigma, aside = (
        np.concatenate([getattr(s, name) for s in scenes])
        for name in ("late_s", "sigma_s", "set_aside")
    )
    late = np.abs(late)
    step = np.repeat([1 / s.fps for s in scenes], [len(s.late_s) for s in scenes])
    solved = ~aside & (late < step / 2)
    known = solved & (sigma > 0)
    ratio = late[known] / sigma[known]
    return finite(
        {
            "offset_solved_share": float(solved.mean()),
            "offset_wrong": float((~solved & ~aside).sum()),
            "offset_cameras": float(len(late)),
            "offset_error_ms": 1e3 * over_known(np.mean, late[solved]),
            "offset_error_worst_ms": 1e3 * over_known(np.max, late[solved]),
            "offset_sigma_ms": 1e3 * over_known(np.median, sigma[known]),
            "offset_normalised": SIGMA_PER_MAD * over_known(np.median, ratio),
        }
    )


def fault_figures(scenes: Sequence[FieldScene]) -> Figures:
    """Mean share of the cameras at fault that were named, in variants with moved or exchanged
    cameras or another calibration; and the number of correct cameras that were named."""
    faults = [fault for scene in scenes for fault in scene.faults]
    if not faults:
        return {}
    shares = [fault.named for fault in faults if np.isfinite(fault.named)]
    return {
        "moved_camera_named_share": float(np.mean(shares)),
        "moved_camera_false_alarms": float(sum(fault.false for fault in faults)),
    }


def floor_figures(scenes: Sequence[FieldScene]) -> Figures:
    """Errors of camera poses in rooms whose measured surface is mostly floor, millimetres.

    ``extrinsics_normalised``: median of error over stated deviation.
    """
    if not scenes:
        return {}
    before, after, stated = (
        np.concatenate([getattr(s, name) for s in scenes]) for name in ("before", "after", "stated")
    )
    known = stated > 0
    return finite(
        {
            "extrinsics_floor_heavy_given_mm": 1e3 * float(before.mean()),
            "extrinsics_floor_heavy_mm": 1e3 * float(after.mean()),
            "extrinsics_floor_heavy_worst_mm": 1e3 * float(after.max()),
            "extrinsics_worse_cameras": float(sum(s.worse.sum() for s in scenes)),
            "extrinsics_normalised": over_known(np.median, after[known] / stated[known]),
        }
    )


def beam_figures(scenes: Sequence[FieldScene]) -> Figures:
    """Floor errors of recordings in which feet leave the floor, such as on a balance beam.

    Millimetres and degrees; ``beam_floor_missing`` counts the recordings without a floor.
    """
    if not scenes:
        return {}
    height = np.array([s.floor_m for s in scenes])
    return finite(
        {
            "beam_floor_missing": float(np.isnan(height).sum()),
            "beam_floor_mm": 1e3 * over_known(np.nanmean, height),
            "beam_floor_worst_mm": 1e3 * over_known(np.nanmax, height),
            "beam_tilt_deg": over_known(np.nanmean, [s.tilt_deg for s in scenes]),
        }
    )


_LIMBS = [
    f"{side}_{part}"
    for side in ("left", "right")
    for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
]
_KEYPOINTS = [KEYPOINT_NAMES.index(name) for name in _LIMBS]
_JOINTS = [JOINT_INDEX[name] for name in _LIMBS]


def measure_subject_share(person: Path, scene: Path, truth: Path) -> float:
    """Share of the images with a chosen person that show the subject; NaN without such images.

    The chosen keypoints are compared with the true joints in the true cameras, as detected and with
    left and right exchanged: a detection with exchanged sides is still the subject. It shows the
    subject if the median distance is below 0.3 m; other people in the studio come no closer than
    0.8 m. Raises UserError if an artefact cannot be read or the truth is of another recording.
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
            _apart(keypoints[t, c], rig[c], apply(camera_from_master[c], joints[t])) < 0.3
            for t, c in np.argwhere(chosen["person"] >= 0)
        ]
        return float(np.mean(right)) if right else float("nan")


def _apart(keypoints: np.ndarray, camera: Camera, joints: np.ndarray) -> float:
    """Median distance of joints from the keypoints' rays, metres; infinite without keypoints.

    The distance is measured across the optical axis at the joint's depth. The lesser of the values
    with and without exchange of left and right is returned.

    Args:
        keypoints: (K, 3) x, y, confidence.
        joints: (K, 3) camera frame.
    """
    rays, seen = camera.colour.unproject(keypoints[:, :2]), keypoints[:, 2] > 0
    if not seen.any():
        return np.inf
    half = len(_LIMBS) // 2
    sides = (np.arange(len(_LIMBS)), np.roll(np.arange(len(_LIMBS)), half))
    return min(
        float(np.median(np.linalg.norm((rays * joints[side, 2:] - joints[side])[seen, :2], axis=1)))
        for side in sides
    )
