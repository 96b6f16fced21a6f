"""A virtual recording of a person alone, taken from the studio through every stage."""

from __future__ import annotations

import json
import logging
import pickle
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from bench.evaluate import field
from bench.evaluate.part import Measured
from intercap_core.commands.check import check_sequences
from intercap_core.commands.inspect import print_summary
from intercap_core.commands.pictures import draw_closeups
from intercap_core.commands.release import check_release, write_release
from intercap_core.errors import UserError
from intercap_core.evaluation.summary import SequenceSummary
from intercap_core.joint.problem import TERMS
from intercap_core.joint.terms.body_data import BodyData
from intercap_core.joint.terms.term import Data
from intercap_core.output.release.manifest import KINDS
from intercap_core.pipeline.outcome import line, notes
from intercap_core.pipeline.step import run_dataset, run_step, run_studio
from intercap_core.posed import open_sequence
from intercap_core.project import Project, load_project
from intercap_core.stage_list import SEQUENCE_STAGES, STAGES

NAME = "alone"
ROW = (
    "alone\ts04\t\tresults/trial/recordings/alone\tresults/trial/recordings/alone/calibration.json"
    "\tresults/trial/recordings/alone/keypoints\tresults/trial/recordings/alone/candidates"
    "\tresults/trial/recordings/alone/truth.h5\n"
)


class Messages(logging.Handler):
    """The texts that were logged."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.texts.append(record.getMessage())


@pytest.fixture(scope="module")
def logged() -> Iterator[Messages]:
    """What the pipeline logs while ``project`` is made."""
    logger, messages = logging.getLogger("intercap_core.pipeline"), Messages()
    level = logger.level
    logger.addHandler(messages)
    logger.setLevel(logging.INFO)
    yield messages
    logger.removeHandler(messages)
    logger.setLevel(level)


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory, logged: Messages) -> Project:
    """Every stage has run, and the dataset twice: first with seven sequences without results."""
    folder = tmp_path_factory.mktemp("alone")
    (folder / "config.yaml").write_text(
        "dataset: trial\n"
        f"results: {folder / 'results'}\n"
        "body_fit: {points_per_frame: 300}\n"
        "page: {cameras: 1, frames: 1}\n"
        "studio: {colour_mode: 720P, cameras: 2, captures: {alone: "
        "{interaction: walk_and_wave, subject: s04, seed: 31, frames: 6, annotate: true}}}\n"
    )
    (folder / "objects.yaml").write_text("")
    (folder / "subjects.tsv").write_text("subject\tgender\ns04\tmale\n")
    (folder / "sequences.tsv").write_text(
        "sequence\tsubject\tobject\trecordings\tcalibration\tkeypoints\tcandidates\ttruth\n" + ROW
    )
    project = load_project(folder / "config.yaml")
    assert not check_sequences(project).faults
    run_studio(project, NAME)
    for stage in STAGES:
        run_step(stage, project, NAME)
    there = project.sequences[NAME]
    lacking = {f"s{n:02d}": there for n in range(2, 9)}
    run_dataset(replace(project, sequences={NAME: there, **lacking}))
    run_dataset(project)
    return project


def _open(project: Project, stage: str) -> h5py.File:
    return h5py.File(project.artefact(NAME, stage))


def test_no_stage_reports_an_object(project: Project) -> None:
    with _open(project, "object_track") as track, _open(project, "joint") as joint:
        assert (track.attrs["object"], track.attrs["seed_source"]) == (b"", b"none")
        assert b"names no object" in track.attrs["doubts"]
        assert track["lost"][()].all() and (track["candidate"][()] == -1).all()
        for file in (track, joint):
            assert np.isnan(file["rotation"]).all() and np.isnan(file["translation"]).all()
        assert joint.attrs["object"] == b"" and np.isnan(joint["contact_probability"]).all()
    with _open(project, "metrics") as metrics:
        content = {*metrics, *metrics["truth"], *metrics["truth/joint"]}
        content.discard("ground_penetration")
        of_object = ("object", "contact", "penetration", "slip")
        assert not [key for key in content if any(word in key for word in of_object)]


def test_the_body_is_fitted_with_its_own_terms(project: Project) -> None:
    with _open(project, "joint") as joint:
        terms = {name.decode() for name in joint["energy_names"]}
        alone = {term.name for term in TERMS if Data.OBJECT not in term.needs}
        assert terms == {BodyData.name} | alone
        before, after = (joint[f"energy_{when}"][()].sum() for when in ("before", "after"))
        assert joint.attrs["iterations"] > 0 and after < before
        assert not joint["flagged"][()].all()
    with _open(project, "metrics") as metrics:
        first, last = (metrics[f"truth/{s}/body_pve"][()].mean() for s in ("body_fit", "joint"))
        assert last < min(0.030, first + 0.001)
        assert "no images" not in {reason.decode() for reason in metrics["flag_reason"]}


def test_summaries_of_the_stages_omit_the_object(project: Project) -> None:
    lines = {stage: line(stage, project.artefact(NAME, stage)) for stage in SEQUENCE_STAGES}
    assert lines["object_track"].startswith("no object: the sequence names no object")
    assert "the body alone, without an object" in lines["joint"] and "contact" not in lines["joint"]
    assert not notes("object_track", project.artefact(NAME, "object_track"))  # as was asked for


def _of_folder(folder: Path) -> tuple[int, float]:
    """Its files, and their size in MB."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return len(files), sum(path.stat().st_size for path in files) / 1e6


def test_page_export_and_dataset_are_summarised_in_one_line(
    project: Project, logged: Messages
) -> None:
    files, size = _of_folder(project.artefact(NAME, "export"))
    assert (
        f"sequence {NAME}, export: amass, coco, glb, intercap: 6 frames in {files} files, "
        f"{size:.1f} MB"
    ) in logged.texts
    page = project.artefact(NAME, "page")
    pictures, (_, size) = (
        (page / "index.html").read_text().count("data:image/"),
        _of_folder(page),
    )
    assert pictures > 0
    assert (
        f"sequence {NAME}, page: 2 of 2 cameras, {pictures} pictures, {size:.1f} MB with the viewer"
    ) in logged.texts
    assert logged.texts[-2:] == [
        "dataset trial: 1 of 8 sequences merged, 6 frames; left out: s02, s03, s04, s05, s06 and 2 "
        "more",
        "dataset trial: 1 of 1 sequences merged, 6 frames",
    ]


def test_files_for_other_tools_hold_the_body(project: Project) -> None:
    folder = project.artefact(NAME, "export")
    kinds = {path.name for path in folder.iterdir() if path.is_dir()}
    assert kinds == {"amass", "body", "coco", "glb", "intercap"}
    assert [path.name for path in (folder / "amass").iterdir()] == ["body.npz"]
    named = json.loads((folder / "coco" / "annotations.json").read_text())
    people = {kind["id"] for kind in named["categories"] if kind["name"] == "person"}
    assert named["annotations"]
    assert {entry["category_id"] for entry in named["annotations"]} == people
    result = pickle.loads((folder / "intercap" / "res.pkl").read_bytes())
    assert len(result["transl"]) == 6 and not {"ob_pose", "ob_trans"} & result.keys()
    text = (folder / "README.txt").read_text()
    assert "bop is omitted" in text and "contact is omitted" in text
    assert "object pose" not in text and "Object mesh" not in text
    content = json.loads((folder / "export.json").read_text())
    assert (content["object"], content["formats"]) == ("", ["amass", "coco", "glb", "intercap"])
    data = (folder / "glb" / f"{NAME}.glb").read_bytes()
    length = int.from_bytes(data[12:16], "little")
    assert [mesh["name"] for mesh in json.loads(data[20 : 20 + length])["meshes"]] == ["body"]


def test_sequence_without_object_counts_as_exported(project: Project) -> None:
    def share() -> float:
        found = field.measure(project, NAME)
        return field.flat([Measured(field.ALONE, [found])])["field.people_alone_share"]

    folder = project.artefact(NAME, "export")
    assert field.exported_alone(folder) and share() == 1
    missing = field.flat([Measured(field.ALONE, [field.measure(project, NAME)], ["another"])])
    assert missing["field.people_alone_share"] == 0.5
    away = folder.with_name("away")
    folder.rename(away)
    try:
        assert not field.exported_alone(folder) and share() == 0
    finally:
        away.rename(folder)
    body = folder / "amass" / "body.npz"
    kept = body.rename(folder / "body.npz")
    try:
        assert not field.exported_alone(folder)
    finally:
        kept.rename(body)


def test_the_report_leaves_objects_and_contact_out(project: Project) -> None:
    overview = (project.site / "index.html").read_text()
    page = (project.artefact(NAME, "page") / "index.html").read_text()
    for part in ('id="penetration"', 'id="heatmaps"', 'id="track"', "in contact</text>", ">nan"):
        assert part not in overview + page
    assert "people alone" in overview and 'id="body"' in page
    summary = json.loads((project.results / "summary.json").read_text())
    assert summary["vertex_to_cloud"]["object_mm"] is None
    assert summary["penetration"]["share_le_5mm"] is None
    assert "object_track" not in summary["truth"] or not summary["truth"]["object_track"]


def test_results_are_points_and_pictures_of_the_body(
    project: Project, capsys: pytest.CaptureFixture[str]
) -> None:
    for stage in ("joint", "body_fit"):
        found = open_sequence(project, NAME, stage=stage)
        moment = found.at(2)
        assert moment.object_.shape == (0, 3) and found.objects().shape == (6, 0, 3)
        assert moment.body.shape[1] == 3 and abs(moment.body[:, 2].min()) < 0.05
        assert found.trusted["body"].any() and "object" not in found.trusted
    assert draw_closeups(project.path, []) == ([], [NAME])
    for stage in SEQUENCE_STAGES:
        print_summary(project.artefact(NAME, stage), verify=True)
    assert "a person alone" in capsys.readouterr().out


def test_the_truth_has_no_object(project: Project) -> None:
    recordings = project.recordings_made(NAME)
    assert recordings is not None
    with h5py.File(recordings / "truth.h5") as truth:
        assert truth.attrs["object"] == b"" and not truth["region_contact"][()].any()
        assert "rotation" not in truth and "object_vertices" not in truth
        steps = np.linalg.norm(np.diff(truth["joints"][()], axis=0), axis=-1) * 15
        assert steps.max() < 4.5  # m/s
    annotation = project.annotation(NAME)
    assert annotation.floor and annotation.contact is None and annotation.object_pose is None


def test_an_annotation_of_an_object_is_refused(project: Project) -> None:
    path = project.annotation_path(NAME)
    kept = path.read_text()
    try:
        path.write_text("contact:\n  - {part: left_hand, start: 0, end: 2}\n")
        with pytest.raises(UserError, match=r"contact is annotated.*names no object.*'alone'"):
            project.annotation(NAME)
    finally:
        path.write_text(kept)


def test_a_script_and_an_object_must_fit(project: Project, tmp_path: Path) -> None:
    text = (project.path.parent / "sequences.tsv").read_text()
    mesh = Path(__file__).resolve().parents[2] / "config" / "objects" / "09_cup.ply"
    for name in ("config.yaml", "subjects.tsv"):
        (tmp_path / name).write_text((project.path.parent / name).read_text())
    (tmp_path / "objects.yaml").write_text(f"cup: {{mesh: {mesh}}}\n")
    root = project.path.parent
    text = text.replace("s04\t\t", "s04\tcup\t").replace("results/trial", f"{root}/results/trial")
    (tmp_path / "sequences.tsv").write_text(text)
    faults = [
        str(fault) for fault in check_sequences(load_project(tmp_path / "config.yaml")).faults
    ]
    assert any("needs no object, the sequence has 'cup'" in line for line in faults)


def test_release_asks_for_consent_if_a_real_person_was_recorded(
    project: Project, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    read = SequenceSummary.read

    def without_truth(path: Path) -> SequenceSummary:
        summary = read(path)
        return replace(summary, metrics=replace(summary.metrics, has_truth=False))

    monkeypatch.setattr(SequenceSummary, "read", staticmethod(without_truth))
    write_release(project, ["card"])
    assert "datasheet.md has placeholders: set card." in caplog.text
    assert "card.collection, card.consent" in caplog.text and str(project.path) in caplog.text


def test_release_lists_and_verifies_its_files(
    project: Project, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    path = write_release(project, KINDS)
    assert path == project.results / "release.json"
    # what virtual recordings need not state is no placeholder
    assert "set card.licence, card.uses, card.biases" in caplog.text
    assert "card.consent" not in caplog.text and "several" not in caplog.text
    content = json.loads(path.read_text())
    assert content["sequences"] == [NAME] and content["dataset"] == "trial"
    assert {entry["kind"] for entry in content["files"]} == set(KINDS)
    assert not any("truth" in entry["path"] or "mkv" in entry["path"] for entry in content["files"])
    assert str(project.path.parent) not in path.read_text()  # no folder of this machine
    assert set(content["inputs"]) >= {"sequences.tsv", "subjects.tsv", "objects.yaml"}
    assert check_release(project.results)
    card = project.results / "README.md"
    text = card.read_text()
    assert "0 objects" in text and "The recordings are virtual" in text
    card.write_text(text + "more")
    assert not check_release(project.results)
    assert "changed: README.md" in capsys.readouterr().out
    card.write_text(text)
