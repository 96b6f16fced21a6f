"""What is decided without a run: what is missing, what an annotation says, what is looked at."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from intercap_core.pipeline import checksums, stage_inputs
from intercap_core.pipeline.checksums import InputChecksums
from intercap_core.pipeline.plan import OutputStatus, Plan
from intercap_core.project import Project, load_project
from intercap_core.stage_list import STAGES

ROOT = Path(__file__).resolve().parents[2]
CUP = "cup"


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Project:
    """A real recording of one sequence, of which nothing is computed."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(ROOT / "config" / "objects", tmp_path / "objects")
    shutil.copy(ROOT / "config" / "objects.yaml", tmp_path)
    (tmp_path / "captures").mkdir()
    (tmp_path / "captures" / "k1.mkv").write_bytes(b"images")
    (tmp_path / "captures" / "calibration.json").write_text("{}")
    (tmp_path / "config.yaml").write_text("dataset: lab\n")
    (tmp_path / "subjects.tsv").write_text("subject\tgender\np01\tneutral\n")
    (tmp_path / "sequences.tsv").write_text(
        "sequence\tsubject\tobject\trecordings\tcalibration\n"
        f"s01\tp01\t{CUP}\tcaptures\tcaptures/calibration.json\n"
    )
    return load_project(Path("config.yaml"))


def test_of_a_sequence_without_results_no_recording_is_read(
    project: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(path: Path) -> str:
        raise AssertionError(f"{path} was read")

    monkeypatch.setattr(checksums, "_file_digest", never)
    states = Plan(project).states("s01")
    assert set(states) == set(STAGES)
    assert {state.status for state in states.values()} == {OutputStatus.missing}
    assert not Plan(project).all_done() and Plan(project).mark("s01", "joint") == []


def test_broken_annotation_makes_all_stages_wait(project: Project) -> None:
    path = project.annotation_path("s01")
    path.parent.mkdir()
    path.write_text("contact: [{part: seat, start: 4, end: 2}]\n")
    plan = Plan(project)
    assert "interval is reversed" in plan.annotation_fault("s01")
    path.write_text("contact: [{part: seat, start: 2, end: 4}]\n")
    assert Plan(project).annotation_fault("s01") == ""


def test_companion_files_of_a_mesh_are_in_the_manifest(project: Project) -> None:
    def files() -> dict[str, str]:
        made_from = stage_inputs.stage_manifest(
            project, "s01", "object_track", project.annotation("s01"),
            artefacts=dict.fromkeys(STAGES["object_track"].reads, "made"),
            checksums=InputChecksums(Path("none")),
        )  # fmt: skip
        return dict(made_from.files["object_"])

    before = files()
    mesh = project.objects[CUP].mesh
    mesh.with_suffix(".mtl").write_text("newmtl cup\n")
    assert set(files()) - set(before) == {f"mesh/{mesh.stem}.mtl"}
