"""`intercap run`: run Snakemake and show its progress as a table of sequences and stages."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console
from rich.live import Live

from intercap_core.commands.check import check_bodies
from intercap_core.commands.closing import print_remarks
from intercap_core.commands.console import print_plain
from intercap_core.commands.watcher import Watcher, full_disk
from intercap_core.errors import UserError
from intercap_core.pipeline.lease import Lease, find_snakemake, lease_path, try_acquire
from intercap_core.pipeline.plan import Plan
from intercap_core.pipeline.stage_inputs import DATASET_READS
from intercap_core.project import Project, load_project
from intercap_core.shipped import shipped
from intercap_core.signals import Terminated

POLL_SECONDS = 0.5
DRY_RUN = {"-n", "--dry-run", "--dryrun"}
ENDS_WITHIN_S = 90.0  # time for jobs to end; the executor has 60 s to cancel a cluster's jobs
# Child processes that are not terminated, because they end by themselves
SLURM_COMMANDS = {"sbatch", "scancel", "squeue", "sacct", "scontrol"}
GO_ON = "Slurm's jobs go on"  # begins the executor's line if it could not cancel jobs
AGGREGATES = ("site/index.html", "summary.json")  # outputs of all sequences, as targets


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
        why = full_disk(project) or "the workflow stopped"
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
