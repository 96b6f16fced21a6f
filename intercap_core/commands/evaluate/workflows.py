"""Bring the workflows of many projects up to date, two at a time; their expected and taken time.

One workflow leaves cores idle while its last long job runs; a second workflow uses them. A project
that reads the recordings of another project starts after it. Among the projects that can start, the
one with the longest expected work, including the work that waits for it, is first.
"""

from __future__ import annotations

import csv
import fcntl
import math
import os
import re
import subprocess
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from intercap_core.commands.check import check_bodies
from intercap_core.commands.evaluate.part import Figures, Targets
from intercap_core.commands.run import POLL_SECONDS, Watcher, snakemake_command
from intercap_core.errors import UserError
from intercap_core.pipeline.stage_inputs import STUDIO
from intercap_core.project import Project
from intercap_core.stage_list import STAGES

SIDE_BY_SIDE = 2  # workflows at a time
LOCK = Path(".snakemake") / "evaluation.lock"
# CPU seconds per frame of six 720P views, measured with `make evaluate-quick` on an AMD EPYC.
SECONDS_PER_FRAME = {
    STUDIO: 0.52, "frames": 0.02, "detections": 0.02, "scene": 0.25, "person": 0.15,
    "object_track": 0.22, "body_fit": 0.17, "joint": 0.37, "metrics": 0.30,
}  # fmt: skip


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


def expected_seconds(job: Job, frames: int) -> float:
    """Expected CPU seconds of a job whose recording has this number of frames."""
    config = job.project.config
    rendered = 6 if config.studio is None else config.studio.cameras
    views = rendered if job.stage == STUDIO else len(config.frames.cameras) or rendered
    start = 1.3  # imports, compiled code from the cache
    return start + SECONDS_PER_FRAME.get(job.stage, 0.3) * views / 6 * frames


def frames_of_recordings(projects: Iterable[Project]) -> dict[Path, int]:
    """Number of frames of each recording that the projects' studios render, by its folder."""
    return {
        (project.results / "recordings" / name).resolve(): entry.frames
        for project in projects
        if project.config.studio is not None
        for name, entry in project.config.studio.captures.items()
    }


@dataclass(eq=False)
class ProjectRun:
    """The workflow of one project, planned, running or ended."""

    project: Project
    stages: list[str]
    """Target stages."""
    seconds: dict[str, list[float]]
    """Expected CPU seconds of all jobs, by rule."""
    after: list[ProjectRun] = field(default_factory=list)
    """Projects that must end before this one starts."""
    watcher: Watcher | None = None
    """Follows the jobs; None until the workflow has started."""
    process: subprocess.Popen[bytes] | None = None
    """Snakemake's process; None until the workflow has started."""
    status: int | None = None
    """Exit status; None until the workflow has ended."""

    @property
    def expected(self) -> float:
        """CPU seconds if no job is up to date."""
        return sum(map(sum, self.seconds.values()))

    def left(self) -> tuple[float, float]:
        """Expected CPU seconds of the remaining jobs, and of the completed jobs."""
        planned = self._planned()
        mean = {rule: sum(values) / len(values) for rule, values in self.seconds.items()}
        if self.status is not None:
            counts = (planned or {}).items()
            return 0.0, sum(count * mean.get(rule, 0.0) for rule, count in counts)
        if planned is None or self.watcher is None:
            return self.expected, 0.0
        finished = Counter(
            name.rsplit(": ", 1)[-1]
            for name, job in self.watcher.jobs().items()
            if job.state != "running"
        )
        todo = done = 0.0
        for rule, count in planned.items():
            todo += max(count - finished[rule], 0) * mean.get(rule, 0.0)
            done += min(finished[rule], count) * mean.get(rule, 0.0)
        return todo, done

    def _planned(self) -> dict[str, int] | None:
        """Number of jobs by rule that the workflow has planned; None before planning."""
        if self.watcher is None or not self.watcher.transcript.is_file():
            return None
        text = self.watcher.transcript.read_text(encoding="utf-8", errors="replace")
        if "Nothing to be done" in text:
            return {}
        _, heading, rest = text.partition("Job stats:")
        if not heading or "\ntotal" not in rest:
            return None
        pairs = re.findall(r"^(\w+) +(\d+)$", rest.partition("\ntotal")[0], re.MULTILINE)
        return {rule: int(count) for rule, count in pairs}


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
    frames = frames_of_recordings(projects.values())
    runs = []
    for key, project in projects.items():
        seconds: dict[str, list[float]] = {}
        for job in list_jobs(project, stages[key]):
            # 45 frames, the studio's default, for recordings that none of the projects renders
            count = frames.get(project.sequences[job.sequence].recordings.resolve(), 45)
            seconds.setdefault(job.stage, []).append(expected_seconds(job, count))
        runs.append(ProjectRun(project, stages[key], seconds))
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

    def urgency(run: ProjectRun) -> float:
        waiting = sum(other.expected for other in runs if run in other.after)
        return run.expected + waiting

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
            console.print(progress(runs, parallel, now - begin), highlight=False, markup=False)


def progress(runs: Sequence[ProjectRun], parallel: int, elapsed: float) -> str:
    """Report of the completed projects and the remaining minutes at the present pace.

    The minutes are an upper bound: until a workflow has planned its jobs, all of them count.
    """
    # expected CPU seconds of remaining and of completed jobs
    left, done = (sum(values) for values in zip(*(o.left() for o in runs), strict=True))
    pace = elapsed * parallel / done if done > 60 else 1.0  # seconds per expected second
    ended = sum(run.status is not None for run in runs)
    return (
        f"{ended} of {len(runs)} projects done after {elapsed / 60:.0f} minutes, at most "
        f"{math.ceil(left * pace / parallel / 60)} left"
    )


def _start(run: ProjectRun, cores: int, lock: int, console: Console) -> None:
    """Start a workflow on ``cores`` cores; ``lock`` is the file descriptor of the system lock."""
    project = run.project
    targets = [
        str(project.artefact(name, stage)) for stage in run.stages for name in project.sequences
    ]
    run.watcher = Watcher(project, console)
    command = snakemake_command(project.path, cores=cores, arguments=[*targets, "--nolock"])
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


def print_minutes(parts: Sequence[str], minutes: Figures, duration: float) -> None:
    """Print one row per part, and the ``duration`` of this run in minutes."""
    table = Table("part", "budget", "taken", box=None, title="minutes on 2 cores")
    for part in parts:
        budget, taken = (minutes[f"{part}_minutes_{key}"] for key in ("budget", "taken"))
        excess = "over its budget" if taken > budget else ""
        table.add_row(part, f"{budget:.1f}", f"{taken:.1f}", excess)
    Console().print(table)
    print(f"this run took {duration:.1f} minutes of wall time")
