"""What a person reads of a stage: one line, remarks, and the list at a run's end."""

from __future__ import annotations

import io
import logging
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from rich.console import Console

from intercap_core.commands.closing import print_remarks, remarks
from intercap_core.commands.inspect import print_summary
from intercap_core.errors import UserError
from intercap_core.flags import OF_OBJECT, PARTS
from intercap_core.output.export import parameters
from intercap_core.pipeline import outcome
from intercap_core.pipeline.job import job
from intercap_core.pipeline.step import run_step
from intercap_core.project import Project, load_project
from intercap_core.stage_list import SEQUENCE_STAGES
from intercap_core.stages import export
from tests.helpers import fitted_capture as fitted

SAYS = {
    "frames": "3 of 3 cameras used, 3 with depth; 5 sets over",
    "detections": "keypoints of 100 %, candidates of 100 % of 15 images",
    "scene": "3 of 3 cameras in step, 0 of them moved in time",
    "person": "the subject in 4 of 5 frames, by 3.0 views",
    "object_track": "tracked in 4 of 5 frames, 0 of them ambiguous",
    "body_fit": "fitted in 5 of 5 frames",
    "joint": "3 steps, 0 refused, converged (last step 0.2 mm); contact in 0 of 5 frames; "
    "flagged: object 3, contact 3 of 5 frames",
    "metrics": "estimated errors: body ",
    "summary": "flagged: body 1, hands 1, object 3, contact 4 of 5 frames, ",
}


def _say(file: h5py.File, key: str, texts: list[str]) -> None:
    """Other texts, which may be longer than those that were there."""
    attributes = dict(file[key].attrs)
    del file[key]
    made = file.create_dataset(key, data=np.array(texts, "S60"), fletcher32=True)
    made.attrs.update(attributes)


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Project:
    folder = tmp_path_factory.mktemp("project")
    shared = fitted.shared_capture(tmp_path_factory)
    capture = shared.copied(folder, *(s for s in shared.paths if s != "metrics"), name="s01")
    with h5py.File(capture.paths["joint"], "r+") as file:
        file["flagged"][1:3] = np.isin(PARTS, OF_OBJECT)
        file["flag_reason"][1:3] = fitted.FLAG_REASON.encode()
    with h5py.File(capture.paths["scene"], "r+") as file:
        _say(file, "note", ["", "its pose is as given", ""])
    path = fitted.write_project(folder, capture, "s01")
    made = load_project(path)
    capture.measure(made.artefact("s01", "metrics"))
    for stage in ("joint", "scene"):
        made.artefact("s01", stage).write_bytes(capture.paths[stage].read_bytes())
    run_step("summary", made, "s01")
    return made


@pytest.fixture
def logs(project: Project) -> None:
    """Remove the logs of earlier tests."""
    shutil.rmtree(project.logs, ignore_errors=True)


@pytest.mark.parametrize("stage", SEQUENCE_STAGES)
def test_each_stage_is_summarised_in_one_line(project: Project, stage: str) -> None:
    summary = outcome.line(stage, project.artefact("s01", stage))
    assert summary.startswith(SAYS[stage]) and "\n" not in summary


def test_degradations_are_reported_by_camera(project: Project) -> None:
    assert outcome.notes("scene", project.artefact("s01", "scene")) == [
        "camera k2: its pose is as given"
    ]


@pytest.mark.parametrize(("step_mm", "is_noted"), [(0.4, False), (1.4, True)])
def test_an_iteration_limit_is_noted_if_the_fit_still_moved(
    project: Project, tmp_path: Path, step_mm: float, is_noted: bool
) -> None:
    path = tmp_path / "joint.h5"
    path.write_bytes(project.artefact("s01", "joint").read_bytes())
    with h5py.File(path, "r+") as file:
        file.attrs["converged"], file.attrs["last_step_mm"] = False, step_mm
    assert any("1.4 mm" in note for note in outcome.notes("joint", path)) == is_noted
    assert f"iteration limit reached (last step {step_mm:.2g} mm)" in outcome.line("joint", path)


def test_a_joint_fit_without_a_step_is_noted(project: Project, tmp_path: Path) -> None:
    path = tmp_path / "joint.h5"
    path.write_bytes(project.artefact("s01", "joint").read_bytes())
    with h5py.File(path, "r+") as file:
        file.attrs["converged"], file.attrs["iterations"] = False, 0
    assert "no step of the joint fit lowered its energy" in outcome.notes("joint", path)


def test_flagged_frames_with_their_reasons(project: Project) -> None:
    flags, reasons = outcome.flagged_frames(project.artefact("s01", "metrics"))
    assert flags.summary() == "flagged: body 1, hands 1, object 3, contact 4 of 5 frames"
    assert reasons[0] == (fitted.FLAG_REASON, 3)


def _printed(project: Project, width: int = 80) -> list[str]:
    stream = io.StringIO()
    print_remarks(project, Console(file=stream, width=width))
    return stream.getvalue().splitlines()


def test_a_run_ends_with_remarks_worst_first(project: Project, logs: None) -> None:
    (found,) = remarks(project)
    assert found.share == pytest.approx((1 + 1 + 3 + 4) / 20)
    assert "3, contact 4 of 5 frames: object, contact: object lost, filled in (3)" in found.texts[0]
    assert "scene: camera k2: its pose is as given" in found.texts
    printed = "\n".join(_printed(project, width=200))
    assert "1 of 1 sequences have remarks, worst first" in printed
    assert "s01 (logs: " in printed and "k2: its pose is as given" in printed


def test_logged_warnings_are_repeated_once(project: Project, logs: None) -> None:
    """What the artefact says already is not."""
    folder = Path(project.logs) / "s01"
    folder.mkdir(parents=True)
    with job("s01: scene", folder / "scene.log"):
        logger = logging.getLogger("intercap_core.scene")
        logger.info("nothing to worry about")
        logger.warning("sequence s01: camera k2: its pose is as given")
        for _ in range(2):
            logger.warning("the floor is a guess")
    (found,) = remarks(project)
    lines = [text for text in found.texts if text.startswith("scene: ")]
    assert lines == ["scene: camera k2: its pose is as given", "scene: the floor is a guess"]


def _warn(log: Path, *texts: str) -> None:
    with job(log.stem, log):
        for text in texts:
            logging.getLogger("intercap_core").warning(text)


def test_warnings_of_page_export_and_dataset_are_repeated(project: Project, logs: None) -> None:
    """A warning that several stages log for one mesh is repeated once."""
    for stage in ("page", "export"):
        folder = project.artefact("s01", stage)
        folder.mkdir(parents=True, exist_ok=True)
    holes = "cup.ply: 9 % of its edges are open"
    _warn(project.logs / "s01" / "object_track.log", holes)
    _warn(project.logs / "s01" / "page.log", holes, "s01: no overlays: an image does not decode")
    _warn(project.logs / "s01" / "export.log", holes, "sequence s01: no licence")
    _warn(project.logs / "dataset.log", "sequence s07 is left out: its summary is broken")
    (found,) = remarks(project)
    assert [text for text in found.texts if holes in text] == [f"object_track: {holes}"]
    assert "page: no overlays: an image does not decode" in found.texts
    assert "export: no licence" in found.texts
    printed = _printed(project)
    assert printed[:2] == ["the dataset", "  sequence s07 is left out: its summary is broken"]
    assert printed[-1] == f"all remarks: {project.logs / 'remarks.txt'}"
    assert (project.logs / "remarks.txt").read_text().splitlines() == printed[:-1]


def test_remarks_beyond_twenty_sequences_are_in_a_file(project: Project, logs: None) -> None:
    names = [f"t{n:02d}" for n in range(23)]
    many = replace(project, sequences=dict.fromkeys(names, project.sequences["s01"]))
    for name in names:
        many.artefact(name, "page").mkdir(parents=True)
        _warn(many.logs / name / "page.log", f"{name}: [red]no overlays")
    printed = _printed(many)
    assert printed[0] == "23 of 23 sequences have remarks, worst first:"
    assert len(printed) == 1 + 2 * 20 + 1
    assert printed[-1] == f"3 more sequences, and all remarks: {many.logs / 'remarks.txt'}"
    kept = (many.logs / "remarks.txt").read_text().splitlines()
    assert kept[:-6] == printed[:-1]
    assert [line for line in kept if line.startswith("  ")] == ["  page: [red]no overlays"] * 23
    for name in names:
        (many.logs / name / "page.log").unlink()
    assert _printed(many) == []
    assert (many.logs / "remarks.txt").read_text() == "no remarks\n"


def test_texts_are_printed_as_they_are(
    project: Project, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    print_summary(Path(project.artefact("s01", "joint")))
    assert "  0 to 2: object, contact: object lost, filled in" in capsys.readouterr().out
    print_summary(Path(project.artefact("s01", "scene")))
    assert "  k2: its pose is as given" in capsys.readouterr().out


@pytest.mark.parametrize("stage", ["page", "export"])
def test_only_an_earlier_output_is_replaced(project: Project, tmp_path: Path, stage: str) -> None:
    home, file = tmp_path / "home", tmp_path / "notes.txt"
    home.mkdir()
    for path in (file, home / "thesis.txt"):
        path.write_text("years of work")
    for path, words in ((home, f"neither empty nor an earlier {stage}"), (file, "is a file")):
        with pytest.raises(UserError, match=words) as caught:
            run_step(stage, project, "s01", output=path)
        assert str(path) in str(caught.value)
    assert file.read_text() == (home / "thesis.txt").read_text() == "years of work"


def test_an_export_that_fails_leaves_the_earlier_one_and_a_new_one_replaces_it(
    project: Project, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / export.MARKER).write_text("earlier")

    def full(*_: object) -> None:
        raise OSError("no space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(parameters, "intercap_result", full)
        with pytest.raises(OSError, match="no space"):
            run_step("export", project, "s01", output=out)
    assert [p.name for p in tmp_path.rglob("*")] == ["out", export.MARKER]
    assert (out / export.MARKER).read_text() == "earlier"
    (out / "old.txt").write_text("of an earlier version")
    run_step("export", project, "s01", output=out)
    assert not (out / "old.txt").exists() and (out / "intercap" / "res.pkl").is_file()
    assert [p.name for p in tmp_path.iterdir()] == ["out"]
