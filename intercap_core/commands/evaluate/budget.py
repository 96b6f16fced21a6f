"""Budgeted and measured minutes of each part of the evaluation."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from intercap_core.commands.evaluate.part import Figures, Targets
from intercap_core.project import Project
from intercap_core.stage_list import STAGES

STUDIO = "studio"


class Job(NamedTuple):
    """A stage of one recording, or the rendering of a virtual recording (stage ``STUDIO``)."""

    project: Project
    sequence: str
    stage: str

    def seconds(self) -> float:
        """Wall seconds of the last run, from the workflow's benchmark file; 0 if unknown."""
        folder = Path("benchmarks") / self.project.config.dataset / self.sequence
        try:
            with open(folder / f"{self.stage}.tsv", encoding="utf-8") as file:
                return float(next(csv.DictReader(file, delimiter="\t"))["s"])
        except (OSError, StopIteration, KeyError, ValueError):
            return 0.0


def list_jobs(project: Project, stages: Sequence[str]) -> list[Job]:
    """All jobs that a project's target ``stages`` need, including the recordings."""
    wanted, pending = set(), list(stages)
    while pending:
        stage = pending.pop()
        if stage not in wanted:
            wanted.add(stage)
            pending += [name for name in STAGES[stage].reads if name in STAGES]
    ordered = [stage for stage in STAGES if stage in wanted]
    return [
        Job(project, name, stage)
        for name in project.sequences
        for stage in [*([STUDIO] if project.recordings_made(name) is not None else []), *ordered]
    ]


def jobs_by_part(parts: Mapping[str, Targets]) -> dict[str, list[Job]]:
    """Jobs that each part adds; shared jobs belong to the first part that needs them."""
    known: set[tuple[Path, str, str]] = set()
    jobs: dict[str, list[Job]] = {}
    for part, targets in parts.items():
        jobs[part] = []
        for job in (job for stage, project in targets for job in list_jobs(project, [stage])):
            key = (job.project.results.resolve(), job.sequence, job.stage)
            if key not in known:
                known.add(key)
                jobs[part].append(job)
    return jobs


def minutes_of_parts(parts: Mapping[str, Targets]) -> Figures:
    """Figures ``<part>_minutes_taken`` on two fully used cores.

    Each is the sum over all jobs of the last run's duration, halved; the last run may belong to an
    earlier evaluation.
    """
    return {
        f"{part}_minutes_taken": sum(job.seconds() for job in jobs) / (2 * 60)
        for part, jobs in jobs_by_part(parts).items()
    }


def print_minutes(parts: Sequence[str], minutes: Figures, duration: float) -> None:
    """Print one row per part, and the ``duration`` of this run in minutes."""
    console = Console()
    table = Table("part", "budget", "taken", box=None, title="minutes on 2 cores")
    for part in parts:
        budget, taken = (minutes[f"{part}_minutes_{key}"] for key in ("budget", "taken"))
        excess = "over its budget" if taken > budget else ""
        table.add_row(part, f"{budget:.1f}", f"{taken:.1f}", excess)
    console.print(table)
    console.print(f"this run took {duration:.1f} minutes of wall time", highlight=False)
