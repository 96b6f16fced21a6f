"""Part ``captures`` of `intercap dev evaluate`: scene artefacts compared with truth."""

from __future__ import annotations

from collections.abc import Sequence

from bench.evaluate import capture_errors
from bench.evaluate.capture_errors import CaptureErrors
from bench.evaluate.part import (
    EvaluationPart,
    Figures,
    Measured,
    config_files,
    keyed,
    truth_of,
    with_spread,
)
from intercap_core.project import Project

Captures = Measured[CaptureErrors]


def measure(project: Project, sequence: str) -> CaptureErrors:
    """Errors of one capture after ``scene``."""
    paths = project.paths(sequence)
    return capture_errors.measure(paths.frames, paths.scene, truth_of(project, sequence))


def flat(evaluations: Sequence[Captures]) -> Figures:
    """Keys ``<dataset>.<measure>``."""
    found: Figures = {}
    for captured in evaluations:
        figures = with_spread(capture_errors.figures, captured.errors)
        found |= keyed(f"{captured.dataset}.", figures)
    return found


PART = EvaluationPart(
    name="captures",
    stage="scene",
    settings=config_files("capture", "config", "family_b", "noise_2"),
    budget_minutes=4.6,
    measure=measure,
    flat=flat,
    columns=(
        "extrinsics_after_mm", "extrinsics_floor_only_mm", "extrinsics_worst_camera_mm",
        "offset_error_ms", "slips_true", "slips_missed", "slips_false", "ground_error_mm",
        "ground_error_deg",
    ),
)  # fmt: skip
