"""Part ``detector`` of `intercap dev evaluate`: all stages with keypoints of a real detector.

MediaPipe detects the keypoints in the studio's images (:mod:`intercap_core.studio.mediapipe`). The
detector's errors last over frames and are shared by views, and it often misses hands that hold an
object. The same recordings are evaluated with simulated keypoints whose errors follow those
measured of MediaPipe (:mod:`intercap_core.studio.measured_detector`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.evaluate.field_errors import stated_displacement
from bench.evaluate.part import (
    EvaluationPart,
    Figures,
    Measured,
    config_files,
    keyed,
    truth_of,
    variant,
    with_spread,
)
from bench.evaluate.sequences import areas
from bench.evaluate.start_windows import (
    Recording,
    WindowErrors,
    measure_windows,
    window_figures,
)
from intercap_core import artefacts
from intercap_core.artefacts import Artefact
from intercap_core.body.joints import JOINT_INDEX
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.known import finite, over_known
from intercap_core.evaluation.scene_errors import displacement
from intercap_core.evaluation.truth import match_times
from intercap_core.geometry.rigid.symmetry import SymmetryGroup
from intercap_core.project import Project
from intercap_core.schemas import JOINT, METRIC_REGIONS, SCENE, TRUTH

_WRISTS = [JOINT_INDEX["left_wrist"], JOINT_INDEX["right_wrist"]]
# Figures of the area ``detector`` and their keys among those of part ``sequences``
FIGURES = {
    "object_translation_median_mm": ("joint", "object_translation_median_mm"),
    "body_mpjpe_mm": ("joint", "body_mpjpe_mm"),
    "hand_mpjpe_mm": ("joint", "hand_mpjpe_mm"),
    "hand_grasp_mpjpe_mm": ("joint", "hand_grasp_mpjpe_mm"),
    "fingertip_holding_mm": ("joint", "fingertip_touching_mm"),
    "contact_detected_f1": ("joint", "contact_detected_f1"),
    "extrinsics_scene_mm": ("extrinsics", "after_mean_mm"),
    "extrinsics_joint_mm": ("extrinsics", "joint_mean_mm"),
}


class TrueAndStated(NamedTuple):
    """Absolute errors (N,) and their stated standard deviations (N,); NaN = unknown."""

    error: np.ndarray
    sigma: np.ndarray

    def rms(self) -> tuple[float, float]:
        """Root mean square of the known errors, and of their known standard deviations."""
        known = np.isfinite(self.error)
        error, sigma = (np.sqrt(over_known(np.mean, v[known & np.isfinite(v)] ** 2)) for v in self)
        return float(error), float(sigma)


@dataclass(frozen=True, eq=False)
class CameraErrors:
    """Errors of the cameras' estimates; poses and offsets of all cameras but the master."""

    pose_mm: TrueAndStated
    """Displacement of the points of a cube around the people."""
    offset_ms: TrueAndStated
    """Time offset relative to the master."""
    depth_bias_mm: TrueAndStated
    """Depth bias of each camera, the master's included."""


@dataclass(frozen=True, eq=False)
class DetectorSequence:
    """Errors of one recording."""

    metrics: SequenceMetrics
    slip_m: list[float]
    """Slip of each grip, see :func:`grip_slips`."""
    cameras: CameraErrors
    """Errors of the cameras after ``joint``."""
    windows: WindowErrors | None
    """Starts in windows of the recording; None = not measured, with simulated keypoints."""


DetectorSequences = Measured[DetectorSequence]


def measure(project: Project, sequence: str) -> DetectorSequence:
    """Read the metrics of one recording, and measure its cameras and the slip of its grips.

    Raises UserError if an artefact or the truth cannot be read.
    """
    metrics = SequenceMetrics.read(project.artefact(sequence, "metrics"))
    paths, truth = project.paths(sequence), truth_of(project, sequence)
    with artefacts.read(paths.scene, SCENE) as scene:
        times = scene["times"]
    entry = project.object_of(sequence)
    assert entry is not None  # the recordings of this part have objects
    symmetry = SymmetryGroup.from_settings(entry.symmetry)
    windows = None
    if not variant(str(project.config.dataset), "detector"):
        windows = measure_windows(Recording.read(paths.frames, paths.detections, truth))
    slips = _slips_of(paths.joint, truth, times, metrics.fps, symmetry)
    with artefacts.read(paths.joint, JOINT) as fitted, artefacts.read(truth, TRUTH) as true:
        return DetectorSequence(metrics, slips, camera_errors(fitted, true), windows)


def camera_errors(
    fitted: Artefact | Mapping[str, Any], true: Artefact | Mapping[str, Any]
) -> CameraErrors:
    """Compare the cameras of a joint artefact with the truth, whose first camera is the master."""
    names, true_names = ([str(n) for n in a["camera_names"]] for a in (fitted, true))
    order, master = [true_names.index(name) for name in names], names.index(true_names[0])
    others = np.arange(len(names)) != master
    covariance = fitted["camera_covariance"]
    moved = displacement(fitted["master_from_colour"], true["master_from_colour"][order], master)
    late = fitted["time_offset"] - true["time_offset"][order]
    bias = fitted["depth_bias"] - true["depth_bias"][order]
    bias_sigma = np.sqrt([covariance[c, 6, c, 6] for c in range(len(names))])
    return CameraErrors(
        TrueAndStated(
            1e3 * moved[others],
            1e3 * stated_displacement(fitted["master_from_colour"], covariance)[others],
        ),
        TrueAndStated(
            1e3 * np.abs(late - late[master])[others], 1e3 * fitted["time_offset_sigma"][others]
        ),
        TrueAndStated(1e3 * np.abs(bias), 1e3 * bias_sigma),
    )


def _slips_of(
    joint: Path, truth: Path, times: np.ndarray, fps: float, symmetry: SymmetryGroup
) -> list[float]:
    with artefacts.read(joint, JOINT) as fitted, artefacts.read(truth, TRUTH) as true:
        at = match_times(truth, true["times"], times, fps)
        columns = [true.text("region_names").index(name) for name in METRIC_REGIONS[:2]]
        true_rotation = true["rotation"][at]
        rotation = symmetry.nearest_equivalent(fitted["rotation"], true_rotation)
        return grip_slips(
            _in_object(fitted["joints"], rotation, fitted["translation"]),
            _in_object(true["joints"][at], true_rotation, true["translation"][at]),
            true["region_contact"][at][:, columns],
            fps,
        )


def _in_object(joints: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Wrists (T, 2, 3) in the object's frame, metres."""
    return (joints[:, _WRISTS] - translation[:, None]) @ rotation


def grip_slips(
    wrists: np.ndarray, true_wrists: np.ndarray, holding: np.ndarray, fps: float
) -> list[float]:
    """Slip of each grip, metres: how far a wrist strays in the object's frame.

    A grip is an interval of at least 0.3 s in which a hand truly touches. Its slip is the 95th
    percentile of the distance of the wrist's error from the mean error of the grip. A true slip
    does not count, because the true motion is subtracted.

    Args:
        wrists: (T, 2, 3) fitted wrists in the fitted object's frame, metres.
        true_wrists: (T, 2, 3) true wrists in the true object's frame, metres.
        holding: (T, 2) mask of true contact of the hands.
        fps: frames per second.
    """
    found = []
    for hand in range(2):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], holding[:, hand].astype(int), [0]])))
        for first, end in edges.reshape(-1, 2):
            if end - first >= 0.3 * fps:
                error = (wrists - true_wrists)[first:end, hand]
                stray = np.linalg.norm(error - error.mean(0), axis=1)
                found.append(float(np.percentile(stray, 95)))
    return found


def figures(recordings: Sequence[DetectorSequence]) -> Figures:
    """Figures of recordings; undefined ones are omitted."""
    found = areas([recording.metrics for recording in recordings])
    result = {name: found[area][key] for name, (area, key) in FIGURES.items() if key in found[area]}
    slips = [slip for recording in recordings for slip in recording.slip_m]
    result |= finite({"grip_slip_mm": 1e3 * over_known(np.mean, slips)})
    for name in (f.name for f in fields(CameraErrors)):
        every = [getattr(recording.cameras, name) for recording in recordings]
        pooled = TrueAndStated(*(np.concatenate(values) for values in zip(*every, strict=True)))
        quantity, _, unit = name.rpartition("_")
        result[f"{quantity}_true_{unit}"], result[f"{quantity}_stated_{unit}"] = pooled.rms()
    result |= window_figures([r.windows for r in recordings if r.windows])
    return result | {f"verdict_{key}": value for key, value in found["verdict"].items()}


def flat(evaluations: Sequence[DetectorSequences]) -> Figures:
    """Keys ``detector.<measure>``; ``detector.measured_<measure>`` of the simulated keypoints."""
    return {
        key: value
        for found in evaluations
        for key, value in keyed(
            f"detector.{variant(found.dataset, 'detector')}", with_spread(figures, found.errors)
        ).items()
    }


PART = EvaluationPart(
    name="detector",
    stage="metrics",
    settings=config_files("detector", "config", "measured"),
    budget_minutes=7.4,
    measure=measure,
    flat=flat,
    columns=(
        *FIGURES, "grip_slip_mm", "pose_true_mm", "pose_stated_mm", "verdict_coverage_body",
        "verdict_coverage_hands", "verdict_coverage_object",
    ),
    areas=("detector",),
)  # fmt: skip
