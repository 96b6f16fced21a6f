"""`intercap run`: run Snakemake and show its progress as a table of sequences and stages."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape

from intercap_core.commands.check import check_bodies
from intercap_core.commands.closing import print_remarks
from intercap_core.commands.console import ListTable, print_plain
from intercap_core.disk import free_bytes
from intercap_core.errors import UserError
from intercap_core.pipeline.job import last_words, read_state
from intercap_core.pipeline.lease import Lease, find_snakemake, lease_path, try_acquire
from intercap_core.pipeline.plan import Plan
from intercap_core.pipeline.stage_inputs import DATASET_READS
from intercap_core.project import Project, load_project
from intercap_core.shipped import shipped
from intercap_core.signals import Terminated
from intercap_core.stage_list import STAGES

POLL_SECONDS = 0.5
ROWS = 24  # rows of the table: a standard terminal's height
DRY_RUN = {"-n", "--dry-run", "--dryrun"}
ENDS_WITHIN_S = 90.0  # time for jobs to end; the executor has 60 s to cancel a cluster's jobs
# Child processes that are not terminated, because they end by themselves
SLURM_COMMANDS = {"sbatch", "scancel", "squeue", "sacct", "scontrol"}
GO_ON = "Slurm's jobs go on"  # begins the executor's line if it could not cancel jobs
STEPS = re.compile(r"(\d+) of (\d+) steps \(")  # Snakemake's progress line
AGGREGATES = ("site/index.html", "summary.json")  # outputs of all sequences, as targets


@dataclass(frozen=True)
class JobState:
    """State of one job of this run, read from its log."""

    state: str
    """"running", "finished" or "failed"."""
    words: str
    """Duration of a finished job, or reason of a failure."""
    log: Path
    """Log file of the job."""


def run_workflow(
    settings: Path, *, cores: int = 0, profile: Path | None = None, arguments: Sequence[str] = ()
) -> int:
    """Bring a project up to date; returns the exit status.

    If sequences fail, they are listed with the reason, and the report covers the others. Raises
    UserError if settings or tables are wrong.

    Args:
        cores: number of cores; 0 for all, or for the profile's.
        profile: folder of a Snakemake workflow profile, or name of one of the package.
        arguments: further arguments of Snakemake; paths are relative to the project's root.
    """
    project = load_project(settings)
    check_bodies(project)
    if find_spec("snakemake") is None:
        raise UserError("runs need Snakemake: pip install 'intercap-core[workflow]'")
    console = Console(stderr=True)
    command = partial(snakemake_command, project, cores=cores, profile=profile)
    if DRY_RUN & set(arguments):
        return subprocess.call(command(arguments=arguments), cwd=project.root)
    if not arguments and Plan(project).all_done():
        count = len(project.sequences)
        print_plain(console, f"nothing to do: all {count} sequences are done")
        _print_report(project, console)
        return 0
    with _exclusive(project, console):
        return _run(project, command, arguments, console)


@contextmanager
def _exclusive(project: Project, console: Console) -> Iterator[None]:
    """Prevent a second run of the same results; wait until a lease without a heartbeat expires.

    Raises UserError that names the other run as soon as it gives a heartbeat.
    """
    path = lease_path(project.results / "run")
    first_beat = None
    while not isinstance(lease := try_acquire(path), Lease):
        with contextlib.suppress(FileNotFoundError):
            beat = path.stat().st_mtime_ns
            if first_beat is None:
                first_beat = beat
                print_plain(console, f"waiting for a heartbeat of the run by {lease}")
            elif beat != first_beat:
                raise UserError(
                    f"{project.results}: another run is active ({lease}); wait for its end, or "
                    "end it"
                )
        time.sleep(POLL_SECONDS)
    try:
        killed = lease.expired_owner
        if killed is not None and killed.host == socket.gethostname():
            snakemake = find_snakemake(project.root.resolve())
            if snakemake:
                raise UserError(
                    f"{project.results}: the run by {killed} was killed, but its jobs are still "
                    f"running (their Snakemake is process {snakemake}); wait for them, or end them"
                )
            console.print(f"the run by {killed} was killed: going on where it stopped")
        elif killed is not None:
            console.print(f"the lease of the run by {killed} has expired: it is taken over")
        yield
    finally:
        lease.release()


def _run(
    project: Project, command: Callable[..., list[str]], arguments: Sequence[str], console: Console
) -> int:
    """Run Snakemake until nothing is stale, print failures and remarks; returns the exit status.

    If some sequences fail, the outputs of all sequences are made from the others.
    """
    watcher = Watcher(project, console)
    try:
        status = run_watched(command(arguments=arguments), watcher, console)
        # Snakemake ignores the marks of jobs downstream of a job that it runs
        # (DAG.update_needrun). If that job writes an unchanged output, stale outputs downstream
        # need another start.
        while status == 0 and not arguments and not watcher.idle and not Plan(project).all_done():
            watcher = Watcher(project, console)
            status = run_watched(command(), watcher, console)
    except Terminated as end:
        steps = watcher.steps()
        print_plain(console, f"{end}: {steps} jobs are done; run the same command to continue")
        printed = watcher.transcript.read_text(encoding="utf-8", errors="replace").splitlines()
        for line in dict.fromkeys(line for line in printed if line.startswith(GO_ON)):
            print_plain(console, line)
        raise SystemExit(end.status) from None
    failures = watcher.print_failures(failed=bool(status))
    if status and not failures:
        why = _full_disk(project) or "the workflow stopped"
        raise UserError(f"{why}; its whole output is in {watcher.transcript}")
    bad = sorted(
        name
        for name in {name.split(":")[0] for name in failures} & set(project.sequences)
        if not all(project.artefact(name, stage).exists() for stage in DATASET_READS)
    )
    if bad and len(bad) < len(project.sequences) and not arguments:
        print_plain(console, f"the report leaves out {', '.join(bad)}")
        targets = [project.target(project.results / name) for name in AGGREGATES]
        excluded = ",".join([*project.config.exclude, *bad])
        others = [*targets, "--config", f"exclude=[{excluded}]"]
        run_watched(command(arguments=others), Watcher(project, console), console)
    print_remarks(project, console)
    _print_report(project, console)
    return status


def _full_disk(project: Project) -> str:
    """Error message about a full disk among those that a run writes to; "" if none is full."""
    for place in (project.results, project.logs, project.root):
        if free_bytes(place) < 1_000_000:
            return f"the disk of {place} is full; free space, then run again to continue"
    return ""


def _print_report(project: Project, console: Console) -> None:
    report = project.site / "index.html"
    if report.is_file():
        print_plain(console, f"report: {report.resolve()}")


def snakemake_command(
    project: Project,
    *,
    cores: int = 0,
    profile: Path | None = None,
    arguments: Sequence[str] = (),
) -> list[str]:
    """Command line that runs a project's workflow in the project's root.

    Arguments as of :func:`run_workflow`.
    """
    profiles = shipped("workflow/profiles")
    if profile is not None:
        places = [profile]
        if profile.parent in (Path("."), Path("profiles")):  # may name one of the package
            places.append(profiles / profile.name)
        places = [path for path in places if path.is_dir()]
        if not places:
            known = ", ".join(sorted(path.name for path in profiles.iterdir()))
            raise UserError(f"{profile}: is no folder and no profile of the package ({known})")
        profile = places[0]
    return [
        *(sys.executable, "-m", "snakemake"),
        *("--snakefile", str(shipped("workflow/Snakefile"))),
        *("--configfile", project.target(project.path)),
        *(("--workflow-profile", os.path.abspath(profile)) if profile is not None else ()),
        *(("--cores", str(cores) if cores else "all") if cores or profile is None else ()),
        *arguments,
    ]


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
        why = _full_disk(self._project) or "killed, perhaps for its memory"
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


def run_watched(command: Sequence[str], watcher: Watcher, console: Console) -> int:
    """Run Snakemake with its output in the watcher's transcript; returns the exit status.

    A signal to this process also ends Snakemake and its jobs before it is raised.
    """
    process = watcher.start(command)
    try:
        with _display(watcher, console) as refresh:
            while process.poll() is None:
                time.sleep(POLL_SECONDS)
                refresh()
            refresh()
    except Terminated as end:
        _terminate(process, interrupted=end.number == signal.SIGINT and _in_foreground())
        raise
    finally:
        if process.poll() is None:
            _terminate(process)
    return process.returncode


def _terminate(process: subprocess.Popen[bytes], *, interrupted: bool = False) -> None:
    """Terminate Snakemake and its jobs on this machine; kill those left after ``ENDS_WITHIN_S``.

    On SIGTERM Snakemake starts no more jobs. On SIGINT it cancels the jobs of a cluster, but waits
    for local jobs, which are therefore terminated here.

    Args:
        interrupted: the terminal has already sent SIGINT; a second one would stop the cancelling.
    """
    import psutil

    with contextlib.suppress(psutil.NoSuchProcess):
        snakemake = psutil.Process(process.pid)
        for number in (signal.SIGTERM,) if interrupted else (signal.SIGTERM, signal.SIGINT):
            process.send_signal(number)
        for job in snakemake.children(recursive=True):
            with contextlib.suppress(psutil.NoSuchProcess):
                if job.name() not in SLURM_COMMANDS:
                    job.terminate()
        try:
            process.wait(ENDS_WITHIN_S)
        except subprocess.TimeoutExpired:
            kill_with_children(process)
    process.wait()


def kill_with_children(process: subprocess.Popen[bytes]) -> None:
    """Kill a process and its descendants."""
    import psutil

    with contextlib.suppress(psutil.NoSuchProcess):
        parent = psutil.Process(process.pid)
        for descendant in (*parent.children(recursive=True), parent):
            with contextlib.suppress(psutil.NoSuchProcess):
                descendant.kill()


def _in_foreground() -> bool:
    """Whether a terminal's Ctrl-C goes to all processes of this one's group."""
    try:
        with open("/dev/tty", "rb") as terminal:
            return os.tcgetpgrp(terminal.fileno()) == os.getpgrp()
    except OSError:
        return False


@contextmanager
def _display(watcher: Watcher, console: Console) -> Iterator[Callable[[], None]]:
    if not console.is_terminal:
        yield watcher.print_changes
        return
    with Live(watcher.table(), console=console, refresh_per_second=2) as live:
        yield lambda: live.update(watcher.table())
