"""Meshes with faults are repaired or refused, and so are lists of contact vertices."""

import io
import json
import logging
import pickle
from pathlib import Path

import numpy as np
import pytest
import trimesh

from intercap_core.entries import ObjectEntry, Symmetry
from intercap_core.errors import UserError
from intercap_core.geometry.rigid.contact_vertices import contact_list
from intercap_core.geometry.rigid.mesh import ObjectMesh


def _entry(path, **values):
    return ObjectEntry(name="thing", mesh=path, **values)


def _write(mesh, path: Path) -> Path:
    mesh.export(path)
    return path


def _ball(subdivisions=3, scale=1.0):
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.11 * scale)


BALL = _ball()
VERTICES, FACES = np.array(BALL.vertices), np.array(BALL.faces)


def _mesh(vertices=VERTICES, faces=FACES):
    return trimesh.Trimesh(vertices, faces, process=False)


def _soup(faces=FACES):
    """Faces that share no vertices."""
    return VERTICES[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)


NO_VERTICES = (
    b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\n"
    b"property float z\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n"
)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "no such mesh"),
        (trimesh.PointCloud(VERTICES), "0 faces"),
        (_mesh(np.where(np.arange(642)[:, None] == 7, np.nan, VERTICES)), "vertex 7 is not a"),
        (_ball(scale=1000), r"220 m long.*millimetres \(0\.001\)"),
        (_ball(scale=100), r"22 m long.*centimetres \(0\.01\)"),
        (_mesh(faces=FACES[:, [0, 1, 1]]), "encloses"),
        (b"", "not a readable mesh|0 faces"),
        (NO_VERTICES, "0 faces|not a readable mesh"),
        (_ball(scale=0.001), "unit is the metre"),
        (_mesh(*_soup(FACES[::2])), "no inside"),
        (_mesh(VERTICES * (1, 1, 1e-9)), "flat sheet"),
        (b"ply\nformat ascii 1.0\nelement vertex 9\nend_header\n1 2", "export"),
    ],
)
def test_bad_meshes_are_refused(tmp_path, content, words):
    path = tmp_path / "thing.ply"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        content.export(path)
    with pytest.raises(UserError, match=words) as caught:
        ObjectMesh.load(_entry(path))
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(("scale", "doubted"), [(0.05, True), (1, False), (20, True)])
def test_unusual_sizes_are_reported_and_used(tmp_path, caplog, scale, doubted):
    with caplog.at_level(logging.WARNING):
        mesh = ObjectMesh.load(_entry(_write(_ball(scale=scale), tmp_path / "thing.ply")))
    assert mesh.diameter == pytest.approx(0.22 * scale, rel=1e-3)
    assert ("check its unit" in caplog.text) == doubted


def test_an_open_mesh_is_reported_and_used(tmp_path, caplog):
    bowl = _mesh(faces=FACES[BALL.triangles_center[:, 2] < 0.08])
    with caplog.at_level(logging.WARNING):
        mesh = ObjectMesh.load(_entry(_write(bowl, tmp_path / "thing.ply")))
    assert not mesh.watertight
    assert "not watertight" in caplog.text and "thing.ply" in caplog.text
    assert 0.1 < mesh.radius < 0.2
    np.testing.assert_allclose(mesh.centre_of_mass, [0, 0, -0.015], atol=0.005)


@pytest.mark.parametrize("stray", [np.nan, 40.0])
def test_vertices_without_a_face_do_not_count(tmp_path, caplog, stray):
    ball = _mesh(np.concatenate([[[stray, 0, 0]], VERTICES]), FACES + 1)
    path = _write(ball, tmp_path / "thing.ply")
    contact = tmp_path / "thing.json"
    contact.write_text("[0, 1, 6]")
    with caplog.at_level(logging.WARNING):
        mesh = ObjectMesh.load(_entry(path, contact_vertices=contact))
    assert "left out 1 vertices that no face uses" in caplog.text
    assert mesh.watertight and mesh.diameter == pytest.approx(0.22, rel=1e-3)
    assert len(mesh.vertices) == len(VERTICES) == len(mesh.colours)
    np.testing.assert_array_equal(mesh.contact_vertices, [0, 5])
    contact.write_text("[0]")
    with pytest.raises(UserError, match="no face of the mesh uses any"):
        ObjectMesh.load(_entry(path, contact_vertices=contact))


def test_faces_without_area_are_left_out(tmp_path, caplog):
    ball = _mesh(faces=np.concatenate([FACES, [[0, 0, 1], [5, 7, 7]]]))
    with caplog.at_level(logging.WARNING):
        mesh = ObjectMesh.load(_entry(_write(ball, tmp_path / "thing.ply")))
    assert mesh.watertight and len(mesh.faces) == len(FACES)
    assert "left out 2 faces without area" in caplog.text


FAULTY = {
    "inside out": (VERTICES, FACES[:, ::-1]),
    "one face turned": (VERTICES, np.concatenate([FACES[:1, ::-1], FACES[1:]])),
    "one face missing": (VERTICES, np.delete(FACES, 11, axis=0)),
    "corners not joined": _soup(),
}


@pytest.mark.parametrize("fault", FAULTY)
def test_small_faults_are_repaired(tmp_path, fault):
    vertices, faces = FAULTY[fault]
    path = _write(_mesh(vertices, faces), tmp_path / "thing.ply")
    listed = [0, 1, 5]
    positions = vertices[listed]
    contact = tmp_path / "thing.json"
    contact.write_text(json.dumps(listed))
    mesh = ObjectMesh.load(_entry(path, contact_vertices=contact))
    repaired = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert mesh.watertight and repaired.is_winding_consistent
    assert repaired.volume == pytest.approx(BALL.volume, rel=1e-3)
    distance = np.linalg.norm(
        positions[:, None] - mesh.vertices[mesh.contact_vertices][None], axis=-1
    )
    assert distance.min(1).max() < 1e-6, "contact vertices follow the joined vertices"


@pytest.mark.parametrize("suffix", ["json", "npz"])
def test_a_list_of_another_mesh_is_refused(tmp_path, suffix):
    """A changed mesh is detected by its number of vertices and their coordinates."""
    stored = contact_list([3, 9], VERTICES)
    contact = tmp_path / f"thing.contact.{suffix}"
    if suffix == "json":
        contact.write_text(json.dumps(stored))
    else:
        np.savez(contact, **stored)
    entry = _entry(_write(BALL, tmp_path / "thing.ply"), contact_vertices=contact)
    np.testing.assert_array_equal(ObjectMesh.load(entry).contact_vertices, [3, 9])
    reordered = _mesh(VERTICES[::-1], len(VERTICES) - 1 - FACES)
    for other, words in ((_ball(2), "mesh_vertices 642.*has 162"), (reordered, "mesh_digest")):
        again = _entry(_write(other, tmp_path / "again.ply"), contact_vertices=contact)
        with pytest.raises(UserError, match=f"{words}.*mesh was changed.*choose") as caught:
            ObjectMesh.load(again)
        assert str(contact) in str(caught.value) and "again.ply" in str(caught.value)


def _npz(**arrays):
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("c.json", b"[1, 2, 100000]", "names vertex 100000"),
        ("c.json", b"[-1]", "names vertex -1"),
        ("c.json", b"[]", "not a list"),
        ("c.json", b'{"a": 1}', "not a list"),
        ("c.json", b"[0.5]", "not a list"),
        ("c.json", b"[[1], [2, 3]]", "not a list"),
        ("c.json", b"[1, 2", "not a JSON list"),
        ("c.json", b"[1, Infinity]", "not a list"),
        ("c.json", b'["a"]', "not a list"),
        ("c.npz", b"no archive", "not a readable .npz"),
        ("c.npz", _npz(contact_vertices=np.arange(9))[:-30], "not a readable .npz"),
        ("c.npz", _npz(), "not a readable .npz"),
        ("c.npz", _npz(contact_vertices=np.array(3)), "not a list"),
        ("c.pkl", pickle.dumps({1, (1, 2)}), "not a list"),
    ],
)
def test_bad_contact_lists_are_refused(tmp_path, name, data, words):
    mesh = _write(BALL, tmp_path / "thing.ply")
    contact = tmp_path / name
    contact.write_bytes(data)
    with pytest.raises(UserError, match=words) as caught:
        ObjectMesh.load(_entry(mesh, contact_vertices=contact))
    assert str(contact) in str(caught.value)


@pytest.mark.parametrize("kind", ["list", "array", "npz", "none"])
def test_contact_lists_of_every_kind(tmp_path, kind):
    mesh = _write(BALL, tmp_path / "thing.ply")
    path: Path | None = tmp_path / ("03.npz" if kind == "npz" else "03.pkl")
    if kind == "npz":
        np.savez(path, contact_vertices=np.array([9, 3, 3]))
    elif kind == "none":
        path = None
    else:
        ids = [9, 3, 3] if kind == "list" else np.array([9, 3, 3])
        path.write_bytes(pickle.dumps(ids, protocol=2))
    loaded = ObjectMesh.load(_entry(mesh, contact_vertices=path)).contact_vertices
    expected = np.arange(642) if kind == "none" else [3, 9]
    np.testing.assert_array_equal(loaded, expected)


def test_impossible_symmetry_names_the_object(tmp_path):
    mesh = _write(BALL, tmp_path / "thing.ply")
    flat = tuple(np.diag([2.0, 1, 1, 1]).ravel())
    with pytest.raises(UserError, match="object 'thing': symmetry"):
        ObjectMesh.load(_entry(mesh, symmetry=Symmetry(discrete=(flat,))))
