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

from intercap_core.annotate import before, rerun
from intercap_core.errors import UserError
from intercap_core.pipeline.plan import OutputStatus, Plan, mark_of
from intercap_core.project import Project, load_project
from intercap_core.stage_list import SEQUENCE_STAGES
from tests.annotate.served import NAME, annotation, artefact, small_project


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_project(tmp_path_factory.mktemp("rerun"))


@pytest.fixture
def project(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Project:
    shutil.copytree(made.parent, tmp_path / "project")
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "project" / "config.yaml"
    path.write_text("dataset: trial\nresults: project/results\n")
    return load_project(path)


def _pretend(monkeypatch: pytest.MonkeyPatch, script: str) -> list[list[str]]:
    """A process of this ``script`` in place of `intercap run`; what was asked for."""
    asked: list[list[str]] = []
    real = rerun.subprocess.Popen

    def start(command: list[str], **options: Any) -> Any:
        asked.append(command)
        return real([sys.executable, "-c", script], **options)

    monkeypatch.setattr(rerun.subprocess, "Popen", start)
    return asked


def _until(holds: Callable[[], bool]) -> None:
    end = time.monotonic() + 30
    while not holds() and time.monotonic() < end:
        time.sleep(0.02)
    assert holds()


def _ended(runs: rerun.Runs) -> None:
    _until(lambda: not runs.going_on)


def _run(project: Project) -> rerun.Runs:
    """One that has ended."""
    runs = rerun.Runs()
    runs.start(project, NAME)
    _ended(runs)
    return runs


def test_a_run_asks_for_one_sequence_and_tells_how_far_it_is(
    project: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = project.logs / NAME / "frames.log"
    script = (
        f"import pathlib; log = pathlib.Path({str(log)!r}); log.parent.mkdir(parents=True);"
        "log.write_text('12:00:00 finished in 1.5 s\\n')"
    )
    asked = _pretend(monkeypatch, script)
    runs = rerun.Runs(cores=2)
    assert runs.progress(project) == {"state": "none"}
    runs.start(project, NAME)
    _ended(runs)
    told = runs.progress(project)
    assert told["state"] == "done" and told["sequence"] == NAME
    states = {one["stage"]: (one["state"], one["words"]) for one in told["stages"]}
    assert states["frames"] == ("finished", "1.5 s") and states["joint"] == ("waits", "")
    assert asked[0][3:7] == ["run", str(project.path), "--cores", "2"]
    assert asked[0][-4:] == ["--", *rerun.targets(project, NAME)]


def test_a_run_that_fails_says_why(project: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    _pretend(monkeypatch, "import sys; print('another run is going on'); sys.exit(1)")
    told = _run(project).progress(project)
    assert told["state"] == "failed" and "another run is going on" in told["words"]


def test_one_run_at_a_time_and_it_can_be_stopped(
    project: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    _pretend(monkeypatch, "import time; time.sleep(60)")
    runs = rerun.Runs()
    runs.start(project, NAME)
    with pytest.raises(UserError, match="in progress"):
        runs.start(project, NAME)
    runs.stop()
    _ended(runs)
    assert not runs.going_on and runs.progress(project)["state"] == "stopped"


def test_a_run_that_takes_its_time_to_end_is_not_waited_for_and_told_once(
    project: Project, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    said = tmp_path / "said"
    script = (
        f"import signal, time, pathlib; said = pathlib.Path({str(said)!r}); told = []\n"
        "signal.signal(15, lambda *_: (told.append(1), said.write_text(f'told {len(told)}')))\n"
        "said.write_text('ready'); time.sleep(60)"
    )
    _pretend(monkeypatch, script)
    runs = rerun.Runs()
    runs.start(project, NAME)
    _until(lambda: said.is_file() and said.read_text() == "ready")
    begin = time.monotonic()
    runs.stop()
    runs.stop()
    assert time.monotonic() - begin < 2.0
    _until(lambda: said.read_text().startswith("told"))
    assert runs.progress(project)["state"] == "ending" and said.read_text() == "told 1"
    with pytest.raises(UserError, match="in progress"):
        runs.start(project, NAME)
    monkeypatch.setattr(rerun, "ENDS_WITHIN_S", -rerun._PATIENCE_S)  # it has had its time
    runs.stop()
    _ended(runs)
    assert runs.progress(project)["state"] == "stopped"


def test_the_result_before_stays_until_a_run_has_ended_well(
    project: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stopped, failed, then done: the old result is that of before the first; then the next."""
    joint = project.artefact(NAME, "joint")
    kept = before.before_paths(project, NAME)["joint"]
    contents = []
    for number, status in enumerate((1, 1, 0, 0)):
        old = joint.read_bytes()
        _pretend(monkeypatch, f"import sys; sys.exit({status})")
        runs = rerun.Runs()
        runs.start(project, NAME)
        _ended(runs)
        runs.progress(project)
        assert before.compare(project, NAME)["unfinished"] == bool(status)
        contents.append((old, kept.read_bytes()))
        new = joint.with_suffix(".new")
        new.write_bytes(old + bytes([number]))  # what the run has made, whole or not
        new.replace(joint)
        monkeypatch.undo()
        monkeypatch.chdir(project.path.parent.parent)
    first = contents[0][0]
    assert [held for _, held in contents] == [first, first, first, contents[3][0]]
    told = before.compare(project, NAME)
    assert told["made_at"] <= told["kept_at"]


def test_a_run_that_ended_on_a_terminal_counts_as_ended(
    project: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    _pretend(monkeypatch, "import sys; sys.exit(1)")
    _run(project)
    later = time.time() + 5
    for stage in SEQUENCE_STAGES:
        path = project.artefact(NAME, stage)
        path.touch()
        os.utime(path, (later, later))
    assert not before.compare(project, NAME)["unfinished"]


def test_the_result_before_is_kept_and_held_against_the_new_one(
    project: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    _pretend(monkeypatch, "")
    _run(project)
    joint = project.artefact(NAME, "joint")
    kept = before.before_paths(project, NAME)["joint"]
    assert os.path.samefile(joint, kept)  # without a copy
    new = joint.with_suffix(".new")
    shutil.copy(joint, new)
    with h5py.File(new, "r+") as file:
        file["joints"][...] += np.float32([0.0, 0.0, 0.01])
    new.replace(joint)
    found = before.compare(project, NAME)
    assert found["there"] and found["body_moved_mm"] == pytest.approx([10.0] * 6, abs=0.1)
    assert found["object_moved_mm"] == [0.0] * 6


def test_a_sequence_without_results_has_nothing_beside_it(project: Project) -> None:
    shutil.rmtree(project.results / NAME)
    assert not before.compare(project, NAME)["there"]


def test_what_is_out_of_date_is_marked_before_snakemake_lists_the_marks(project: Project) -> None:
    plan = Plan(project)
    plan.mark_all()
    stale = [
        stage for stage, state in plan.states(NAME).items() if state.status is OutputStatus.stale
    ]
    assert stale and all(mark_of(project, NAME, stage).is_file() for stage in stale)


def test_the_annotation_decides_what_is_touched(project: Project) -> None:
    """None of the artefacts has a record, so all are to be made; a broken file stops all."""
    stages = [one["stage"] for one in rerun.touched(project, NAME)]
    assert stages[0] == "frames" and stages[-1] == "export"
    annotation(project.path).write_text("contact: [{part: tail}]\n")
    with pytest.raises(UserError, match="part"):
        project.annotation(NAME)
    assert artefact(project.path, "joint").is_file()
