"""`intercap status`: which outputs are done, out of date, failed, running or waiting, and why."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass

from rich.markup import escape
from rich.table import Table

from intercap_core.commands.console import ListTable, counted, standard_console
from intercap_core.inputs.files import name_some, printable
from intercap_core.pipeline.job import read_state
from intercap_core.pipeline.lease import lease_holder
from intercap_core.pipeline.plan import OutputStatus, Plan
from intercap_core.project import Project
from intercap_core.stage_list import STAGES

ROWS = 40  # printed sequences that are not done
DONE, RUNNING, FAILED, STALE, MISSING = "done", "running", "failed", "out of date", "missing"
_STATES = {OutputStatus.done: DONE, OutputStatus.missing: MISSING, OutputStatus.stale: STALE}
WAITING = "waits"  # for an artefact that the stage reads and that is not done
_MARKS = {
    DONE: "[green]✓[/green]", RUNNING: "[yellow]▶[/yellow]", FAILED: "[red]✗[/red]",
    STALE: "[yellow]≠[/yellow]", MISSING: "·", WAITING: "[dim]…[/dim]",
}  # fmt: skip
_LABELS = {state: state for state in _MARKS} | {
    MISSING: "not computed yet", WAITING: "waits for an earlier stage"
}  # fmt: skip


@dataclass(frozen=True)
class StageStatus:
    """State of one output."""

    state: str
    """``DONE``, ``RUNNING``, ``FAILED``, ``STALE``, ``MISSING`` or ``WAITING``."""
    reasons: tuple[str, ...] = ()
    """Reasons of a stale or failed output, or the process that is computing it."""
    made_on: str = ""
    """Device and processor that computed the output; "" if they are those of this machine."""


@dataclass(frozen=True)
class Status:
    """State of a project."""

    sequences: Mapping[str, Mapping[str, StageStatus]]
    """State by sequence and stage."""
    dataset: StageStatus
    """State of the outputs of all sequences."""

    def of(self, sequence: str) -> str:
        """State of a sequence: the first of running, failed, stale, missing, waiting that a stage
        has, otherwise done."""
        states = {stage.state for stage in self.sequences[sequence].values()}
        order = (RUNNING, FAILED, STALE, MISSING, WAITING)
        return next((state for state in order if state in states), DONE)


def status(project: Project) -> Status:
    """Determine the state of every output from its manifest, log and lease."""
    plan = Plan(project)
    sequences = {name: _of_sequence(project, plan, name) for name in project.sequences}
    dataset = StageStatus(_STATES[plan.dataset.status], plan.dataset.reasons)
    return Status(sequences, dataset)


def _of_sequence(project: Project, plan: Plan, name: str) -> dict[str, StageStatus]:
    outputs: dict[str, StageStatus] = {}
    for stage, state in plan.states(name).items():
        log = project.logs / name / f"{stage}.log"
        reads = STAGES[stage].reads if stage in STAGES else ()
        if (owner := lease_holder(plan.output(name, stage))) is not None:
            outputs[stage] = StageStatus(RUNNING, (str(owner),))
        elif state.status is OutputStatus.done:
            outputs[stage] = StageStatus(DONE, (), state.made_on)
        elif log.is_file() and (end := read_state(log))[0] == "failed":
            outputs[stage] = StageStatus(FAILED, (end[1],))
        elif any(outputs[other].state != DONE for other in reads if other in outputs):
            outputs[stage] = StageStatus(WAITING)
        else:
            outputs[stage] = StageStatus(_STATES[state.status], state.reasons)
    return outputs


def print_status(project: Project, *, every: bool = False, as_json: bool = False) -> None:
    """Print counts, a table of the sequences that are not done, and the reasons.

    With ``every``, the table includes the sequences that are done. With ``as_json``, all states are
    printed as JSON instead.
    """
    current = status(project)
    if as_json:
        print(json.dumps(_to_json(current), indent=1, ensure_ascii=False))
        return
    console = standard_console()
    states = {name: current.of(name) for name in current.sequences}
    counts = {state: list(states.values()).count(state) for state in _MARKS}
    words = ", ".join(f"{count} {_LABELS[state]}" for state, count in counts.items() if count)
    print(f"{project.config.dataset}, {counted(len(states), 'sequence')}: {words}")
    shown = [name for name in states if every or states[name] != DONE]
    if shown:
        console.print(_table(current, shown[:ROWS] if not every else shown))
    if len(shown) > ROWS and not every:
        print(f"... and {len(shown) - ROWS} more; --all prints them")
    if shown:
        marks = ", ".join(f"{mark} {_LABELS[state]}" for state, mark in _MARKS.items())
        console.print(f"[dim]{marks}[/dim]", highlight=False)
    for line in _reasons(current):
        print(line)
    if current.dataset.state != DONE:
        why = f": {'; '.join(current.dataset.reasons)}" if current.dataset.reasons else ""
        label = _LABELS[current.dataset.state]
        print(f"the site's first page, tables and card are {label}{why}")
    for machine, count in _other_machines(current).items():
        print(
            f"{count} results were computed on another machine or device ({machine}); they may "
            "differ in the last digits and are not recomputed"
        )


def _table(current: Status, names: list[str]) -> Table:
    stages = list(dict.fromkeys(stage for name in names for stage in current.sequences[name]))
    table = ListTable("sequence", *stages)
    for name in names:
        own = current.sequences[name]
        table.add_row(
            escape(name), *(_MARKS[own[stage].state] if stage in own else "" for stage in stages)
        )
    return table


def _reasons(current: Status) -> list[str]:
    """Each reason with its stage and sequences, most frequent first."""
    sequences: dict[tuple[str, str, str], list[str]] = {}
    for name, stages in current.sequences.items():
        for stage, output in stages.items():
            if output.state in (FAILED, STALE, RUNNING):
                for words in output.reasons:
                    sequences.setdefault((output.state, stage, words), []).append(name)
    lines = []
    order = (FAILED, STALE, RUNNING)
    for (state, stage, words), names in sorted(
        sequences.items(), key=lambda item: (order.index(item[0][0]), -len(item[1]))
    ):
        lines.append(f"{stage} {state} in {name_some(names, 6)}: {words}")
    return lines


def _other_machines(current: Status) -> Counter[str]:
    """Number of outputs by the other machine that made them."""
    return Counter(
        output.made_on
        for stages in current.sequences.values()
        for output in stages.values()
        if output.made_on
    )


def _to_json(current: Status) -> dict[str, object]:
    return {
        "sequences": {
            name: {
                "state": current.of(name),
                "stages": {stage: asdict(output) for stage, output in stages.items()},
            }
            for name, stages in current.sequences.items()
        },
        "dataset": asdict(current.dataset),
    }


def print_verification(project: Project) -> bool:
    """Read every output and print the damaged and missing ones; True if there are none."""
    by_sequence = Plan(project).all_faults().values()
    faults = [words for by_stage in by_sequence for words in by_stage.values()]
    for words in faults:
        print(printable(words))
    read, wrong = counted(len(project.sequences), "sequence"), counted(len(faults), "output")
    print(f"{read} read, {wrong} damaged or missing")
    return not faults
