"""Figures of one stage's artefact: errors against truth, and flags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bench.evaluate import capture_errors
from intercap_core import artefacts
from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.keypoints import BODY, KEYPOINT_NAMES
from intercap_core.evaluation.figures import SequenceMetrics, truth_figures
from intercap_core.evaluation.known import Figures
from intercap_core.evaluation.tracks import read_body, read_object
from intercap_core.evaluation.truth import match_times
from intercap_core.pipeline.step import run_step
from intercap_core.project import Project
from intercap_core.schemas import PERSON, SCENE, TRUTH

# Keypoints that lie in a joint of the same name; those of the skin have no true joint.
JOINT_KEYPOINTS = [k for k, name in enumerate(KEYPOINT_NAMES[BODY]) if name in JOINT_INDEX]
JOINTS = [JOINT_INDEX[KEYPOINT_NAMES[k]] for k in JOINT_KEYPOINTS]
SIDED = [k for k in JOINT_KEYPOINTS if KEYPOINT_NAMES[k].startswith(("left_", "right_"))]
OWN_SIDE = [JOINT_INDEX[KEYPOINT_NAMES[k]] for k in SIDED]
OTHER_SIDE = [
    JOINT_INDEX["_".join(["right" if side == "left" else "left", part])]
    for side, _, part in (KEYPOINT_NAMES[k].partition("_") for k in SIDED)
]
FLAGS = "flagged"
CAPTURE_FIGURES = {
    "extrinsics_after_mm": "extrinsics mm",
    "extrinsics_floor_only_mm": "extrinsics (bare floor) mm",
    "offset_error_ms": "offsets ms",
    "slips_missed": "slips missed",
    "slips_false": "slips false",
    "ground_error_mm": "floor mm",
}
# Figures of stage `metrics`
FIT_FIGURES = {
    "body_mpjpe_mm": "MPJPE mm",
    "hand_mpjpe_mm": "hands mm",
    "body_pve_mm": "PVE mm",
    "object_translation_mm": "object mm",
    "object_translation_p95_mm": "object p95 mm",
    "object_rotation_deg": "object deg",
    "object_rotation_p95_deg": "object p95 deg",
    "lost_share": "object lost",
    "contact_region_f1": "contact F1",
}


@dataclass(frozen=True)
class Written:
    """Artefacts of one sequence by stage, including replayed artefacts."""

    project: Project
    sequence: str
    artefacts: dict[str, Path]

    @property
    def truth(self) -> Path:
        path = self.project.sequences[self.sequence].truth
        assert path is not None
        return path


def figures_of(stage: str, written: Sequence[Written]) -> Figures:
    """Figures of a stage's artefacts over several sequences; ``flagged`` counts frames.

    Raises KeyError for a stage without figures.
    """
    return _OF_STAGE[stage](stage, written)


def _scene(_: str, written: Sequence[Written]) -> Figures:
    """Figures of the scene; flags are weak camera pairs and cameras with a note."""
    errors = [
        capture_errors.measure(w.artefacts["frames"], w.artefacts["scene"], w.truth)
        for w in written
    ]
    found = _named(capture_errors.figures(errors), CAPTURE_FIGURES)
    flags = 0
    for one in written:
        with artefacts.read(one.artefacts["scene"], SCENE) as scene:
            flags += int(scene["pair_weak"].sum()) + sum(bool(n) for n in scene.text("note"))
    return found | {FLAGS: float(flags)}


def _person(_: str, written: Sequence[Written]) -> Figures:
    """Errors of the keypoints; flags are the frames without a person.

    ``keypoints`` includes the 10 to 20 mm by which detector and body model define a joint
    differently. ``sides right``: share of the keypoints nearer to the joint of their own side, or
    unknown.
    """
    errors, right, known, missing = [], [], [], 0
    for one in written:
        with artefacts.read(one.artefacts["person"], PERSON) as person:
            points = person["joints"].astype(np.float64)
            missing += int(person["missing"].sum())
        with (
            artefacts.read(one.artefacts["scene"], SCENE) as scene,
            artefacts.read(one.truth, TRUTH) as true,
        ):
            fps = float(scene.attributes["fps"])
            joints = true["joints"][match_times(one.truth, true["times"], scene["times"], fps)]
        errors.append(distance(points, joints, JOINT_KEYPOINTS, JOINTS).ravel())
        own, other = (distance(points, joints, SIDED, to) for to in (OWN_SIDE, OTHER_SIDE))
        right.append(~(own > other).ravel())
        known.append(np.isfinite(points[:, :67]).all(-1).ravel())
    every = np.concatenate(errors)
    return {
        "keypoints mm": 1e3 * float(np.nanmean(every)),
        "keypoints p95 mm": 1e3 * float(np.nanpercentile(every, 95)),
        "sides right": float(np.concatenate(right).mean()),
        "keypoints known": float(np.concatenate(known).mean()),
        FLAGS: float(missing),
    }


def _fit(stage: str, written: Sequence[Written]) -> Figures:
    """Errors of a fit by stage `metrics` on its artefact and the run's other artefacts.

    Flags are the flagged frames of the object after ``object_track``, else of the body.
    """
    measured, flags = [], 0
    for one in written:
        config = one.project.config
        without_verdict = config.metrics.model_copy(update={"hold_out": False})
        config = config.model_copy(update={"metrics": without_verdict})
        output = one.artefacts[stage].with_suffix(".metrics.h5")
        run_step(
            "metrics", replace(one.project, config=config), one.sequence, inputs=one.artefacts,
            output=output,
        )  # fmt: skip
        measured.append(SequenceMetrics.read(output))
        if stage == "object_track":
            flagged = read_object(one.artefacts[stage], stage).flagged
        else:
            models = one.project.models(one.sequence)
            flagged = read_body(
                one.artefacts[stage], stage, models.body_models, models.gender
            ).flagged
        flags += int(flagged.sum())
    return _named(truth_figures(measured, stage), FIT_FIGURES) | {FLAGS: float(flags)}


def _named(found: Figures, names: dict[str, str]) -> Figures:
    return {name: found[key] for key, name in names.items() if key in found}


_OF_STAGE = {
    "scene": _scene,
    "person": _person,
    **dict.fromkeys(("object_track", "body_fit", "joint"), _fit),
}
STAGES_WITH_FIGURES = tuple(_OF_STAGE)


def distance(
    points: np.ndarray, joints: np.ndarray, keypoints: list[int], to: list[int]
) -> np.ndarray:
    """Distance (T, K) of ``keypoints`` of (T, 135, 3) from the joints ``to`` of (T, 55, 3)."""
    return np.linalg.norm(points[:, keypoints] - joints[:, to], axis=-1)
