"""State of the jobs of a run, read from their logs, and its display."""

from __future__ import annotations

import os
import re
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console, Group
from rich.markup import escape

from intercap_core.commands.console import ListTable, print_plain
from intercap_core.disk import free_bytes
from intercap_core.pipeline.job import last_words, read_state
from intercap_core.project import Project
from intercap_core.stage_list import STAGES

ROWS = 24  # rows of the table: a standard terminal's height
STEPS = re.compile(r"(\d+) of (\d+) steps \(")  # Snakemake's progress line


@dataclass(frozen=True)
class JobState:
    """State of one job of this run, read from its log."""

    state: str
    """"running", "finished" or "failed"."""
    words: str
    """Duration of a finished job, or reason of a failure."""
    log: Path
    """Log file of the job."""


def full_disk(project: Project) -> str:
    """Error message about a full disk among those that a run writes to; "" if none is full."""
    for place in (project.results, project.logs, project.root):
        if free_bytes(place) < 1_000_000:
            return f"the disk of {place} is full; free space, then run again to continue"
    return ""


class Watcher:
    """Follows a run by reading the logs of its jobs."""

    def __init__(self, project: Project, console: Console) -> None:
        self._project = project
        self._console = console
        self._started = time.time() - 1.0  # some file systems store whole seconds
        self._printed: set[str] = set()
        self._printed_at = time.monotonic()
        self.transcript = project.logs / "snakemake.log"

    def start(
        self, command: Sequence[str], *, pass_fds: Sequence[int] = ()
    ) -> subprocess.Popen[bytes]:
        """Start Snakemake with its output in the transcript."""
        self.transcript.parent.mkdir(parents=True, exist_ok=True)
        self.transcript.unlink(missing_ok=True)
        with open(self.transcript, "w", encoding="utf-8") as output:
            return subprocess.Popen(
                command,
                stdout=output,
                stderr=subprocess.STDOUT,
                cwd=self._project.root,
                env={**os.environ, "NO_COLOR": "1"},
                pass_fds=pass_fds,
            )

    def jobs(self) -> dict[str, JobState]:
        """State of every job that this run has started, by "sequence: stage"."""
        found = {}
        logs = self._project.logs
        for path in sorted(logs.glob("**/*.log")):
            try:
                if path == self.transcript or path.stat().st_mtime < self._started:
                    continue
                state = JobState(*read_state(path), path)
            except FileNotFoundError:  # Snakemake removes an old log before it starts a job
                continue
            sequence = path.parent.name if path.parent != logs else ""
            found[f"{sequence}: {path.stem}" if sequence else path.stem] = state
        return found

    def print_failures(self, *, failed: bool, prefix: str = "") -> dict[str, str]:
        """Print and return the reason by job that did not finish; valid after the run has ended.

        If the run failed without such a job, print its last lines.
        """
        why = full_disk(self._project) or "killed, perhaps for its memory"
        ended = f"ended without a log entry: {why}"
        failures = {
            name: job.words if job.state == "failed" else ended
            for name, job in self.jobs().items()
            if job.state != "finished"
        }
        for name, words in failures.items():
            line = f"[red]{escape(prefix + name)}[/red] {escape(words)}"
            self._console.print(line, highlight=False, soft_wrap=True)
        if failed and not failures:
            lines = self.transcript.read_text(encoding="utf-8").splitlines()
            print_plain(self._console, "\n".join(lines[-15:]))
        return failures

    def table(self) -> Group:
        """Table of the sequences with running or failed jobs, by stage, and counts of all."""
        jobs = self.jobs()
        states: dict[str, set[str]] = {name: set() for name in self._project.sequences}
        for name, job in jobs.items():
            states.get(name.partition(":")[0], set()).add(job.state)
        ended = sum(of_jobs == {"finished"} for of_jobs in states.values())
        waiting = sum(not of_jobs for of_jobs in states.values())
        running = [name for name, of_jobs in states.items() if "running" in of_jobs]
        failed = [name for name, of_jobs in states.items() if "failed" in of_jobs]
        shown = list(dict.fromkeys([*running, *failed]))
        counts = (
            f"{self.steps()} jobs done; of {len(states)} sequences {ended} are finished, "
            f"{waiting} are waiting or up to date"
        )
        table = ListTable("sequence", *STAGES)
        for sequence in shown[:ROWS]:
            making = jobs.get(f"{sequence}: studio")
            first = f"{sequence} (recording)" if making and making.state == "running" else sequence
            cells = [self._cell(sequence, stage, jobs) for stage in STAGES]
            table.add_row(first, *cells)
        more = f", {len(shown) - ROWS} more running or failed" if len(shown) > ROWS else ""
        return Group(table, counts + more)

    def _cell(self, sequence: str, stage: str, jobs: dict[str, JobState]) -> str:
        job = jobs.get(f"{sequence}: {stage}")
        if job is None:
            there = self._project.artefact(sequence, stage).exists()
            return "[dim]kept[/dim]" if there else "[dim]-[/dim]"
        if job.state == "running":
            return "[yellow]runs[/yellow]"
        finished = job.state == "finished"
        return f"[green]{escape(job.words)}[/green]" if finished else "[red]failed[/red]"

    def print_changes(self) -> None:
        """Print each job that has ended since the last call, and every 30 s the progress.

        Used if the output is no terminal.
        """
        jobs = self.jobs()
        for name, job in jobs.items():
            if job.state != "running" and name not in self._printed:
                self._printed.add(name)
                print_plain(self._console, f"{name}: {job.state} {job.words}")
        if time.monotonic() - self._printed_at >= 30.0:
            self._printed_at = time.monotonic()
            print_plain(self._console, self.progress())

    def progress(self) -> str:
        """Number of finished jobs, and the last log line of each running job."""
        running = [
            f"{name} ({last_words(job.log)})"
            for name, job in self.jobs().items()
            if job.state == "running"
        ]
        words = ", ".join(running) or "none"
        return f"{self.steps()} jobs done; {len(running)} run: {words}"

    def steps(self) -> str:
        """Numbers of finished jobs and of all jobs, by Snakemake's last progress line."""
        printed = self.transcript.read_text(encoding="utf-8", errors="replace")
        done, of = (STEPS.findall(printed) or [("0", "?")])[-1]
        return f"{done} of {of}"

    @property
    def idle(self) -> bool:
        """Whether Snakemake has reported no finished job."""
        return self.steps().startswith("0 of ")
