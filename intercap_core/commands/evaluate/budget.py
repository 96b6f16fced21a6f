"""Budgeted, expected and measured minutes of each part of the evaluation."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from intercap_core.commands.evaluate.part import Figures, Targets
from intercap_core.project import Project
from intercap_core.stage_list import STAGES

# Minutes on two cores that a part may add to `make evaluate`, for its recordings and the stages
# that no earlier part computes. The sum must stay below 120. Of the objects' 34 minutes 11 are for
# recordings with redrawn detections.
BUDGET_MINUTES = {
    "sequences": 23, "captures": 13, "objects": 34, "bodies": 12, "field_scenes": 15, "field": 22,
}  # fmt: skip
BUDGET_CORES = 2
STUDIO = "studio"
# CPU seconds per frame of six 720P views on one core of an Intel Xeon at 2.5 GHz, and per process
# start (imports, compiled code from the cache). Measured on a shared machine.
SECONDS_PER_FRAME = {
    STUDIO: 0.75, "frames": 0.03, "detections": 0.01, "scene": 0.28, "person": 0.26,
    "object_track": 0.40, "body_fit": 0.17, "joint": 0.30, "metrics": 0.26,
}  # fmt: skip
SECONDS_PER_START = 2.5
STUDIO_1080P = 1.35  # factor of the studio's time at 1080P over 720P
VIEWS = 6
FRAMES = 45  # if the settings state no number

Jobs = list[tuple[Project, str, str]]  # project, sequence, stage or STUDIO


def upstream_stages(last: str) -> list[str]:
    """Stage ``last`` and the stages on which it depends, in the order of the workflow."""
    wanted, pending = set(), [last]
    while pending:
        stage = pending.pop()
        if stage not in wanted:
            wanted.add(stage)
            pending += [name for name in STAGES[stage].reads if name in STAGES]
    return [stage for stage in STAGES if stage in wanted]


def expected_seconds(project: Project, stage: str, frames: int) -> float:
    """Expected CPU seconds of one job: a stage of a recording, or ``STUDIO``."""
    studio = project.config.studio
    made = VIEWS if studio is None else studio.cameras
    views = made if stage == STUDIO else len(project.config.frames.cameras) or made
    share = views / VIEWS
    if stage == STUDIO and studio is not None and studio.colour_mode != "720P":
        share *= STUDIO_1080P
    return SECONDS_PER_START + SECONDS_PER_FRAME.get(stage, 0.3) * share * frames


def recording_frames(projects: Sequence[Project]) -> dict[Path, int]:
    """Number of frames of each recording that the projects' studios render, by its folder."""
    return {
        (project.results / "recordings" / name).resolve(): entry.frames
        for project in projects
        if project.config.studio is not None
        for name, entry in project.config.studio.captures.items()
    }


def list_jobs(project: Project, stages: Sequence[str]) -> Jobs:
    """All jobs that a project's target ``stages`` need, including the recordings."""
    wanted = [stage for stage in STAGES if any(stage in upstream_stages(s) for s in stages)]
    found: Jobs = []
    for name in project.sequences:
        made = project.recordings_made(name) is not None
        found += [(project, name, stage) for stage in ([STUDIO] if made else []) + wanted]
    return found


def jobs_by_part(parts: Mapping[str, Targets]) -> dict[str, Jobs]:
    """Jobs that each part adds; shared jobs belong to the first part that needs them."""
    known: set[tuple[Path, str, str]] = set()
    found: dict[str, Jobs] = {}
    for part, targets in parts.items():
        found[part] = []
        for stage, project in targets:
            for job in list_jobs(project, [stage]):
                key = (project.results.resolve(), job[1], job[2])
                if key not in known:
                    known.add(key)
                    found[part].append(job)
    return found


def seconds_taken(job: tuple[Project, str, str]) -> float | None:
    """Wall seconds of a job's last run, from the workflow's benchmark file; None if unknown."""
    project, sequence, stage = job
    path = Path("benchmarks") / project.config.dataset / sequence / f"{stage}.tsv"
    try:
        with open(path, encoding="utf-8") as file:
            return float(next(csv.DictReader(file, delimiter="\t"))["s"])
    except (OSError, StopIteration, KeyError, ValueError):
        return None


def minutes_of_parts(jobs: Mapping[str, Jobs], frames: Mapping[Path, int]) -> Figures:
    """``<part>_minutes_budget``, ``_expected`` and ``_taken`` on two fully used cores.

    ``_taken`` sums every job's last run, whether in this evaluation or an earlier one.
    """
    found: Figures = {}
    per_minute = 60.0 * BUDGET_CORES
    for part, added in jobs.items():
        taken = [seconds for seconds in map(seconds_taken, added) if seconds is not None]
        expected = sum(
            expected_seconds(
                project,
                stage,
                frames.get(project.sequences[name].recordings.resolve(), FRAMES),
            )
            for project, name, stage in added
        )
        found[f"{part}_minutes_budget"] = BUDGET_MINUTES[part]
        found[f"{part}_minutes_expected"] = expected / per_minute
        found[f"{part}_minutes_taken"] = sum(taken) / per_minute
        found[f"{part}_jobs"] = float(len(added))
    return found


def print_minutes(parts: Sequence[str], figures: Figures, minutes: float) -> None:
    """Print one row per part, and the duration of this run."""
    console = Console()
    heads = ("jobs", "budget", "expected", "taken")
    table = Table("part", *heads, box=None, title=f"minutes on {BUDGET_CORES} cores")
    for part in parts:
        taken, budget = (figures[f"{part}_minutes_{key}"] for key in ("taken", "budget"))
        row = [f"{figures[f'{part}_jobs']:.0f}"]
        row += [f"{figures[f'{part}_minutes_{key}']:.1f}" for key in heads[1:]]
        table.add_row(part, *row, "over its budget" if taken > budget else "")
    console.print(table)
    console.print(f"this run took {minutes:.1f} minutes of wall time", highlight=False)
