"""Running again what an edit touches, and the new result beside the old one.

What is touched is decided by ``pipeline.plan``, as for ``intercap run``, which is also what runs.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core import artefacts
from intercap_core.config import Annotation
from intercap_core.errors import UserError
from intercap_core.metrics.figures import SequenceMetrics
from intercap_core.metrics.verdict_figures import stated_errors
from intercap_core.pipeline.job import last_words, read_state
from intercap_core.pipeline.plan import Kind, Plan
from intercap_core.project import Project
from intercap_core.schemas import JOINT, OBJECT_TRACK
from intercap_core.stage_list import SEQUENCE_STAGES

LEAVES = ("summary", "page", "export")  # what nothing else of a sequence is made of
_LAST_LINES = 12


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
    plan = Plan(project)
    found = [
        {"stage": stage, "state": str(state.kind), "reasons": list(state.reasons)}
        for stage, state in plan.states(sequence).items()
        if state.kind is not Kind.done
    ]
    if not isinstance(project, EditedProject):
        plan.keep()
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


def before_folder(project: Project, sequence: str) -> Path:
    """Where the result before the last run from the page is kept."""
    return project.results / ".annotate" / sequence / "before"


def before_paths(project: Project, sequence: str) -> dict[str, Path]:
    """Artefacts by stage as they were before the last run from the page."""
    folder = before_folder(project, sequence)
    return {stage: folder / f"{stage}.h5" for stage in SEQUENCE_STAGES}


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
        self._said: Path | None = None

    @property
    def going_on(self) -> bool:
        """Whether a run that was started here has not ended."""
        return self._process is not None and self._process.poll() is None

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
            _keep(project, sequence)
            self._said = project.logs / "annotate.txt"  # no .log: those are of jobs
            self._said.parent.mkdir(parents=True, exist_ok=True)
            self._sequence, self._start, self._ended = sequence, time.time(), 0.0
            with open(self._said, "wb") as said:
                self._process = subprocess.Popen(
                    [sys.executable, "-m", "intercap_core.cli", *told[1:]],
                    stdout=said, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
                    env={**os.environ, "NO_COLOR": "1"},
                )  # fmt: skip

    def stop(self) -> None:
        """End the run, which ends its jobs; what they had finished is kept."""
        with self._lock:
            if self._process is not None and self.going_on:
                self._process.terminate()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.wait(timeout=20)

    def progress(self, project: Project) -> dict[str, Any]:
        """How far the last run is: the sequence, each of its stages' states and last words."""
        if self._process is None:
            return {"state": "none"}
        status = self._process.poll()
        if status is not None and not self._ended:
            self._ended = time.time()
        stages = [{"stage": stage, **self._stage(project, stage)} for stage in self._stages]
        state = "running" if status is None else ("done" if status == 0 else "failed")
        words = ""
        if state == "failed" and self._said is not None and self._said.is_file():
            lines = self._said.read_text(encoding="utf-8", errors="replace").splitlines()
            words = "\n".join(lines[-_LAST_LINES:])
        return {
            "state": state, "sequence": self._sequence, "stages": stages, "words": words,
            "seconds": round((self._ended or time.time()) - self._start, 1),
        }  # fmt: skip

    def _stage(self, project: Project, stage: str) -> dict[str, str]:
        log = project.logs / self._sequence / f"{stage}.log"
        try:
            if log.stat().st_mtime < self._start - 1.0:
                return {"state": "waits", "words": ""}
            state, words = read_state(log)
            return {"state": state, "words": words or last_words(log)}
        except FileNotFoundError:
            return {"state": "waits", "words": ""}


def _keep(project: Project, sequence: str) -> None:
    """Hold on to the artefacts that are there, without a copy where the file system has links."""
    folder = before_folder(project, sequence)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for stage in SEQUENCE_STAGES:
        path = project.artefact(sequence, stage)
        if path.is_file():
            try:
                os.link(path, folder / path.name)
            except OSError:
                shutil.copy2(path, folder / path.name)


def beside(project: Project, sequence: str) -> dict[str, Any]:
    """The new result beside the one before the last run: figures of the verdict, and by how much
    body and object moved, millimetres. Empty where there was none."""
    old = before_paths(project, sequence)
    new = {stage: project.artefact(sequence, stage) for stage in SEQUENCE_STAGES}
    rows: list[dict[str, Any]] = []
    found: dict[str, Any] = {"rows": rows, "there": old["joint"].is_file()}
    figures = [_figures(old), _figures(new)]
    for name in dict.fromkeys([*figures[0], *figures[1]]):
        rows.append({"name": name, "old": figures[0].get(name), "new": figures[1].get(name)})
    try:
        with artefacts.read(old["joint"], JOINT) as a, artefacts.read(new["joint"], JOINT) as b:
            if a["joints"].shape == b["joints"].shape:
                moved = np.linalg.norm(a["joints"] - b["joints"], axis=2).mean(1)
                found["body_moved_mm"] = (1e3 * moved).round(1).tolist()
                shift = np.linalg.norm(a["translation"] - b["translation"], axis=1)
                if np.isfinite(shift).all():
                    found["object_moved_mm"] = (1e3 * shift).round(1).tolist()
    except artefacts.Unreadable:
        pass
    return found


def _figures(paths: Mapping[str, Path]) -> dict[str, float | None]:
    rows: dict[str, float | None] = {}
    try:
        metrics = SequenceMetrics.read(paths["metrics"])
        for error in stated_errors(metrics):
            stated = error.stated if np.isfinite(error.stated) else None
            rows[f"{error.part}, stated error, mm"] = None if stated is None else round(stated, 1)
        rows["flagged frames"] = int(metrics.values["flagged"].sum())
        if metrics.has_object:
            rows["frames in contact"] = int(metrics.values["contact_frame"].sum())
            depth = metrics.values["penetration_mean"]
            rows["penetration, mm"] = round(1e3 * float(np.nanmean(depth)), 2)
    except artefacts.Unreadable:
        pass
    with (
        contextlib.suppress(artefacts.Unreadable),
        artefacts.read(paths["object_track"], OBJECT_TRACK) as track,
    ):
        rows["frames with the object lost"] = int(track["lost"].sum())
        rows["frames with an ambiguous turn"] = int(track["ambiguous"].sum())
    return rows
