"""`intercap scan`: refusals before any work, the entry of objects.yaml, and scans of a ball."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml

from intercap_core.commands.scan import _appended, add_entry, scan
from intercap_core.errors import UserError
from intercap_core.project import Project, load_project
from intercap_core.scan.proposal import propose_symmetry
from intercap_core.scan.result import ScannedMesh
from tests.helpers.fitted_capture import Capture, shared_capture, write_project
from tests.helpers.manifests import rewrite_manifests

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def project(tmp_path: Path) -> Project:
    """The project of config/test, with its tables in a folder of its own."""
    for name in ("sequences.tsv", "subjects.tsv"):
        table = (ROOT / "config" / "test" / name).read_text()
        (tmp_path / name).write_text(table.replace("../../results", "results"))
    settings = yaml.safe_load((ROOT / "config" / "test" / "config.yaml").read_text())
    settings["objects"] = "objects.yaml"
    entries = yaml.safe_load((ROOT / "config" / "objects.yaml").read_text())
    for entry in entries.values():
        entry["mesh"] = str(ROOT / "config" / entry["mesh"])
        entry.pop("contact_vertices", None)
    (tmp_path / "objects.yaml").write_text("# our objects\n" + yaml.safe_dump(entries))
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(settings))
    return load_project(tmp_path / "config.yaml")


@pytest.mark.parametrize(
    ("sequence", "options", "message"),
    [
        ("cup_drink_s99", {}, "cup_drink_s99"),
        ("cup_drink_s04", {"output": "objects.yaml"}, "exists and is not replaced.*--replace"),
        ("cup_drink_s04", {"improve": True}, "column 'object' is 'cup'.*name a sequence of this"),
    ],
)
def test_what_cannot_be_scanned_is_refused_at_once(
    project: Project, sequence: str, options: dict[str, Any], message: str
) -> None:
    if "output" in options:
        options = options | {"output": project.path.parent / options["output"]}
    with pytest.raises(UserError, match=message):
        scan(project, "kettle", [sequence], **options)
    assert not project.results.exists()


def test_a_new_object_is_added_to_the_users_file(project: Project) -> None:
    cylinder = trimesh.creation.cylinder(0.04, 0.2)
    vertices, faces = np.asarray(cylinder.vertices), np.asarray(cylinder.faces)
    mesh = ScannedMesh(
        vertices, faces, np.ones(len(vertices), bool), np.full((len(vertices), 3), 90, np.uint8),
        propose_symmetry(vertices, faces), turned_deg=170.0, sets=40,
    )  # fmt: skip
    path = project.path.parent / "objects" / "kettle.ply"
    path.parent.mkdir()
    path.write_bytes(cylinder.export(file_type="ply"))
    add_entry(project, "kettle", ["bottle"], mesh, path)
    file = project.path.parent / "objects.yaml"
    assert file.read_text().startswith("# our objects\n")  # comments are kept
    entry = load_project(project.path).objects["kettle"]
    assert entry.labels == ("bottle",) and entry.mesh.is_file()
    assert [s.axis for s in entry.symmetry.continuous] == [(0.0, 0.0, 1.0)]
    before = file.read_text()
    add_entry(load_project(project.path), "kettle", [], mesh, path)  # the user's entry stays
    assert file.read_text() == before


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("", "kettle: {mesh: k.ply}\n"),
        ("# none yet\n{}\n", "# none yet\nkettle: {mesh: k.ply}\n"),
        ("cup: {mesh: c.ply}", "cup: {mesh: c.ply}\nkettle: {mesh: k.ply}\n"),
        ("{cup: {mesh: c.ply}}\n", None),
        ("  cup: {mesh: c.ply}\n", None),
    ],
)
def test_an_entry_is_appended_only_if_the_file_stays_valid(before: str, after: str | None) -> None:
    assert _appended(before, "kettle: {mesh: k.ply}\n") == after


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return shared_capture(tmp_path_factory)


def _radius(points: np.ndarray) -> float:
    """Radius of the sphere of least squares through points (N, 3)."""
    design = np.column_stack([2 * points, np.ones(len(points))])
    solution = np.linalg.lstsq(design, (points**2).sum(1), rcond=None)[0]
    return float(np.sqrt(solution[3] + solution[:3] @ solution[:3]))


@pytest.mark.parametrize("improve", [False, True])
def test_a_ball_that_nobody_moves(
    tmp_path: Path, capture: Capture, improve: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three cameras around a person whose palm is at the ball see half of it: it is refused, and
    scanned with a wider limit."""
    settings = write_project(tmp_path, capture, "cap")
    true = float(np.abs(capture.mesh.vertices[:, 0]).max())
    name = "globe"
    if improve:
        name = "football"
        rough = tmp_path / "rough.ply"
        rough.write_bytes(trimesh.creation.box((1.6 * true,) * 3).export(file_type="ply"))
        (tmp_path / "objects.yaml").write_text(f"{name}: {{mesh: {rough}}}\n")
    project = load_project(settings)
    rewrite_manifests(project)
    options: dict[str, Any] = {"labels": ["sports ball"], "improve": improve}
    monkeypatch.setattr("intercap_core.scan.fusion.FINEST_M", 0.004)  # a fourth of the faces
    if not improve:
        with pytest.raises(UserError, match=r"no camera measured \d\d% of its surface.*most 25%"):
            scan(project, name, ["cap"], **options)
    monkeypatch.setattr("intercap_core.commands.scan.MAX_CLOSED", 0.7)
    mesh, path, page = scan(project, name, ["cap"], **options)
    assert path.is_file() and page.is_file() and mesh.watertight
    assert _radius(mesh.vertices[mesh.measured]) == pytest.approx(true, abs=0.005)
    assert name in load_project(settings).objects
