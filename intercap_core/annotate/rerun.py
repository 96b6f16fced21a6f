"""Runs of the stages that an edit makes stale, by `intercap run`."""

from __future__ import annotations

import contextlib
import itertools
import os
import shlex
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from intercap_core.annotate.before import Backup
from intercap_core.annotation import Annotation
from intercap_core.commands.run import ENDS_WITHIN_S, kill_with_children
from intercap_core.errors import UserError
from intercap_core.pipeline.job import read_state
from intercap_core.pipeline.plan import OutputStatus, Plan
from intercap_core.project import Project
from intercap_core.stage_list import LEAVES

_PLANNING = threading.Lock()  # Python 3.11 fails if two threads parse source at a time
_PATIENCE_S = 10.0  # added to the time in which `intercap run` ends in order
_SEQUENCES = 20  # other sequences whose logs are read for a stage's expected duration


@dataclass(frozen=True)
class EditedProject(Project):
    """A project with an unsaved annotation of one sequence."""

    edited: Mapping[str, Annotation] = field(default_factory=dict)
    """Unsaved annotation by sequence."""

    @classmethod
    def of(cls, project: Project, sequence: str, annotation: Annotation) -> EditedProject:
        """Return the project with another annotation of a sequence."""
        values = {f.name: getattr(project, f.name) for f in fields(Project)}
        return cls(**values, edited={sequence: annotation})

    def annotation(self, sequence: str, *, look_at_frames: bool = True) -> Annotation:
        """Return the annotation of a sequence, unsaved if it is edited."""
        if sequence in self.edited:
            return self.edited[sequence]
        return super().annotation(sequence, look_at_frames=look_at_frames)


def stale_stages(project: Project, sequence: str) -> list[dict[str, Any]]:
    """Return the stages that a run would compute, in order, with the reasons."""
    with _PLANNING:
        states = Plan(project).states(sequence).items()
    return [
        {"stage": stage, "reasons": list(state.reasons)}
        for stage, state in states
        if state.status is not OutputStatus.done
    ]


def targets(project: Project, sequence: str) -> list[str]:
    """Return the Snakemake targets that compute all stages of one sequence."""
    return [project.target(project.artefact(sequence, stage)) for stage in LEAVES]


def command(
    project: Project, sequence: str, *, cores: int = 0, profile: Path | None = None
) -> list[str]:
    """Return the arguments of `intercap run` for one sequence."""
    return [
        "intercap", "run", str(project.path),
        *(("--cores", str(cores)) if cores else ()),
        *(("--profile", str(profile)) if profile is not None else ()),
        "--", *targets(project, sequence),
    ]  # fmt: skip


def expected_seconds(project: Project, sequence: str, stage: str) -> float | None:
    """Return how long the last run of a stage took, from its log, or None if no log states it.

    Without a duration for this sequence, the mean over at most ``_SEQUENCES`` others is returned.
    """
    others = itertools.islice(project.logs.glob(f"*/{stage}.log"), _SEQUENCES)
    for logs in ([project.logs / sequence / f"{stage}.log"], others):
        ends = [read_state(log) for log in logs if log.is_file()]
        durations = [float(text.split()[0]) for state, text in ends if state == "finished"]
        if durations:
            return sum(durations) / len(durations)
    return None


class RunManager:
    """Runs that the page starts, one at a time."""

    def __init__(self, *, cores: int = 0, profile: Path | None = None) -> None:
        self.cores, self.profile = cores, profile
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self.sequence = ""
        """Sequence of the last run, "" if there was none."""
        self._expected: dict[str, float | None] = {}  # seconds by stage of the last run
        self._begun: dict[str, float] = {}  # time at which each stage was first seen at work
        self._start = self._ended = 0.0
        self._stop_time = 0.0  # time.monotonic() of the request to stop, 0 = none
        self._output: Path | None = None

    @property
    def in_progress(self) -> bool:
        """True while a run that was started here has not ended."""
        return self._process is not None and self._process.poll() is None

    def start(self, project: Project, sequence: str) -> None:
        """Back up the results of a sequence and compute its stale stages.

        Raises UserError if a run is in progress, everything is up to date, or jobs need a cluster.
        """
        arguments = command(project, sequence, cores=self.cores, profile=self.profile)
        if self.profile is not None:
            raise UserError(f"jobs go to a cluster: run {shlex.join(arguments)}")
        with self._lock:
            if self.in_progress:
                raise UserError(
                    f"a run of {self.sequence} is in progress; wait for its end, or stop it"
                )
            stages = [stale["stage"] for stale in stale_stages(project, sequence)]
            if not stages:
                raise UserError(f"nothing to run: all results of {sequence} are up to date")
            self._note_end(project)
            self._expected = {stage: expected_seconds(project, sequence, stage) for stage in stages}
            self._begun = {}
            Backup(project, sequence).make(stages)
            self._output = project.logs / "annotate.txt"  # not .log, which jobs use
            self._output.parent.mkdir(parents=True, exist_ok=True)
            self.sequence, self._start, self._ended = sequence, time.time(), 0.0
            self._stop_time = 0.0
            with open(self._output, "wb") as output:
                self._process = subprocess.Popen(
                    [sys.executable, "-m", "intercap_core.cli", *arguments[1:]],
                    stdout=output, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
                    env={**os.environ, "NO_COLOR": "1"},
                )  # fmt: skip

    def stop(self) -> None:
        """Ask the run and its jobs to end, and return at once; finished results are kept.

        A second request has no effect while the run may end in order. After that, it kills the run.
        """
        with self._lock:
            if self._process is None or not self.in_progress:
                return
            if not self._stop_time:
                self._stop_time = time.monotonic()
                self._process.terminate()
            elif time.monotonic() - self._stop_time > ENDS_WITHIN_S + _PATIENCE_S:
                kill_with_children(self._process)

    def wait(self) -> None:
        """Wait until a stopped run has ended, at most as long as it may take."""
        if self._process is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(ENDS_WITHIN_S + _PATIENCE_S)

    def progress(self, project: Project) -> dict[str, Any]:
        """Return the state of the last run and of each of its stages.

        ``stages`` has, by stage: ``state``, ``message`` (duration, or reason of a failure), and
        ``seconds`` and ``expected_s``, its time so far and in the run before, None = unknown.
        """
        if self._process is None:
            return {"state": "none"}
        status = self._process.poll()
        self._note_end(project)
        stages = [self._stage(project, stage) for stage in self._expected]
        stopping = bool(self._stop_time)
        if status is None:
            state = "ending" if stopping else "running"
        else:
            state = "done" if status == 0 else ("stopped" if stopping else "failed")
        message = ""
        if state == "failed" and self._output is not None and self._output.is_file():
            lines = self._output.read_text(encoding="utf-8", errors="replace").splitlines()
            message = "\n".join(lines[-12:])
        return {
            "state": state, "sequence": self.sequence, "stages": stages, "message": message,
            "seconds": round((self._ended or time.time()) - self._start, 1),
            "ending_s": round(time.monotonic() - self._stop_time, 1) if stopping else 0.0,
            "ends_within_s": ENDS_WITHIN_S + _PATIENCE_S,
        }  # fmt: skip

    def _note_end(self, project: Project) -> None:
        if self._process is None or self.in_progress or self._ended:
            return
        self._ended = time.time()
        if self._process.returncode == 0:
            Backup(project, self.sequence).mark_success()

    def _stage(self, project: Project, stage: str) -> dict[str, Any]:
        log = project.logs / self.sequence / f"{stage}.log"
        state, message = "waits", ""
        with contextlib.suppress(FileNotFoundError):
            if log.stat().st_mtime >= self._start - 1.0:  # some file systems store whole seconds
                state, message = read_state(log)
        seconds = 0.0
        if state == "running":
            seconds = round(time.time() - self._begun.setdefault(stage, time.time()), 1)
        return {"stage": stage, "state": state, "message": message, "seconds": seconds,
                "expected_s": self._expected[stage]}  # fmt: skip
