"""Many projects brought up to date at once: two workflows side by side keep every core busy.

One workflow leaves cores idle while its last long job runs; another one fills them. The one whose
results most others wait for starts first, then the longest. A project whose recordings another one
makes waits for that one.
"""

from __future__ import annotations

import fcntl
import math
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from rich.console import Console
from rich.markup import escape

from intercap_core.commands.check import check_bodies
from intercap_core.commands.evaluate.budget import FRAMES, Jobs, expected_seconds, jobs_of
from intercap_core.commands.evaluate.part import Targets
from intercap_core.commands.run import LAST_LINES, POLL_SECONDS, Watcher, snakemake_command
from intercap_core.errors import UserError
from intercap_core.project import Project

SIDE_BY_SIDE = 2
TELL_SECONDS = 60.0
LOCK = Path(".snakemake") / "evaluation.lock"


@dataclass(eq=False)
class Order:
    """One project's targets, the jobs they need at most, and the projects to wait for."""

    project: Project
    stages: list[str]
    seconds: dict[str, list[float]]  # by rule, one a job
    after: list[Order] = field(default_factory=list)
    watcher: Watcher | None = None
    process: subprocess.Popen[bytes] | None = None
    transcript: IO[str] | None = None
    status: int | None = None

    @property
    def expected(self) -> float:
        """Seconds of CPU if nothing is kept."""
        return sum(map(sum, self.seconds.values()))

    def left(self) -> tuple[float, float]:
        """Expected CPU seconds of the jobs that are still to do, and of those that were done."""
        planned = self._planned()
        if self.status is not None:
            counts = (planned or {}).items()
            return 0.0, sum(n * _mean(self.seconds.get(rule, [])) for rule, n in counts)
        if planned is None or self.watcher is None:
            return self.expected, 0.0
        finished = [
            name.rsplit(": ", 1)[-1]
            for name, job in self.watcher.jobs().items()
            if job.state != "running"
        ]
        todo = done = 0.0
        for rule, count in planned.items():
            ended, mean = finished.count(rule), _mean(self.seconds.get(rule, []))
            todo += max(count - ended, 0) * mean
            done += min(ended, count) * mean
        return todo, done

    def _planned(self) -> dict[str, int] | None:
        """Jobs by rule that the workflow has found to do; None before it has."""
        if self.watcher is None or not self.watcher.transcript.is_file():
            return None
        text = self.watcher.transcript.read_text(encoding="utf-8", errors="replace")
        if "Nothing to be done" in text:
            return {}
        _, found, rest = text.partition("Job stats:")
        if not found or "\ntotal" not in rest:
            return None
        pairs = re.findall(r"^(\w+) +(\d+)$", rest.partition("\ntotal")[0], re.MULTILINE)
        return {rule: int(count) for rule, count in pairs}


def bring_up_to_date(
    wanted: Mapping[str, Targets],
    frames: Mapping[Path, int],
    *,
    cores: int = 0,
) -> int:
    """Run the workflows of all projects to the stages that are ``wanted`` of them, by part.

    What failed is named; returns 1 where anything did. A run that was killed goes on from the jobs
    that were done: no lock of Snakemake's is left behind, one of the system's keeps two evaluations
    in one folder apart. Raises UserError where another one runs.
    """
    orders = orders_of(wanted, frames)
    for order in orders:
        check_bodies(order.project)
    console = Console(stderr=True)
    cores = cores or len(os.sched_getaffinity(0))
    beside = min(SIDE_BY_SIDE, cores, len(orders))
    LOCK.parent.mkdir(exist_ok=True)
    with open(LOCK, "w", encoding="utf-8") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise UserError(
                "another evaluation, or a part of it, still runs in this folder"
            ) from None
        told_to_end = signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
        try:
            _run(orders, beside, cores, lock.fileno(), console)
        except KeyboardInterrupt:
            raise SystemExit(130) from None
        finally:
            running = [order.process for order in orders if order.process is not None]
            for process in running:
                if process.poll() is None:
                    process.terminate()
            for process in running:
                process.wait()
            signal.signal(signal.SIGTERM, told_to_end)
    return max((1 if order.status else 0 for order in orders), default=0)


def orders_of(wanted: Mapping[str, Targets], frames: Mapping[Path, int]) -> list[Order]:
    """One order a project, whatever parts want it, in the order in which they are to start."""
    stages: dict[Path, list[str]] = {}
    projects: dict[Path, Project] = {}
    for targets in wanted.values():
        for stage, project in targets:
            key = project.path.resolve()
            projects[key] = project
            stages.setdefault(key, []).append(stage)
    orders = [
        Order(project, stages[key], _seconds(jobs_of(project, stages[key]), frames))
        for key, project in projects.items()
    ]
    for order in orders:
        read = {
            row.recordings.resolve()
            for name, row in order.project.sequences.items()
            if order.project.recordings_made(name) is None
        }
        order.after = [
            other
            for other in orders
            if other is not order
            and any(
                (made := other.project.recordings_made(name)) is not None and made.resolve() in read
                for name in other.project.sequences
            )
        ]

    def urgency(order: Order) -> float:
        waiting = sum(other.expected for other in orders if order in other.after)
        return order.expected + waiting

    return sorted(orders, key=urgency, reverse=True)


def _seconds(jobs: Jobs, frames: Mapping[Path, int]) -> dict[str, list[float]]:
    found: dict[str, list[float]] = {}
    for project, name, stage in jobs:
        count = frames.get(project.sequences[name].recordings.resolve(), FRAMES)
        found.setdefault(stage, []).append(expected_seconds(project, stage, count))
    return found


def _run(orders: list[Order], beside: int, cores: int, lock: int, console: Console) -> None:
    begin = told = time.monotonic()
    while any(order.status is None for order in orders):
        running = [o for o in orders if o.process is not None and o.status is None]
        waiting = [o for o in orders if o.process is None and o.status is None]
        ready = [o for o in waiting if all(other.status is not None for other in o.after)]
        for order in ready[: beside - len(running)]:
            _start(order, -(-cores // beside), lock, console)
        time.sleep(POLL_SECONDS)
        for order in running:
            assert order.process is not None and order.watcher is not None
            order.watcher.tell()
            if order.process.poll() is not None:
                _end(order, console)
        now = time.monotonic()
        if now - told > TELL_SECONDS:
            told = now
            console.print(progress(orders, beside, now - begin), highlight=False, markup=False)


def progress(orders: Sequence[Order], beside: int, elapsed: float) -> str:
    """How many projects are done and how long the rest takes at most, at the pace until now.

    What a workflow keeps is known once it has started: before, all of its jobs count.
    """
    left, done = (sum(values) for values in zip(*(o.left() for o in orders), strict=True))
    pace = elapsed * beside / done if done > 60 else 1.0
    ended = sum(order.status is not None for order in orders)
    return (
        f"{ended} of {len(orders)} projects done after {elapsed / 60:.0f} minutes, at most "
        f"{math.ceil(left * pace / beside / 60)} left"
    )


def _start(order: Order, cores: int, lock: int, console: Console) -> None:
    project = order.project
    targets = [
        str(project.artefact(name, stage)) for stage in order.stages for name in project.sequences
    ]
    order.watcher = Watcher(project, console)
    path = order.watcher.transcript
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    order.transcript = open(path, "w", encoding="utf-8")  # noqa: SIM115 (closed in _end)
    command = snakemake_command(project.path, cores=cores, arguments=[*targets, "--nolock"])
    order.process = subprocess.Popen(
        command,
        stdout=order.transcript,
        stderr=subprocess.STDOUT,
        env={**os.environ, "NO_COLOR": "1"},
        pass_fds=[lock],  # held as long as any of them lives
    )


def _end(order: Order, console: Console) -> None:
    assert order.process is not None and order.watcher is not None and order.transcript is not None
    order.transcript.close()
    order.status = order.process.returncode
    failures = order.watcher.failures() if order.status else {}
    for name, words in failures.items():
        console.print(
            f"[red]{escape(order.project.config.dataset)}: {escape(name)}[/red] {escape(words)}",
            highlight=False,
            soft_wrap=True,
        )
    if order.status and not failures:
        lines = order.watcher.transcript.read_text(encoding="utf-8").splitlines()
        console.print("\n".join(lines[-LAST_LINES:]), highlight=False, markup=False)


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else 0.0
