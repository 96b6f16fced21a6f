"""What a person reads of a stage: one line, remarks, and the list at a run's end."""

from __future__ import annotations

import io
import logging
from pathlib import Path

import h5py
import numpy as np
import pytest
from rich.console import Console

from intercap_core.commands.closing import print_remarks, remarks
from intercap_core.commands.inspect import print_summary
from intercap_core.config import MetricsSettings
from intercap_core.pipeline import outcome
from intercap_core.pipeline.job import job
from intercap_core.pipeline.step import run_step
from intercap_core.project import Project, load_project
from intercap_core.stage_list import SEQUENCE_STAGES, STAGES
from intercap_core.stages import metrics
from tests.helpers import fitted_capture as fitted

SAYS = {
    "frames": "3 of 3 cameras used, 3 with depth; 5 sets over",
    "detections": "keypoints of 100 %, candidates of 100 % of 15 images",
    "scene": "3 of 3 cameras in step, 0 of them moved in time",
    "person": "the subject in 4 of 5 frames, by 3.0 views",
    "object_track": "tracked in 4 of 5 frames, 0 of them ambiguous",
    "body_fit": "fitted in 5 of 5 frames",
    "joint": "3 steps, 0 refused, settled; contact in 0 of 5 frames, 2 not trusted",
    "metrics": "stated errors: body ",
    "summary": "5 frames, 4 flagged, ",
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
    capture = fitted.make_capture(folder, name="s01")
    with h5py.File(capture.paths["joint"], "r+") as file:
        file["flagged"][1:3] = True
        _say(file, "flag_reason", ["", *["object lost, filled in"] * 2, "", ""])
    with h5py.File(capture.paths["scene"], "r+") as file:
        _say(file, "note", ["", "its pose is as given", ""])
    path = fitted.write_project(folder, capture, "s01")
    made = load_project(path)
    metrics.run(
        **capture.inputs(*STAGES["metrics"].reads),
        output=made.artefact("s01", "metrics"),
        object_=capture.object_,
        subject=fitted.SUBJECT,
        body_models=fitted.BODY_MODELS,
        settings=MetricsSettings(),
        **fitted.OTHER_SETTINGS,
    )
    for stage in ("joint", "scene"):
        made.artefact("s01", stage).write_bytes(capture.paths[stage].read_bytes())
    inputs = {stage: made.artefact("s01", stage) for stage in STAGES["summary"].reads}
    run_step("summary", made, "s01", inputs=inputs, output=made.artefact("s01", "summary"))
    return made


@pytest.mark.parametrize("stage", SEQUENCE_STAGES)
def test_a_stage_says_one_line(project: Project, stage: str) -> None:
    said = outcome.line(stage, project.artefact("s01", stage))
    assert said.startswith(SAYS[stage]) and "\n" not in said


def test_what_is_degraded_is_told_by_camera(project: Project) -> None:
    assert outcome.notes("scene", project.artefact("s01", "scene")) == [
        "camera k2: its pose is as given"
    ]


def test_flagged_frames_with_their_reasons(project: Project) -> None:
    flagged, frames, reasons = outcome.flagged_frames(project.artefact("s01", "metrics"))
    assert (flagged, frames) == (4, 5)  # one has no person, one no object by the track
    assert reasons[0] == ("object lost, filled in", 2)


def test_a_run_ends_with_remarks_worst_first(project: Project) -> None:
    (found,) = remarks(project)
    assert found.share == pytest.approx(4 / 5)
    assert found.texts[0].startswith("4 of 5 frames flagged: object lost, filled in (2)")
    assert "scene: camera k2: its pose is as given" in found.texts
    stream = io.StringIO()
    print_remarks(project, Console(file=stream, width=200))
    printed = stream.getvalue()
    assert "1 of 1 sequences have remarks, worst first" in printed
    assert "s01 (logs: " in printed and "k2: its pose is as given" in printed


def test_what_was_only_logged_is_repeated_once(
    project: Project, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the artefact says already is not. Logs are where one works."""
    monkeypatch.chdir(tmp_path)
    folder = Path(project.logs) / "s01"
    folder.mkdir(parents=True)
    with job("s01: scene", folder / "scene.log"):
        logger = logging.getLogger("intercap_core.scene")
        logger.info("nothing to worry about")
        logger.warning("sequence s01: camera k2: its pose is as given")
        for _ in range(2):
            logger.warning("the floor is a guess")
    (found,) = remarks(project)
    said = [text for text in found.texts if text.startswith("scene: ")]
    assert said == ["scene: camera k2: its pose is as given", "scene: the floor is a guess"]


def test_texts_are_printed_as_they_are(
    project: Project, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    print_summary(Path(project.artefact("s01", "joint")))
    assert "  1 to 2: object lost, filled in" in capsys.readouterr().out
    print_summary(Path(project.artefact("s01", "scene")))
    assert "  k2: its pose is as given" in capsys.readouterr().out
