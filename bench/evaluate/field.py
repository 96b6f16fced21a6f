"""Part ``field`` of `intercap dev evaluate`: metrics and verdict under field conditions.

The verdict estimates errors without truth by fits without each camera.

The conditions are: no depth, other definitions of joints, other body builds, boots, few cameras, a
person without an object (also exported), a balance beam, and a second person in the room.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from bench.evaluate import field_errors
from bench.evaluate.part import (
    EvaluationPart,
    Figures,
    Measured,
    config_files,
    keyed,
    truth_of,
)
from bench.workflow_speed import time_hold_out
from intercap_core import artefacts
from intercap_core.body.artefact import load_model
from intercap_core.body.joints import JOINT_INDEX
from intercap_core.evaluation import figures
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.known import finite, over_known
from intercap_core.evaluation.verdict.figures import verdict_figures
from intercap_core.project import Project
from intercap_core.schemas import FRAMES, JOINT, SCENE, TRUTH
from intercap_core.stages.export import MARKER
from intercap_core.studio.subjects import Subject

# Datasets of the conditions
NO_DEPTH, ALONE, BEAM = "field_no_depth", "field_alone", "field_beam"
BUILDS, SHOES, PASSER_BY = "field_builds", "field_shoes", "field_passer_by"
# Errors per stage in the metrics artefact that are averaged over the recordings with a beam
_BEAM_KEYS = ("body_pve", "planted_height", "planted_speed", "foot_swing")
_BONES = (
    ("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"),
)  # fmt: skip


@dataclass(frozen=True)
class UpError:
    """Error of the up direction of a scene whose floor no surface shows."""

    error_deg: float
    """Angle between the estimated and the true up direction, degrees."""
    stated_deg: float
    """Stated standard deviation of the angle, degrees."""


@dataclass(frozen=True, eq=False)
class FieldSequence:
    """Errors of one recording under field conditions."""

    metrics: SequenceMetrics
    bones: np.ndarray
    """(B,) relative errors of the lengths of the limbs' bones, fitted / true - 1."""
    height_m: float
    """Fitted minus true height of the person, metres."""
    subject_right: float
    """Share of the images with a chosen person that show the subject."""
    exported_alone: bool
    """Whether the export has a body and no object."""
    up: UpError | None
    """Error of the up direction; None where a surface showed the floor."""


FieldSequences = Measured[FieldSequence]


def measure(project: Project, sequence: str) -> FieldSequence:
    """Errors of one recording after ``metrics``."""
    paths, truth = project.paths(sequence), truth_of(project, sequence)
    with artefacts.read(paths.joint, JOINT) as fitted, artefacts.read(truth, TRUTH) as true:
        gender = project.subjects[project.sequences[sequence].subject].gender
        model = load_model(project.config.body_models, gender, fitted)
        shape = torch.as_tensor(np.atleast_2d(fitted["betas"]), dtype=model.dtype)
        rest = model.zeros(1)
        rest.betas = shape
        with torch.no_grad():
            vertices = model.forward(rest).vertices[0].numpy()
        own, known = (_lengths(a["joints"]) for a in (fitted, true))
        person = Subject.load(str(true.attributes["subject"]))
    height = float(np.ptp(vertices[:, 1])) - float(np.ptp(person.rest[:, 1]))
    metrics = SequenceMetrics.read(project.artefact(sequence, "metrics"))
    right = field_errors.measure_subject_share(paths.person, paths.scene, truth)
    alone = exported_alone(project.artefact(sequence, "export"))
    return FieldSequence(
        metrics, own / known - 1, height, right, alone, up_error(paths.scene, truth)
    )


def up_error(scene: Path, truth: Path) -> UpError | None:
    """Compare the up direction of a scene with the truth; None where a surface showed the floor."""
    with artefacts.read(scene, SCENE) as found, artefacts.read(truth, TRUTH) as true:
        if found.attributes["up_source"] == "floor":
            return None
        up, true_up = found["zup_from_master"][2, :3], true["ground_normal"]
        stated = float(found.attributes["up_deviation_deg"])
    return UpError(float(np.degrees(np.arccos(np.clip(up @ true_up, -1, 1)))), stated)


def exported_alone(folder: Path) -> bool:
    """Whether ``folder`` is a complete export with a body and without an object."""
    if not (folder / MARKER).is_file():
        return False
    marker = json.loads((folder / MARKER).read_text(encoding="utf-8"))
    complete = all((folder / name).is_file() for name in marker["files"])
    names = {Path(name).name for name in marker["files"]}
    return complete and "body.npz" in names and "object.npz" not in names and not marker["object"]


def last_stage(project: Project) -> str | None:
    """The export for people without an object; None = the metrics."""
    return "export" if project.config.dataset == ALONE else None


def seconds(project: Project, sequence: str) -> Figures:
    """``verdict.seconds_per_frame`` of one recording, measured as by `intercap dev bench`."""
    with artefacts.read(project.artefact(sequence, "frames"), FRAMES) as recorded:
        frames = len(recorded["times"])
    return time_hold_out(project.path, sequence, frames)


def _lengths(joints: np.ndarray) -> np.ndarray:
    """Median lengths (B,) over time of the limbs' bones, from joints (T, 55, 3)."""
    ends = [
        [JOINT_INDEX[f"{side}_{name}"] for name in bone]
        for side in ("left", "right")
        for bone in _BONES
    ]
    a, b = np.array(ends).T
    return np.median(np.linalg.norm(joints[:, a] - joints[:, b], axis=2), axis=0)


def flat(evaluations: Sequence[FieldSequences]) -> Figures:
    """Keys ``field.<measure>`` and ``verdict.<measure>``."""
    every = [e.metrics for found in evaluations for e in found.errors]
    found = keyed("verdict.", verdict_figures(every))
    found |= keyed("verdict.", figures.bad_frame_figures([m for m in every if m.has_truth]))
    for dataset, name in ((NO_DEPTH, "no_depth"), (BUILDS, "builds"), (SHOES, "shoes")):
        some = [e for found in evaluations if found.dataset == dataset for e in found.errors]
        found |= keyed(f"field.{name}_", _body_figures(some)) if some else {}
    if "field.builds_pve_mm" in found and "field.no_depth_pve_mm" in found:
        found["field.builds_ratio"] = found["field.builds_pve_mm"] / found["field.no_depth_pve_mm"]
    on_beam = [e.metrics for some in evaluations if some.dataset == BEAM for e in some.errors]
    for stage in ("body_fit", "joint"):
        suffix = "" if stage == "joint" else f"_{stage}"
        for key in _BEAM_KEYS:
            values = figures.pooled(on_beam, f"truth/{stage}/{key}")
            if values is not None:
                unit = "mm_s" if key == "planted_speed" else "mm"
                name = key.removeprefix("body_").removesuffix("_speed")
                mean = 1e3 * over_known(np.nanmean, values)
                found |= finite({f"field.beam_{name}_{unit}{suffix}": mean})
    found |= _up_figures([e.up for some in evaluations for e in some.errors if e.up is not None])
    several = [found for found in evaluations if found.dataset == PASSER_BY]
    if several:
        shares = [e.subject_right for some in several for e in some.errors]
        shares += [0.0 for some in several for _ in some.missing]
        found["field.subject_right_share"] = float(np.mean(shares))
        if every := [e.metrics for some in several for e in some.errors]:
            found["field.passer_by_pve_mm"] = figures.truth_figures(every, "joint")["body_pve_mm"]
    alone = [found for found in evaluations if found.dataset == ALONE]
    if alone:
        whole = [_is_person_alone(e) for some in alone for e in some.errors]
        count = len(whole) + sum(len(some.missing) for some in alone)
        found["field.people_alone_share"] = sum(whole) / count
    return found


def _up_figures(errors: Sequence[UpError]) -> Figures:
    """Mean error of the up direction, its stated deviation, and the largest ratio of the two."""
    if not errors:
        return {}
    off, stated = (
        np.array([getattr(e, name) for e in errors]) for name in ("error_deg", "stated_deg")
    )
    return {
        "field.up_error_deg": float(off.mean()),
        "field.up_error_worst_deg": float(off.max()),
        "field.up_stated_deg": float(stated.mean()),
        "field.up_error_over_stated_worst": float((off / stated).max()),
    }


def _body_figures(some: Sequence[FieldSequence]) -> Figures:
    """Errors of skin, bone lengths and height of the recordings' bodies."""
    bones = np.abs(np.stack([e.bones for e in some])).mean(axis=1)  # by person
    return {
        "pve_mm": figures.truth_figures([e.metrics for e in some], "joint")["body_pve_mm"],
        "bone_percent": 100 * float(bones.mean()),
        "bone_worst_percent": 100 * float(bones.max()),
        "height_mm": 1e3 * float(np.mean([abs(e.height_m) for e in some])),
    }


def _is_person_alone(sequence: FieldSequence) -> bool:
    """Whether metrics and export have a body and no object."""
    has = figures.truth_figures([sequence.metrics], "joint")
    measured = "body_pve_mm" in has and not any(name.startswith("object") for name in has)
    return measured and sequence.exported_alone


PART = EvaluationPart(
    name="field",
    stage="metrics",
    settings=(
        *config_files("evaluation", "config"),
        *config_files(
            "field", "no_depth", "builds", "shoes", "two_views", "alone", "beam", "passer_by"
        ),
    ),
    budget_minutes=12.5,
    measure=measure,
    flat=flat,
    columns=(
        "verdict.coverage_body", "verdict.coverage_hands", "verdict.coverage_object", "pve_mm",
        "bone_percent", "height_mm", "subject_right_share", "people_alone_share", "up_error_deg",
        "up_stated_deg",
    ),
    areas=("field",),
    last=last_stage,
    timed=seconds,
)  # fmt: skip
