"""A run from the page: what it is asked for, how far it is, what is kept of the old result."""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from intercap_core.annotate import rerun
from intercap_core.annotate.before import Backup
from intercap_core.errors import UserError
from intercap_core.pipeline.plan import OutputStatus, Plan, mark_of
from intercap_core.project import Project, load_project
from intercap_core.stage_list import SEQUENCE_STAGES
from tests.annotate.served import NAME, annotation, artefact


@pytest.fixture
def project(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Project:
    shutil.copytree(made.parent, tmp_path / "project")
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "project" / "config.yaml"
    path.write_text("dataset: trial\n")
    return load_project(path)


def _pretend(monkeypatch: pytest.MonkeyPatch, script: str) -> list[list[str]]:
    """A process of this ``script`` in place of `intercap run`; what was asked for."""
    commands: list[list[str]] = []
    real = rerun.subprocess.Popen

    def start(command: list[str], **options: Any) -> Any:
        commands.append(command)
        return real([sys.executable, "-c", script], **options)

    monkeypatch.setattr(rerun.subprocess, "Popen", start)
    return commands


def _until(holds: Callable[[], bool]) -> None:
    end = time.monotonic() + 30
    while not holds() and time.monotonic() < end:
        time.sleep(0.02)
    assert holds()


def _wait_for_end(runs: rerun.RunManager) -> None:
    _until(lambda: not runs.in_progress)


def _run(project: Project) -> rerun.RunManager:
    """One that has ended."""
    runs = rerun.RunManager()
    runs.start(project, NAME)
    _wait_for_end(runs)
    return runs


def test_a_run_computes_one_sequence_and_reports_progress(
    project: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = project.logs / NAME / "frames.log"
    for name, stage, seconds in (
        (NAME, "frames", 2.5),
        ("s02", "frames", 9.0),
        ("s02", "joint", 20.0),
        ("s03", "joint", 40.0),
    ):
        earlier = project.logs / name / f"{stage}.log"
        earlier.parent.mkdir(parents=True, exist_ok=True)
        earlier.write_text(f"12:00:00 finished in {seconds} s\n")
        os.utime(earlier, (1e9, 1e9))
    script = (
        f"import pathlib; log = pathlib.Path({str(log)!r});"
        "log.write_text('12:00:00 finished in 1.5 s\\n')"
    )
    commands = _pretend(monkeypatch, script)
    runs = rerun.RunManager(cores=2)
    assert runs.progress(project) == {"state": "none"}
    runs.start(project, NAME)
    _wait_for_end(runs)
    progress = runs.progress(project)
    assert progress["state"] == "done" and progress["sequence"] == NAME
    states = {stage["stage"]: (stage["state"], stage["message"]) for stage in progress["stages"]}
    assert states["frames"] == ("finished", "1.5 s") and states["joint"] == ("waits", "")
    expected = {stage["stage"]: stage["expected_s"] for stage in progress["stages"]}
    assert (expected["frames"], expected["joint"], expected["scene"]) == (2.5, 30.0, None)
    assert commands[0][3:7] == ["run", str(project.path), "--cores", "2"]
    assert commands[0][-4:] == ["--", *rerun.targets(project, NAME)]


def test_a_run_that_fails_says_why(project: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    _pretend(monkeypatch, "import sys; print('another run is going on'); sys.exit(1)")
    progress = _run(project).progress(project)
    assert progress["state"] == "failed" and "another run is going on" in progress["message"]


def test_stopping_a_run_does_not_wait_and_signals_once(
    project: Project, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    log_file = tmp_path / "log"
    script = (
        f"import signal, time, pathlib; log = pathlib.Path({str(log_file)!r}); signals = []\n"
        "signal.signal(15, lambda *_: ("
        "signals.append(1), log.write_text(f'signal {len(signals)}')))\n"
        "log.write_text('ready'); time.sleep(60)"
    )
    _pretend(monkeypatch, script)
    runs = rerun.RunManager()
    runs.start(project, NAME)
    _until(lambda: log_file.is_file() and log_file.read_text() == "ready")
    begin = time.monotonic()
    runs.stop()
    runs.stop()
    assert time.monotonic() - begin < 2.0
    _until(lambda: log_file.read_text().startswith("signal"))
    assert runs.progress(project)["state"] == "ending" and log_file.read_text() == "signal 1"
    with pytest.raises(UserError, match="in progress"):
        runs.start(project, NAME)
    monkeypatch.setattr(rerun, "ENDS_WITHIN_S", -rerun._PATIENCE_S)  # it has had its time
    runs.stop()
    _wait_for_end(runs)
    assert runs.progress(project)["state"] == "stopped"


def test_the_backup_is_kept_until_a_run_succeeds(
    project: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stopped, failed, then done: the old result is that of before the first; then the next."""
    joint = project.artefact(NAME, "joint")
    kept = Backup(project, NAME).paths["joint"]
    contents = []
    for number, status in enumerate((1, 1, 0, 0)):
        old = joint.read_bytes()
        _pretend(monkeypatch, f"import sys; sys.exit({status})")
        runs = rerun.RunManager()
        runs.start(project, NAME)
        _wait_for_end(runs)
        runs.progress(project)
        assert Backup(project, NAME).compare()["unfinished"] == bool(status)
        contents.append((old, kept.read_bytes()))
        new = joint.with_suffix(".new")
        new.write_bytes(old + bytes([number]))  # what the run has made, whole or not
        new.replace(joint)
        monkeypatch.undo()
        monkeypatch.chdir(project.path.parent.parent)
    first = contents[0][0]
    assert [backup for _, backup in contents] == [first, first, first, contents[3][0]]
    progress = Backup(project, NAME).compare()
    assert progress["made_at"] <= progress["kept_at"]


def test_a_run_in_a_terminal_counts_as_success(
    project: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    _pretend(monkeypatch, "import sys; sys.exit(1)")
    _run(project)
    later = time.time() + 5
    for stage in SEQUENCE_STAGES:
        path = project.artefact(NAME, stage)
        path.touch()
        os.utime(path, (later, later))
    assert not Backup(project, NAME).compare()["unfinished"]


def test_the_old_result_is_kept_and_compared(
    project: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    _pretend(monkeypatch, "")
    _run(project)
    joint = project.artefact(NAME, "joint")
    kept = Backup(project, NAME).paths["joint"]
    assert os.path.samefile(joint, kept)  # without a copy
    new = joint.with_suffix(".new")
    shutil.copy(joint, new)
    with h5py.File(new, "r+") as file:
        file["joints"][...] += np.float32([0.0, 0.0, 0.01])
    new.replace(joint)
    found = Backup(project, NAME).compare()
    assert found["exists"] and found["body_moved_mm"] == pytest.approx([10.0] * 6, abs=0.1)
    assert found["object_moved_mm"] == [0.0] * 6


def test_without_results_there_is_no_comparison(project: Project) -> None:
    shutil.rmtree(project.results / NAME)
    assert not Backup(project, NAME).compare()["exists"]


def test_stale_outputs_are_marked(project: Project) -> None:
    plan = Plan(project)
    plan.mark_all()
    stale = [
        stage for stage, state in plan.states(NAME).items() if state.status is OutputStatus.stale
    ]
    assert stale and all(mark_of(project, NAME, stage).is_file() for stage in stale)


def test_stages_without_a_record_are_stale(project: Project) -> None:
    """None of the artefacts has a record, so all are to be made; a broken file stops all."""
    stages = [stage["stage"] for stage in rerun.stale_stages(project, NAME)]
    assert stages[0] == "frames" and stages[-1] == "export"
    annotation(project.path).write_text("contact: [{part: tail}]\n")
    with pytest.raises(UserError, match="part"):
        project.annotation(NAME)
    assert artefact(project.path, "joint").is_file()
