"""Bring the workflows of many projects up to date, two at a time; the time that they took.

One workflow leaves cores idle while its last long job runs; a second workflow uses them. A project
that reads the recordings of another project starts after it. Among the projects that can start, the
one with the most jobs, including those that wait for it, is first.
"""

from __future__ import annotations

import csv
import fcntl
import os
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

from bench.evaluate.part import Figures, Targets
from intercap_core.commands.check import check_bodies
from intercap_core.commands.run import POLL_SECONDS, snakemake_command
from intercap_core.commands.watcher import Watcher
from intercap_core.errors import UserError
from intercap_core.pipeline.stage_inputs import STUDIO
from intercap_core.project import Project
from intercap_core.stage_list import STAGES

SIDE_BY_SIDE = 2  # workflows at a time
LOCK = Path(".snakemake") / "evaluation.lock"


class Job(NamedTuple):
    """A stage of one recording, or the rendering of a virtual recording (stage ``STUDIO``)."""

    project: Project
    sequence: str
    stage: str

    def seconds(self) -> float:
        """Wall seconds of the last run, from the workflow's benchmark file; 0 if unknown."""
        folder = self.project.benchmarks / self.sequence
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


@dataclass(eq=False)
class ProjectRun:
    """The workflow of one project, planned, running or ended."""

    project: Project
    stages: list[str]
    """Target stages."""
    after: list[ProjectRun] = field(default_factory=list)
    """Projects that must end before this one starts."""
    watcher: Watcher | None = None
    """Follows the jobs; None until the workflow has started."""
    process: subprocess.Popen[bytes] | None = None
    """Snakemake's process; None until the workflow has started."""
    status: int | None = None
    """Exit status; None until the workflow has ended."""


def bring_up_to_date(wanted: Mapping[str, Targets], *, cores: int = 0) -> int:
    """Run the workflows of all projects to the stages that the parts need.

    Prints failed jobs and returns 1 if any job failed. After a run that was killed, the
    next one continues its work: Snakemake's lock, which would remain, is not used. A lock of the
    system prevents two evaluations in one folder instead.
    Raises UserError if another evaluation is running.

    Args:
        wanted: target stages and projects by part.
        cores: number of cores; 0 for all.
    """
    runs = plan_runs(wanted)
    for run in runs:
        check_bodies(run.project)
    console = Console(stderr=True)
    cores = cores or len(os.sched_getaffinity(0))
    parallel = min(SIDE_BY_SIDE, cores, len(runs))
    LOCK.parent.mkdir(exist_ok=True)
    with open(LOCK, "w", encoding="utf-8") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise UserError(
                "another evaluation is running in this folder; wait for it or end it"
            ) from None
        try:
            _run(runs, parallel, cores, lock.fileno(), console)
        finally:
            running = [run.process for run in runs if run.process is not None]
            for process in running:
                if process.poll() is None:
                    process.terminate()
            for process in running:
                process.wait()
    return max((1 if run.status else 0 for run in runs), default=0)


def plan_runs(wanted: Mapping[str, Targets]) -> list[ProjectRun]:
    """One run per project with the target stages of all parts, in the order of starting."""
    stages: dict[Path, list[str]] = {}
    projects: dict[Path, Project] = {}
    for targets in wanted.values():
        for stage, project in targets:
            key = project.path.resolve()
            projects[key] = project
            stages.setdefault(key, []).append(stage)
    runs = [ProjectRun(project, stages[key]) for key, project in projects.items()]
    for run in runs:
        read = {
            row.recordings.resolve()
            for name, row in run.project.sequences.items()
            if run.project.recordings_made(name) is None
        }
        run.after = [
            other
            for other in runs
            if other is not run
            and any(
                (made := other.project.recordings_made(name)) is not None and made.resolve() in read
                for name in other.project.sequences
            )
        ]

    jobs = {run: len(list_jobs(run.project, run.stages)) for run in runs}

    def urgency(run: ProjectRun) -> int:
        return jobs[run] + sum(jobs[other] for other in runs if run in other.after)

    return sorted(runs, key=urgency, reverse=True)


def _run(runs: list[ProjectRun], parallel: int, cores: int, lock: int, console: Console) -> None:
    """Run the workflows in their order, ``parallel`` at a time, until all have ended.

    The workflows that can run share the cores equally: one alone gets all of them.
    """
    begin = reported = time.monotonic()
    while any(run.status is None for run in runs):
        running = [o for o in runs if o.process is not None and o.status is None]
        waiting = [o for o in runs if o.process is None and o.status is None]
        ready = [o for o in waiting if all(other.status is not None for other in o.after)]
        together = min(parallel, len(running) + len(ready))
        for run in ready[: parallel - len(running)]:
            _start(run, -(-cores // together), lock, console)
        time.sleep(POLL_SECONDS)
        for run in running:
            assert run.process is not None and run.watcher is not None
            run.watcher.print_changes()
            run.status = run.process.poll()
            if run.status:
                prefix = f"{run.project.config.dataset}: "
                run.watcher.print_failures(failed=True, prefix=prefix)
        now = time.monotonic()
        if now - reported > 60.0:
            reported = now
            ended = sum(run.status is not None for run in runs)
            minutes = (now - begin) / 60
            console.print(
                f"{ended} of {len(runs)} projects done after {minutes:.0f} minutes",
                highlight=False, markup=False,
            )  # fmt: skip


def _start(run: ProjectRun, cores: int, lock: int, console: Console) -> None:
    """Start a workflow on ``cores`` cores; ``lock`` is the file descriptor of the system lock."""
    project = run.project
    targets = [
        project.target(project.artefact(name, stage))
        for stage in run.stages
        for name in project.sequences
    ]
    run.watcher = Watcher(project, console)
    command = snakemake_command(project, cores=cores, arguments=[*targets, "--nolock"])
    # the lock lasts as long as any of the processes
    run.process = run.watcher.start(command, pass_fds=[lock])


def minutes_of_parts(parts: Mapping[str, Targets]) -> Figures:
    """Figures ``<part>_minutes_taken`` on two fully used cores.

    Each is the sum over all jobs of the last run's duration, halved; the last run may belong to an
    earlier evaluation.
    """
    return {
        f"{part}_minutes_taken": sum(job.seconds() for job in jobs) / (2 * 60)
        for part, jobs in jobs_by_part(parts).items()
    }
