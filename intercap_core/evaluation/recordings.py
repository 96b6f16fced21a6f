"""Recordings with truth that are taken to one stage, for `intercap evaluate`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from intercap_core.commands.run import run_workflow
from intercap_core.errors import UserError
from intercap_core.project import Project


@dataclass(frozen=True)
class Taken:
    """The artefacts of one stage and the truths by sequence, sequences that have no artefact, and
    the workflow's exit status."""

    artefacts: dict[str, Path]
    truths: dict[str, Path]
    missing: Sequence[str]
    status: int


def take_to(project: Project, stage: str, *, cores: int = 0) -> Taken:
    """Bring ``stage`` of all sequences up to date; no later stage is run.

    Raises UserError where a sequence has no truth to hold it to, or none has come to the stage.
    """
    truths = {name: row.truth for name, row in project.sequences.items() if row.truth is not None}
    without = [name for name in project.sequences if name not in truths]
    if without:
        raise UserError(
            f"{project.path}: sequence {without[0]!r} has no truth to be evaluated against; leave "
            "it out, or name its truth in the table"
        )
    wanted = {name: project.artefact(name, stage) for name in project.sequences}
    status = run_workflow(
        project.path, cores=cores, arguments=[str(path) for path in wanted.values()]
    )
    made = {name: path for name, path in wanted.items() if path.is_file()}
    if not made:
        raise UserError(f"{project.path}: no sequence has a {stage}; look into {project.logs}")
    return Taken(made, truths, [name for name in wanted if name not in made], status)


def variant(dataset: str, *areas: str) -> str:
    """What stands before a measure's name: "noise2_" of object_noise2 in the area object."""
    for area in areas:
        if dataset == area or dataset.startswith(f"{area}_"):
            dataset = dataset.removeprefix(area)
            break
    name = dataset.strip("_")
    return f"{name}_" if name else ""


def console_of(width: int) -> Console:
    """A console for tables of this width: one that is cut when piped is of no use."""
    console = Console()
    console.width = max(console.width, width)
    return console


def number(value: float | None, digits: int) -> str:
    """A cell of a table; empty where the figure is not known."""
    return "" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"
