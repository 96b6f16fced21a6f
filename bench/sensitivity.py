"""Effect of half and of double the value of each constant of a stage's package.

    python -m bench.sensitivity [SETTINGS] --constants object_track scene.slips:MIN_GAIN
        [--sequences NAME ...] [--stage NAME] [--jobs 2] [--known results/sensitivity.json]

``--constants`` names packages, modules, ``package.NAME`` or ``package.module:NAME``. For each
value the package's stage is replayed from stored artefacts of virtual recordings, in a process of
its own and a temporary folder; no file of the project is overwritten. Printed are the errors
against truth that change by 2 % or more, and last the constants without any effect on the stage's
arrays. Shares stay below 1 and integers stay integers. Outcomes are stored in ``--known`` by
content, so an interrupted run continues.

Short recordings of one studio show which constants matter, not which value is best: a constant
without effect here may still decide on another recording.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from threading import Lock

from bench.again import check_run, content_of
from bench.changed_constant import Constant, find_constants, kernels_with
from bench.command import exit_on_user_error
from bench.replay import IMAGES_ONLY, Outcome, Task
from bench.stage_figures import FLAGS, STAGES_WITH_FIGURES
from intercap_core.errors import UserError
from intercap_core.project import load_project

SETTINGS = Path("config/demo/config.yaml")
SEQUENCES = ("cup_drink_s02", "stool_sit_s01")  # three seconds each, of `make demo`
FACTORS = (0.5, 2.0)
CHANGED = 0.02  # relative change of a figure from which it is printed


def task_of(constant: Constant, stage: str | None, settings: Path, sequences: list[str]) -> Task:
    """The unchanged replay that a constant is compared with.

    Raises UserError if the constant's package has no stage and ``stage`` is None.
    """
    _, package, *rest = constant.module.split(".")
    if stage is None and package == "person" and rest[:1] == ["segmentation"]:
        stages: tuple[str, ...] = ("person", "object_track")
        return Task(str(settings), tuple(sequences), stages, IMAGES_ONLY)
    stage = stage or package
    if stage not in STAGES_WITH_FIGURES:
        raise UserError(
            f"{constant.label}: package {package!r} has no stage of its own; choose one with "
            f"--stage, of {', '.join(STAGES_WITH_FIGURES)}"
        )
    return Task(str(settings), tuple(sequences), (stage,), {})


class Replays:
    """Runs tasks in processes and stores their outcomes in a JSON file."""

    def __init__(self, path: Path, jobs: int) -> None:
        self._path, self._jobs, self._lock = path, jobs, Lock()
        self._known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        self._contents: dict[str, str] = {}

    def run(self, tasks: Sequence[Task]) -> list[Outcome]:
        """Outcomes of tasks; unknown ones are computed in parallel."""
        keys = [self._key(task) for task in tasks]
        with ThreadPoolExecutor(self._jobs) as pool:
            return list(pool.map(self._outcome, tasks, keys))

    def _key(self, task: Task) -> str:
        """Checksum of the code, settings and artefacts that a task reads, and of its change."""
        same = json.dumps(asdict(replace(task, constant=None, factor=1.0, unchanged="")))
        if same not in self._contents:
            project = load_project(Path(task.settings), dict(task.overrides))
            check_run(project, task.sequences, task.stages)
            contents = [content_of(task.stages, project, name) for name in task.sequences]
            self._contents[same] = "".join([same, *contents])
        text = f"{self._contents[same]}{task.constant}{task.factor}"
        return hashlib.sha256(text.encode()).hexdigest()[:24]

    def _outcome(self, task: Task, key: str) -> Outcome:
        if key not in self._known:
            outcome = _replayed(task)
            if outcome.failure and task.constant is None:
                return outcome  # not stored: the fault is not that of a value
            with self._lock:
                self._known[key] = asdict(outcome)
                self._path.parent.mkdir(parents=True, exist_ok=True)
                self._path.write_text(json.dumps(self._known, indent=1) + "\n", encoding="utf-8")
            name = task.constant.label if task.constant else f"{task.stages[-1]}, unchanged"
            print(f"{name} times {task.factor:g}: {outcome.seconds:.0f} s", file=sys.stderr)
        return Outcome(**self._known[key])


def _replayed(task: Task) -> Outcome:
    """Replay a task in a process of its own, on one thread."""
    stale = kernels_with(task.constant.module) if task.constant is not None else []
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "outcome.json"
        request = {"task": asdict(task), "output": str(output), "stale": stale}
        done = subprocess.run(
            [sys.executable, "-m", "bench.replay"], input=json.dumps(request), text=True,
            env=os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        if done.returncode:
            reason = f"the process ended with status {done.returncode}"
            return Outcome("", "", "", {}, 0.0, reason)
        return Outcome(**json.loads(output.read_text(encoding="utf-8")))


def changes(unchanged: Outcome, other: Outcome) -> dict[str, tuple[float, float, float]]:
    """Figures that differ by 2 % or more, and changed numbers of flagged frames.

    Returns value before, value after and relative change by the figure's name.
    """
    found = {}
    for name, before in unchanged.figures.items() if other.figures else ():
        after = other.figures.get(name, float("nan"))
        share = (after - before) / max(abs(before), 1e-9) if after != before else 0.0
        if after != before and (name == FLAGS or not abs(share) < CHANGED):
            found[name] = (before, after, share)
    return found


def report(
    constants: Sequence[Constant],
    unchanged: Sequence[Outcome],
    changed: Sequence[Sequence[Outcome]],
) -> str:
    """Table of the constants, most sensitive first, their counts, and those without effect."""
    rows, without_effect, decisive = [], [], 0
    for constant, usual, pair in zip(constants, unchanged, changed, strict=True):
        if all(outcome.checksum == usual.checksum for outcome in pair):
            without_effect.append(f"{constant.label} = {pair[0].before}")
            continue
        cells, most = [], 0.0
        decisive += any(outcome.failure or changes(usual, outcome) for outcome in pair)
        for outcome in pair:
            found = changes(usual, outcome)
            most = max([most, *(abs(s) for key, (*_, s) in found.items() if key != FLAGS)])
            text = ", ".join(f"{key} {a:.3g} → {b:.3g}" for key, (a, b, _) in found.items())
            if outcome.failure:
                text, most = f"fails: {outcome.failure}", float("inf")
            elif not text:
                same = outcome.checksum == usual.checksum
                text = "no effect" if same else f"less than {100 * CHANGED:g} %"
            cells.append(f"{outcome.after}: {text}" if outcome.after else text)
        value = next((outcome.before for outcome in pair if outcome.before), "")
        rows.append((most, f"| `{constant.label}` | {value} | {' | '.join(cells)} |"))
    lines = ["| constant | value | half | double |", "|---|---|---|---|"]
    lines += [line for _, line in sorted(rows, key=lambda row: -row[0])]
    counts = f"change a figure or let the stage fail: {decisive}; change arrays only: "
    lines += ["", f"{counts}{len(rows) - decisive}", ""]
    return "\n".join([*lines, f"without effect: {len(without_effect)}", *without_effect])


def main(arguments: Sequence[str] | None = None) -> None:
    """Read the command line, replay and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("settings", type=Path, nargs="?", default=SETTINGS)
    parser.add_argument("--constants", nargs="+", required=True, metavar="PACKAGE[.NAME]")
    parser.add_argument("--sequences", nargs="+", default=list(SEQUENCES))
    parser.add_argument("--stage", help="default: that of the constant's package")
    parser.add_argument("--known", type=Path, default=Path("results/sensitivity.json"))
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1))
    options = parser.parse_args(arguments)
    with exit_on_user_error():
        constants = [one for name in options.constants for one in find_constants(name)]
        tasks = [task_of(c, options.stage, options.settings, options.sequences) for c in constants]
        replays = Replays(options.known, options.jobs)
        distinct = list({task.stages: task for task in tasks}.values())
        usual = dict(zip([task.stages for task in distinct], replays.run(distinct), strict=True))
        if failures := [outcome.failure for outcome in usual.values() if outcome.failure]:
            raise UserError(f"the unchanged code cannot be replayed: {failures[0]}")
        values = [
            replace(task, constant=constant, factor=factor, unchanged=usual[task.stages].checksum)
            for task, constant in zip(tasks, constants, strict=True)
            for factor in FACTORS
        ]
        outcomes = replays.run(values)
        pairs = [outcomes[at : at + 2] for at in range(0, len(outcomes), 2)]
        print(report(constants, [usual[task.stages] for task in tasks], pairs))


if __name__ == "__main__":
    main()
