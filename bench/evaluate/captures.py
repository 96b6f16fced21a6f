"""Part ``captures`` of `intercap dev evaluate`: scene artefacts compared with truth."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bench.evaluate import capture_errors
from bench.evaluate.capture_errors import CaptureErrors
from bench.evaluate.part import (
    SPREAD,
    EvaluationPart,
    Figures,
    Measured,
    config_files,
    keyed,
    number,
    truth_of,
    with_spread,
)
from intercap_core.commands.console import ListTable, standard_console
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


def print_captures(evaluations: Sequence[Captures]) -> None:
    """Print a table with a row per capture, and a table of figures with a column per project."""
    console = standard_console()
    heads = ("room", "poses mm", "after", "worst", "offset ms", "slips", "false", "floor mm",
             "deg")  # fmt: skip
    table = ListTable("capture", *heads, title="captures against truth, after scene")
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
    columns = [with_spread(capture_errors.figures, found.errors) for found in evaluations]
    names = [name for column in columns for name in column if not name.endswith(SPREAD)]
    table = ListTable("measure", *(found.dataset for found in evaluations))
    table.title = "all captures, after scene (+- standard error over captures)"
    for name in dict.fromkeys(names):
        table.add_row(name, *(_cell(column, name) for column in columns))
    console.print(table)


def _cell(figures: Figures, name: str) -> str:
    value, error = (figures.get(key, math.nan) for key in (name, f"{name}{SPREAD}"))
    return number(value, 3) + (f" +- {error:.3f}" if math.isfinite(error) else "")


def _mean_mm(values: np.ndarray, digits: int = 1) -> str:
    return number(1e3 * float(values.mean()), digits) if len(values) else ""


PART = EvaluationPart(
    name="captures",
    stage="scene",
    settings=config_files("capture", "config", "family_b", "noise_2"),
    budget_minutes=4.6,
    measure=measure,
    flat=flat,
    print_tables=print_captures,
)
