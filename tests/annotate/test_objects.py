"""What is of the object: painted contact vertices and symmetry, kept in and by objects.yaml."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from intercap_core.annotate import document, objects
from intercap_core.errors import UserError
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.project import Project, load_project
from tests.helpers.fitted_capture import object_entry


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Project:
    """A cup that nobody has painted yet."""
    monkeypatch.chdir(tmp_path)
    mesh = Path(object_entry("cup").mesh)
    for file in mesh.parent.glob(f"{mesh.stem}.*"):
        if "contact" not in file.name:
            shutil.copy(file, tmp_path / f"cup{file.suffix}")
    (tmp_path / "objects.yaml").write_text("# ours\ncup:\n  mesh: cup.ply # scanned\n")
    (tmp_path / "subjects.tsv").write_text("subject\tgender\np01\tneutral\n")
    (tmp_path / "sequences.tsv").write_text(
        "sequence\tsubject\tobject\trecordings\tcalibration\none\tp01\tcup\trec\tcal\n"
    )
    (tmp_path / "config.yaml").write_text("dataset: trial\n")
    return load_project(Path("config.yaml"))


def test_a_first_list_is_written_and_named(project: Project) -> None:
    entry = project.objects["cup"]
    current = objects.read_surface(project, entry)
    assert (
        current["vertices"] == []
        and current["digest"] == document.NO_FILE
        and current["sequences"] == 1
    )
    saved = objects.save_surface(project, entry, [3, 4, 50], current["digest"])
    assert saved["vertices"] == [3, 4, 50]
    assert Path("objects.yaml").read_text() == (
        "# ours\ncup:\n  mesh: cup.ply # scanned\n  contact_vertices: cup.contact.json\n"
    )
    again = load_project(Path("config.yaml")).objects["cup"]
    assert np.array_equal(ObjectMesh.load(again).contact_vertices, [3, 4, 50])


def test_a_changed_vertex_list_is_not_overwritten(project: Project) -> None:
    entry = project.objects["cup"]
    first = objects.read_surface(project, entry)
    objects.save_surface(project, entry, [3], first["digest"])
    entry = load_project(Path("config.yaml")).objects["cup"]
    with pytest.raises(UserError, match="another annotator"):
        objects.save_surface(project, entry, [4], first["digest"])
    assert objects.read_surface(project, entry)["vertices"] == [3]


@pytest.mark.parametrize("vertices", [[], [-1], [10**9]])
def test_invalid_vertices_are_refused(project: Project, vertices: list[int]) -> None:
    with pytest.raises(UserError, match="vertices"):
        objects.save_surface(project, project.objects["cup"], vertices, document.NO_FILE)


def test_a_symmetry_is_written_and_removed(project: Project) -> None:
    entry = project.objects["cup"]
    before = Path("objects.yaml").read_text()
    current = objects.read_symmetry(project, entry)
    about_z = {"continuous": [{"axis": [0, 0, 1]}]}
    saved = objects.save_symmetry(project, entry, about_z, current["digest"])
    assert saved["symmetry"] == about_z
    assert "# scanned" in Path("objects.yaml").read_text()
    again = load_project(Path("config.yaml")).objects["cup"]
    assert again.symmetry.continuous[0].axis == (0.0, 0.0, 1.0)
    objects.save_symmetry(project, again, {}, saved["digest"])
    assert Path("objects.yaml").read_text() == before


def test_invalid_symmetries_and_changed_files_are_refused(project: Project) -> None:
    entry = project.objects["cup"]
    current = objects.read_symmetry(project, entry)
    with pytest.raises(UserError, match=r"symmetry discrete\.0: must have at least 16 entries"):
        objects.save_symmetry(project, entry, {"discrete": [[1, 2]]}, current["digest"])
    Path("objects.yaml").write_text("cup: {mesh: cup.ply}\n")
    with pytest.raises(UserError, match="another annotator"):
        objects.save_symmetry(project, entry, {"sphere": True}, current["digest"])
