"""`intercap status`: which sequences are done, out of date and why, failed, running, or waiting."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from intercap_core.pipeline.checksums import find_damage
from intercap_core.pipeline.job import read_state
from intercap_core.pipeline.lease import lease_holder
from intercap_core.pipeline.plan import OutputState, OutputStatus, Plan
from intercap_core.pipeline.provenance import read_manifest
from intercap_core.progress import Progress
from intercap_core.project import Project
from intercap_core.stage_list import STAGES

log = logging.getLogger(__name__)

ROWS = 40  # sequences printed that are not done
NAMES = 6  # sequences named beside a reason
DONE, RUNNING, FAILED, STALE, MISSING = "done", "running", "failed", "out of date", "missing"
WAITING = "waits"  # what it is made of is not done
_MARKS = {
    DONE: "[green]✓[/green]", RUNNING: "[yellow]▶[/yellow]", FAILED: "[red]✗[/red]",
    STALE: "[yellow]≠[/yellow]", MISSING: "·", WAITING: "[dim]…[/dim]",
}  # fmt: skip


@dataclass(frozen=True)
class StageStatus:
    """State of one output in one of the words above, and the reasons or who makes it."""

    state: str
    words: tuple[str, ...] = ()
    made_on: str = ""


@dataclass(frozen=True)
class Status:
    """By sequence and stage, and of what is made of all sequences."""

    sequences: Mapping[str, Mapping[str, StageStatus]]
    dataset: StageStatus

    def of(self, sequence: str) -> str:
        """The sequence's own state: the most telling of its stages'."""
        found = {stage.state for stage in self.sequences[sequence].values()}
        order = (RUNNING, FAILED, STALE, MISSING, WAITING)
        return next((state for state in order if state in found), DONE)


def status(project: Project) -> Status:
    """Look at every output, its record, its log and its claim; nothing is computed."""
    plan = Plan(project)
    sequences = {name: _of_sequence(project, plan, name) for name in project.sequences}
    dataset = plan.dataset
    plan.save()
    words = {OutputStatus.done: DONE, OutputStatus.missing: MISSING, OutputStatus.stale: STALE}[
        dataset.status
    ]
    return Status(sequences, StageStatus(words, dataset.reasons))


def _of_sequence(project: Project, plan: Plan, name: str) -> dict[str, StageStatus]:
    states = plan.states(name)
    found: dict[str, StageStatus] = {}
    for stage, state in states.items():
        output = plan.output(name, stage)
        owner = lease_holder(output)
        if owner is not None:
            found[stage] = StageStatus(RUNNING, (str(owner),))
        elif state.status is OutputStatus.done:
            found[stage] = StageStatus(DONE, (), state.made_on)
        else:
            found[stage] = _not_done(project, name, stage, state, found)
    return found


def _not_done(
    project: Project, name: str, stage: str, state: OutputState, found: Mapping[str, StageStatus]
) -> StageStatus:
    log = project.logs / name / f"{stage}.log"
    if log.is_file():
        ended, words = read_state(log)
        if ended == "failed":
            return StageStatus(FAILED, (words,))
    reads = STAGES[stage].reads if stage in STAGES else ()
    if any(found[other].state != DONE for other in reads if other in found):
        return StageStatus(WAITING)
    return StageStatus(STALE if state.status is OutputStatus.stale else MISSING, state.reasons)


def print_status(project: Project, *, every: bool = False, as_json: bool = False) -> None:
    """Print counts, a table of the sequences that are not done (``every``: of all) and the reasons;
    ``as_json``: everything for programs."""
    found = status(project)
    if as_json:
        print(json.dumps(_json(found), indent=1, ensure_ascii=False))
        return
    console = Console()
    states = {name: found.of(name) for name in found.sequences}
    counts = {state: list(states.values()).count(state) for state in _MARKS}
    told = ", ".join(f"{count} {state}" for state, count in counts.items() if count)
    console.print(f"{project.config.dataset}: {told} of {len(states)} sequences", highlight=False)
    shown = [name for name in states if every or states[name] != DONE]
    if shown:
        console.print(_table(found, shown[:ROWS] if not every else shown))
    if len(shown) > ROWS and not every:
        console.print(f"... and {len(shown) - ROWS} more; --all prints them", highlight=False)
    if shown:
        marks = ", ".join(f"{mark} {state}" for state, mark in _MARKS.items())
        console.print(f"[dim]{marks}[/dim]", highlight=False)
    for line in _reasons(found):
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    if found.dataset.state != DONE:
        why = f": {'; '.join(found.dataset.words)}" if found.dataset.words else ""
        words = f"the site's first page, tables and card are {found.dataset.state}{why}"
        console.print(words, highlight=False, markup=False, soft_wrap=True)
    for machine, count in _elsewhere(found).items():
        console.print(
            f"{count} results were made on another machine or device ({machine}); they may differ "
            "in the last digits, and are not made anew for it",
            highlight=False, markup=False, soft_wrap=True,
        )  # fmt: skip


def _table(found: Status, names: list[str]) -> Table:
    stages = list(dict.fromkeys(stage for name in names for stage in found.sequences[name]))
    table = Table("sequence", *stages, box=None, header_style="bold", pad_edge=False)
    for name in names:
        own = found.sequences[name]
        table.add_row(
            escape(name), *(_MARKS[own[stage].state] if stage in own else "" for stage in stages)
        )
    return table


def _reasons(found: Status) -> list[str]:
    """Each reason once, with the stage and the sequences that have it, the most frequent first."""
    having: dict[tuple[str, str, str], list[str]] = {}
    for name, stages in found.sequences.items():
        for stage, one in stages.items():
            if one.state in (FAILED, STALE, RUNNING):
                for words in one.words:
                    having.setdefault((one.state, stage, words), []).append(name)
    lines = []
    order = (FAILED, STALE, RUNNING)
    for (state, stage, words), names in sorted(
        having.items(), key=lambda item: (order.index(item[0][0]), -len(item[1]))
    ):
        more = f" and {len(names) - NAMES} more" if len(names) > NAMES else ""
        lines.append(f"{stage} {state} in {', '.join(names[:NAMES])}{more}: {words}")
    return lines


def _elsewhere(found: Status) -> dict[str, int]:
    counts: dict[str, int] = {}
    for stages in found.sequences.values():
        for one in stages.values():
            if one.made_on:
                counts[one.made_on] = counts.get(one.made_on, 0) + 1
    return counts


def _json(found: Status) -> dict[str, object]:
    def told(one: StageStatus) -> dict[str, object]:
        return {"state": one.state, "reasons": list(one.words), "made_on": one.made_on}

    return {
        "sequences": {
            name: {"state": found.of(name), "stages": {s: told(one) for s, one in stages.items()}}
            for name, stages in found.sequences.items()
        },
        "dataset": told(found.dataset),
    }


def print_verification(project: Project) -> bool:
    """Read all data of every artefact and record, name what is damaged; whether all is whole."""
    paths = [
        project.artefact(name, stage)
        for name in project.sequences
        for stage in STAGES
        if project.artefact(name, stage).exists()
    ]
    console = Console()
    damaged: list[str] = []
    progress = Progress(log, "verified", len(paths), "files")
    for path in paths:
        found = find_damage(path)
        if not found and read_manifest(path) is None:
            found = f"{path}: what it was made from is not recorded, or damaged"
        damaged += [found] if found else []
        progress.step()
    for words in damaged:
        console.print(words, highlight=False, markup=False, soft_wrap=True)
    console.print(f"{len(paths)} outputs read, {len(damaged)} damaged", highlight=False)
    return not damaged
