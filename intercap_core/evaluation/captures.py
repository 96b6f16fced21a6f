"""The capture's part of `intercap evaluate`: recordings taken to the scene and held to truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rich.table import Table

from intercap_core.evaluation.recordings import console_of, number, take_to
from intercap_core.metrics import capture
from intercap_core.metrics.capture import CaptureErrors
from intercap_core.project import Project

_WIDTH = 112


@dataclass(frozen=True)
class CaptureEvaluation:
    """Errors of every capture of one project, their figures, and the workflow's exit status."""

    area: str
    errors: Sequence[CaptureErrors]
    figures: dict[str, float]
    missing: Sequence[str]
    status: int


def evaluate_captures(project: Project, *, cores: int = 0) -> CaptureEvaluation:
    """Bring the scenes of all sequences up to date and measure them; no later stage is run.

    Raises UserError where a sequence has no truth to hold it to, or none has a scene.
    """
    taken = take_to(project, "scene", cores=cores)
    errors = [
        capture.measure(project.artefact(name, "frames"), scene, taken.truths[name])
        for name, scene in taken.artefacts.items()
    ]
    area = project.config.dataset
    return CaptureEvaluation(area, errors, capture.figures(errors), taken.missing, taken.status)


def print_captures(evaluations: Sequence[CaptureEvaluation]) -> None:
    """One table with a row for each capture, one of the figures with a column for each project."""
    console = console_of(_WIDTH)
    heads = ("room", "poses mm", "after", "worst", "offset ms", "slips", "false", "floor mm",
             "deg")  # fmt: skip
    table = Table("capture", *heads, box=None, title="captures against truth, after scene")
    for found in evaluations:
        for e in found.errors:
            table.add_row(
                e.sequence,
                e.room,
                _mean_mm(e.before),
                _mean_mm(e.after),
                f"{1e3 * e.after.max():.1f}" if len(e.after) else "",
                _mean_mm(np.abs(e.offset), 2),
                f"{e.slips.found} of {e.slips.found + e.slips.missed}",
                str(e.slips.false),
                number(1e3 * e.ground_m, 2),
                number(e.ground_deg, 3),
            )
        for name in found.missing:
            table.add_row(name, "no scene")
    console.print(table)
    names = list(dict.fromkeys(name for found in evaluations for name in found.figures))
    table = Table("measure", *(found.area for found in evaluations), box=None)
    table.title = "all captures, after scene"
    for name in names:
        values = (found.figures.get(name, math.nan) for found in evaluations)
        table.add_row(name, *(number(value, 3) for value in values))
    console.print(table)


def _mean_mm(values: np.ndarray, digits: int = 1) -> str:
    return number(1e3 * float(values.mean()), digits) if len(values) else ""
