"""A run from the page: what it is asked for, how far it is, what is kept of the old result."""

from __future__ import annotations

import os
import shutil
import sys
import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from intercap_core.annotate import rerun
from intercap_core.errors import UserError
from intercap_core.pipeline.plan import Kind, Plan, mark_of
from intercap_core.project import Project, load_project
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


def _ended(runs: rerun.Runs) -> None:
    end = time.monotonic() + 30
    while runs.going_on and time.monotonic() < end:
        time.sleep(0.02)


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
    runs = rerun.Runs()
    runs.start(project, NAME)
    _ended(runs)
    told = runs.progress(project)
    assert told["state"] == "failed" and "another run is going on" in told["words"]


def test_one_run_at_a_time_and_it_can_be_stopped(
    project: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    _pretend(monkeypatch, "import time; time.sleep(60)")
    runs = rerun.Runs()
    runs.start(project, NAME)
    with pytest.raises(UserError, match="goes on"):
        runs.start(project, NAME)
    runs.stop()
    assert not runs.going_on and runs.progress(project)["state"] == "failed"


def test_the_result_before_is_kept_and_held_against_the_new_one(
    project: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    _pretend(monkeypatch, "")
    runs = rerun.Runs()
    runs.start(project, NAME)
    _ended(runs)
    joint = project.artefact(NAME, "joint")
    kept = rerun.before_paths(project, NAME)["joint"]
    assert os.path.samefile(joint, kept)  # without a copy
    new = joint.with_suffix(".new")
    shutil.copy(joint, new)
    with h5py.File(new, "r+") as file:
        file["joints"][...] += np.float32([0.0, 0.0, 0.01])
    new.replace(joint)
    found = rerun.beside(project, NAME)
    assert found["there"] and found["body_moved_mm"] == pytest.approx([10.0] * 6, abs=0.1)
    assert found["object_moved_mm"] == [0.0] * 6


def test_a_sequence_without_results_has_nothing_beside_it(project: Project) -> None:
    shutil.rmtree(project.results / NAME)
    assert not rerun.beside(project, NAME)["there"]


def test_what_is_out_of_date_is_marked_before_snakemake_lists_the_marks(project: Project) -> None:
    plan = Plan(project)
    plan.mark_all()
    stale = [stage for stage, state in plan.states(NAME).items() if state.kind is Kind.stale]
    assert stale and all(mark_of(project, NAME, stage).is_file() for stage in stale)


def test_the_annotation_decides_what_is_touched(project: Project) -> None:
    """None of the artefacts has a record, so all are to be made; a broken file stops all."""
    stages = [one["stage"] for one in rerun.touched(project, NAME)]
    assert stages[0] == "frames" and stages[-1] == "export"
    annotation(project.path).write_text("contact: [{part: tail}]\n")
    with pytest.raises(UserError, match="part"):
        project.annotation(NAME)
    assert artefact(project.path, "joint").is_file()
