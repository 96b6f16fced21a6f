"""Part ``sequences`` of `intercap dev evaluate`: all stages compared with truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench.evaluate import sequence_figures
from bench.evaluate.part import (
    EvaluationPart,
    Figures,
    Measured,
    config_files,
    grouped,
    truth_of,
    with_spread,
)
from bench.evaluate.through_wall import count_behind_wall
from intercap_core.evaluation import figures
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.known import finite, over_known
from intercap_core.evaluation.physics.at_truth import displacements
from intercap_core.evaluation.physics.figures import physics_figures
from intercap_core.evaluation.verdict.figures import verdict_figures
from intercap_core.project import Project
from intercap_core.stage_list import ESTIMATES

# Further names of figures in the area ``joint``: area and name of the figure
ALSO = {
    "body_pve_sequential_mm": ("body_fit", "body_pve_mm"),
    "hand_grasp_sequential_mm": ("body_fit", "hand_grasp_mpjpe_mm"),
    "fingertip_touching_sequential_mm": ("body_fit", "fingertip_touching_mm"),
    "slip_sequential_mm_s": ("body_fit", "slip_mm_s"),
    "planted_sequential_mm_s": ("body_fit", "planted_mm_s"),
    "floor_sequential_mm": ("body_fit", "floor_mm"),
    "foot_swing_sequential_mm": ("body_fit", "foot_swing_mm"),
    "acceleration_feet_sequential_mm": ("body_fit", "acceleration_feet_mm"),
    "object_translation_median_mm": ("joint", "object_translation_mm"),
    "contact_vertex_f1": ("joint", "contact_f1"),
    "penetration_mean_mm": ("penetration", "mean_mm"),
    "extrinsics_mm": ("extrinsics", "joint_mean_mm"),
    "extrinsics_scene_mm": ("extrinsics", "after_mean_mm"),
}
Areas = dict[str, Figures]


@dataclass(frozen=True, eq=False)
class MeasuredSequence:
    """The metrics of one sequence."""

    metrics: SequenceMetrics
    annotated: bool
    """Whether the sequence has annotations."""
    behind_wall: np.ndarray
    """(2,) touched vertices of a thin-walled object, and those of them behind a wall."""
    displacement: dict[str, np.ndarray]
    """Displacements of the released object at the true, joint and sequential poses, metres."""


Sequences = Measured[MeasuredSequence]


def measure(project: Project, sequence: str) -> MeasuredSequence:
    """Read the metrics of one recording."""
    made = project.annotation_made(sequence) or project.annotation_path(sequence).exists()
    paths, models = project.paths(sequence), project.models(sequence)
    return MeasuredSequence(
        SequenceMetrics.read(paths.metrics),
        made,
        count_behind_wall(paths, models),
        displacements(paths, models, truth_of(project, sequence)),
    )


def areas(sequences: Sequence[SequenceMetrics]) -> Areas:
    """All figures of a group of sequences by area: the stages, and areas common to all stages."""
    known = [s for s in sequences if s.has_truth]
    found = {
        stage: {
            **figures.truth_figures(sequences, stage),
            **sequence_figures.hold_figures(known, stage),
            **{
                f"contact_f1_at_{mm:g}mm": value
                for mm, value in figures.contact_sweep(sequences, stage).items()
            },
        }
        for stage in ESTIMATES
    }
    found |= {
        "penetration": figures.penetration_figures(sequences),
        "vertex_to_cloud": figures.cloud_figures(sequences),
        "vertex_to_cloud_floor": figures.floor_figures(sequences),
        "extrinsics": figures.extrinsics_figures(sequences),
        "flags": figures.flag_figures(sequences),
        "verdict": verdict_figures(known) | figures.bad_frame_figures(known),
        "physics": physics_figures(sequences),
    }
    also = {name: found[area].get(key) for name, (area, key) in ALSO.items()}
    found["joint"] |= sequence_figures.stated_contact_figures(known) | _figures_by_object(known)
    found["joint"] |= {name: value for name, value in also.items() if value is not None}
    return found


def _figures_by_object(sequences: Sequence[SequenceMetrics]) -> Figures:
    """Figures of the area ``joint`` that are computed for each object."""
    found: Figures = {}
    for stage, suffix in (("joint", ""), ("body_fit", "_sequential")):
        slips = sequence_figures.slip_by_object(sequences, stage)
        found |= {f"slip_{name}{suffix}_mm_s": value for name, value in slips.items()}
    by_object = grouped([s for s in sequences if s.object_], "object_")
    if by_object:
        found["object_worse_count"] = float(len(sequence_figures.worse_objects(sequences)))
    for name, some in by_object.items():
        turn = figures.object_figures(some, "joint").get("object_rotation_p95_deg")
        if turn is not None:
            found[f"{name}.object_rotation_p95_deg"] = turn
    depths = [figures.penetration_figures(some).get("mean_mm") for some in by_object.values()]
    worst = over_known(np.nanmax, np.array(depths, float))
    return finite(found | {"penetration_worst_object_mm": worst})


def flat_areas(sequences: Sequence[SequenceMetrics]) -> Figures:
    """The figures of :func:`areas` with keys ``area.figure``."""
    return {
        f"{area}.{name}": value
        for area, found in areas(sequences).items()
        for name, value in found.items()
    }


def flat(evaluations: Sequence[Sequences]) -> Figures:
    """Keys ``joint.body_pve_mm``; areas of annotated sequences end in ``_annotated``."""
    found: Figures = {}
    every = [e for measured in evaluations for e in measured.errors]
    for suffix in ("", "_annotated"):
        sequences = [e.metrics for e in every if e.annotated == bool(suffix)]
        if not sequences:
            continue
        for key, value in with_spread(flat_areas, sequences).items():
            area, _, name = key.partition(".")
            found[f"{area}{suffix}.{name}"] = value
    touched, behind = sum((e.behind_wall for e in every), np.zeros(2))
    if touched:
        found["contact.through_wall_share"] = float(behind / touched)
    moved = [e.displacement for e in every if not e.annotated]
    for stage in ("truth", "joint", "sequential"):
        values = [value for some in moved if some for value in some[stage]]
        found[f"physics.displacement_{stage}_mm"] = 1e3 * over_known(np.mean, values)
    if "joint_annotated.contact_detected_f1" in found:
        found["joint.contact_detected_annotated_f1"] = found["joint_annotated.contact_detected_f1"]
    return finite(found)


PART = EvaluationPart(
    name="sequences",
    stage="metrics",
    settings=(*config_files("evaluation", "config"), *config_files("object", "config")),
    budget_minutes=16.3,
    measure=measure,
    flat=flat,
    columns=(
        "joint.body_pve_mm", "joint.hand_mpjpe_mm", "joint.fingertip_touching_mm",
        "joint.object_translation_mm", "joint.object_rotation_deg", "joint.contact_detected_f1",
        "joint.slip_mm_s", "joint.planted_mm_s", "joint.penetration_mean_mm",
        "extrinsics.joint_mean_mm",
    ),
)  # fmt: skip
