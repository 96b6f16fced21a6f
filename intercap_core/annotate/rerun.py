"""Running again what an edit touches.

What is touched is decided by ``pipeline.plan``, as for ``intercap run``, which is also what runs.
"""

from __future__ import annotations

import contextlib
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

from intercap_core.annotate import before
from intercap_core.commands.run import ENDS_WITHIN_S
from intercap_core.config import Annotation
from intercap_core.errors import UserError
from intercap_core.pipeline.job import last_words, read_state
from intercap_core.pipeline.plan import OutputStatus, Plan
from intercap_core.project import Project
from intercap_core.stage_list import LEAVES

_LAST_LINES = 12
_PLANNING = threading.Lock()  # Python 3.11 fails where two threads parse source at a time
_PATIENCE_S = 10.0  # beyond what `intercap run` takes at most to end in order


@dataclass(frozen=True)
class EditedProject(Project):
    """A project in which one sequence's annotation is another than the file's."""

    edited: Mapping[str, Annotation] = field(default_factory=dict)

    @classmethod
    def of(cls, project: Project, sequence: str, annotation: Annotation) -> EditedProject:
        """The project with ``annotation`` for a sequence."""
        own = {one.name: getattr(project, one.name) for one in fields(Project)}
        return cls(**own, edited={sequence: annotation})

    def annotation(self, sequence: str, *, look_at_frames: bool = True) -> Annotation:
        """As the project's own, but for the edited one."""
        if sequence in self.edited:
            return self.edited[sequence]
        return super().annotation(sequence, look_at_frames=look_at_frames)


def touched(project: Project, sequence: str) -> list[dict[str, Any]]:
    """Stages that a run would make anew, in their order, with the reasons."""
    with _PLANNING:
        plan = Plan(project)
        found = [
            {"stage": stage, "state": str(state.status), "reasons": list(state.reasons)}
            for stage, state in plan.states(sequence).items()
            if state.status is not OutputStatus.done
        ]
        if not isinstance(project, EditedProject):
            plan.save()
        return found


def targets(project: Project, sequence: str) -> list[str]:
    """What Snakemake is asked for, so that it makes all of one sequence and nothing of others."""
    return [str(project.artefact(sequence, stage)) for stage in LEAVES]


def command(
    project: Project, sequence: str, *, cores: int = 0, profile: Path | None = None
) -> list[str]:
    """`intercap run` of one sequence, as it is written in a shell."""
    return [
        "intercap", "run", str(project.path),
        *(("--cores", str(cores)) if cores else ()),
        *(("--profile", str(profile)) if profile is not None else ()),
        "--", *targets(project, sequence),
    ]  # fmt: skip


class Runs:
    """The one run that the page may have started, of one sequence at a time."""

    def __init__(self, *, cores: int = 0, profile: Path | None = None) -> None:
        self.cores, self.profile = cores, profile
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._sequence = ""
        self._stages: list[str] = []
        self._start = 0.0
        self._ended = 0.0
        self._told_to_end = 0.0  # when, by time.monotonic; 0 = it was not
        self._said: Path | None = None

    @property
    def going_on(self) -> bool:
        """Whether a run that was started here has not ended."""
        return self._process is not None and self._process.poll() is None

    @property
    def sequence(self) -> str:
        """Of the run that was started last, "" = none was."""
        return self._sequence

    def start(self, project: Project, sequence: str) -> None:
        """Run what is out of date of a sequence; what is there now is kept beside.

        Raises UserError where a run goes on, nothing is to be done, or jobs go to a cluster.
        """
        told = command(project, sequence, cores=self.cores, profile=self.profile)
        if self.profile is not None:
            raise UserError(f"jobs go to a cluster: run {shlex.join(told)}")
        with self._lock:
            if self.going_on:
                raise UserError(f"a run of {self._sequence} goes on; wait for its end, or stop it")
            self._stages = [one["stage"] for one in touched(project, sequence)]
            if not self._stages:
                raise UserError(f"nothing to run: all results of {sequence} are up to date")
            self._note_end(project)
            before.keep(project, sequence, self._stages)
            self._said = project.logs / "annotate.txt"  # no .log: those are of jobs
            self._said.parent.mkdir(parents=True, exist_ok=True)
            self._sequence, self._start, self._ended = sequence, time.time(), 0.0
            self._told_to_end = 0.0
            with open(self._said, "wb") as said:
                self._process = subprocess.Popen(
                    [sys.executable, "-m", "intercap_core.cli", *told[1:]],
                    stdout=said, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
                    env={**os.environ, "NO_COLOR": "1"},
                )  # fmt: skip

    def stop(self) -> None:
        """Tell the run to end, with its jobs; what they had finished is kept. It is not waited for.

        Telling it again changes nothing as long as it may take to end in order; after that, it is
        killed.
        """
        with self._lock:
            if self._process is None or not self.going_on:
                return
            if not self._told_to_end:
                self._told_to_end = time.monotonic()
                self._process.terminate()
            elif time.monotonic() - self._told_to_end > ENDS_WITHIN_S + _PATIENCE_S:
                _kill(self._process)

    def wait(self) -> None:
        """Until a run that was told to end has ended, or is taken for one that does not."""
        if self._process is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(ENDS_WITHIN_S + _PATIENCE_S)

    def progress(self, project: Project) -> dict[str, Any]:
        """How far the last run is: the sequence, each of its stages' states and last words."""
        if self._process is None:
            return {"state": "none"}
        status = self._process.poll()
        self._note_end(project)
        stages = [{"stage": stage, **self._stage(project, stage)} for stage in self._stages]
        told = bool(self._told_to_end)
        if status is None:
            state = "ending" if told else "running"
        else:
            state = "done" if status == 0 else ("stopped" if told else "failed")
        words = ""
        if state == "failed" and self._said is not None and self._said.is_file():
            lines = self._said.read_text(encoding="utf-8", errors="replace").splitlines()
            words = "\n".join(lines[-_LAST_LINES:])
        return {
            "state": state, "sequence": self._sequence, "stages": stages, "words": words,
            "seconds": round((self._ended or time.time()) - self._start, 1),
            "ending_s": round(time.monotonic() - self._told_to_end, 1) if told else 0.0,
            "ends_within_s": ENDS_WITHIN_S + _PATIENCE_S,
        }  # fmt: skip

    def _note_end(self, project: Project) -> None:
        if self._process is None or self.going_on or self._ended:
            return
        self._ended = time.time()
        if self._process.returncode == 0:
            before.ended_well(project, self._sequence)

    def _stage(self, project: Project, stage: str) -> dict[str, str]:
        log = project.logs / self._sequence / f"{stage}.log"
        try:
            if log.stat().st_mtime < self._start - 1.0:
                return {"state": "waits", "words": ""}
            state, words = read_state(log)
            return {"state": state, "words": words or last_words(log)}
        except FileNotFoundError:
            return {"state": "waits", "words": ""}


def _kill(process: subprocess.Popen[bytes]) -> None:
    """The process and all that it has started."""
    import psutil

    with contextlib.suppress(psutil.NoSuchProcess):
        for one in (
            *psutil.Process(process.pid).children(recursive=True),
            psutil.Process(process.pid),
        ):
            with contextlib.suppress(psutil.NoSuchProcess):
                one.kill()
