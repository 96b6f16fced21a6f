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
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.mesh import ObjectMesh


def _entry(path, **values):
    return ObjectEntry(name="thing", mesh=path, **values)


def _write(mesh, path: Path) -> Path:
    mesh.export(path)
    return path


def _ball(subdivisions=3):
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.11)


def _scaled(factor):
    ball = _ball()
    ball.apply_scale(factor)
    return ball


def _changed(vertices=None, faces=None):
    ball = _ball()
    if vertices is not None:
        ball.vertices = vertices(ball.vertices.copy())
    faces = ball.faces if faces is None else faces(ball.faces.copy())
    return trimesh.Trimesh(ball.vertices, faces, process=False)


def _half_open():
    ball = _ball()
    soup = ball.vertices[ball.faces[::2]].reshape(-1, 3)
    return trimesh.Trimesh(soup, np.arange(len(soup)).reshape(-1, 3), process=False)


def _not_a_number(vertices):
    vertices[7, 1] = np.nan
    return vertices


NO_VERTICES = (
    b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\n"
    b"property float z\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n"
)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "no such mesh"),
        (trimesh.PointCloud(_ball().vertices), "0 faces"),
        (_changed(vertices=_not_a_number), "vertex 7 is not a number"),
        (_scaled(1000), r"220 m long.*millimetres \(0\.001\)"),
        (_scaled(100), r"22 m long.*centimetres \(0\.01\)"),
        (_changed(faces=lambda faces: faces[:, [0, 1, 1]]), "encloses"),
        (b"", "not a readable mesh|0 faces"),
        (NO_VERTICES, "0 faces|not a readable mesh"),
        (_scaled(0.001), "unit is the metre"),
        (_half_open(), "no inside"),
        (_changed(vertices=lambda vertices: vertices * (1, 1, 1e-9)), "flat sheet"),
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
    ball = _scaled(scale)
    with caplog.at_level(logging.WARNING):
        mesh = ObjectMesh.load(_entry(_write(ball, tmp_path / "thing.ply")))
    assert mesh.diameter == pytest.approx(0.22 * scale, rel=1e-3)
    assert ("check its unit" in caplog.text) == doubted


def test_an_open_mesh_is_reported_and_used(tmp_path, caplog):
    """A box without its lid: what lies deep inside is inside, what lies outside is not."""
    box = trimesh.creation.box((0.4, 0.4, 0.4)).subdivide().subdivide()
    lid = box.triangles_center[:, 2] > 0.199
    box = trimesh.Trimesh(box.vertices, box.faces[~lid], process=True)
    with caplog.at_level(logging.WARNING):
        mesh = ObjectMesh.load(_entry(_write(box, tmp_path / "thing.ply")))
    assert not mesh.watertight and "not watertight" in caplog.text
    assert "thing.ply" in caplog.text
    field = DistanceField(mesh.vertices, mesh.faces, watertight=mesh.watertight)
    rng = np.random.default_rng(0)
    inner = rng.uniform(-0.19, 0.19, (500, 3)) - (0, 0, 0.1) * rng.random((500, 1))
    inner[:, 2] = inner[:, 2].clip(-0.19, -0.02)
    outer = inner + np.array([0.5, 0.1, 0])
    assert field.inside(inner).mean() > 0.95 and not field.inside(outer).any()
    assert 0 < mesh.radius < 0.5 and np.isfinite(mesh.centre_of_mass).all()


@pytest.mark.parametrize("stray", [np.nan, 40.0])
def test_vertices_without_a_face_do_not_count(tmp_path, caplog, stray):
    ball = _ball()
    vertices = np.concatenate([[[stray, 0, 0]], ball.vertices])
    path = _write(trimesh.Trimesh(vertices, ball.faces + 1, process=False), tmp_path / "thing.ply")
    contact = tmp_path / "thing.json"
    contact.write_text("[0, 1, 6]")
    with caplog.at_level(logging.WARNING):
        mesh = ObjectMesh.load(_entry(path, contact_vertices=contact))
    assert "left out 1 vertices that no face uses" in caplog.text
    assert mesh.watertight and mesh.diameter == pytest.approx(0.22, rel=1e-3)
    assert len(mesh.vertices) == len(ball.vertices) == len(mesh.colours)
    np.testing.assert_array_equal(mesh.contact_vertices, [0, 5])
    contact.write_text("[0]")
    with pytest.raises(UserError, match="no face of the mesh uses any"):
        ObjectMesh.load(_entry(path, contact_vertices=contact))


def test_faces_without_area_are_left_out(tmp_path, caplog):
    ball = _changed(faces=lambda faces: np.concatenate([faces, [[0, 0, 1], [5, 7, 7]]]))
    with caplog.at_level(logging.WARNING):
        mesh = ObjectMesh.load(_entry(_write(ball, tmp_path / "thing.ply")))
    assert mesh.watertight and len(mesh.faces) == len(_ball().faces)
    assert "left out 2 faces without area" in caplog.text


def _inside_out(ball):
    ball.invert()


def _one_face_turned(ball):
    ball.faces[3] = ball.faces[3][::-1]


def _one_face_missing(ball):
    ball.update_faces(np.arange(len(ball.faces)) != 11)


def _corners_not_joined(ball):
    soup = ball.vertices[ball.faces].reshape(-1, 3)
    ball.vertices, ball.faces = soup, np.arange(len(soup)).reshape(-1, 3)


@pytest.mark.parametrize(
    "harm", [_inside_out, _one_face_turned, _one_face_missing, _corners_not_joined]
)
def test_small_faults_are_repaired(tmp_path, caplog, harm):
    ball = _ball()
    volume = ball.volume
    ball = trimesh.Trimesh(ball.vertices.copy(), ball.faces.copy(), process=False)
    harm(ball)
    path = _write(ball, tmp_path / "thing.ply")
    listed = [0, 1, 5]
    positions = np.asarray(ball.vertices)[listed]
    contact = tmp_path / "thing.json"
    contact.write_text(json.dumps(listed))
    with caplog.at_level(logging.WARNING):
        mesh = ObjectMesh.load(_entry(path, contact_vertices=contact))
    repaired = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert mesh.watertight and repaired.is_winding_consistent
    assert repaired.volume == pytest.approx(volume, rel=1e-3)
    distance = np.linalg.norm(
        positions[:, None] - mesh.vertices[mesh.contact_vertices][None], axis=-1
    )
    assert distance.min(1).max() < 1e-6, "contact vertices follow the joined vertices"


@pytest.mark.parametrize("suffix", ["json", "npz"])
def test_a_list_of_another_mesh_is_refused(tmp_path, suffix):
    """A changed mesh is detected by its number of vertices and their coordinates."""
    ball = _ball()
    stored = contact_list([3, 9], ball.vertices)
    contact = tmp_path / f"thing.contact.{suffix}"
    if suffix == "json":
        contact.write_text(json.dumps(stored))
    else:
        np.savez(contact, **stored)
    entry = _entry(_write(ball, tmp_path / "thing.ply"), contact_vertices=contact)
    np.testing.assert_array_equal(ObjectMesh.load(entry).contact_vertices, [3, 9])
    reordered = trimesh.Trimesh(
        ball.vertices[::-1], len(ball.vertices) - 1 - ball.faces, process=False
    )
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
        ("c.json", b"", "not a JSON list"),
        ("c.json", b"[1, Infinity]", "not a list"),
        ("c.json", b'["a"]', "not a list"),
        ("c.npz", b"no archive", "not a readable .npz"),
        ("c.npz", _npz(contact_vertices=np.arange(9))[:-30], "not a readable .npz"),
        ("c.npz", _npz(), "not a readable .npz"),
        ("c.npz", _npz(contact_vertices=np.array(["a"])), "not a list"),
        ("c.npz", _npz(contact_vertices=np.array(3)), "not a list"),
        ("c.pkl", pickle.dumps({"a": 1}), "not a list"),
        ("c.pkl", pickle.dumps({1, (1, 2)}), "not a list"),
        ("c.pkl", pickle.dumps(3), "not a list"),
    ],
)
def test_bad_contact_lists_are_refused(tmp_path, name, data, words):
    mesh = _write(_ball(), tmp_path / "thing.ply")
    contact = tmp_path / name
    contact.write_bytes(data)
    with pytest.raises(UserError, match=words) as caught:
        ObjectMesh.load(_entry(mesh, contact_vertices=contact))
    assert str(contact) in str(caught.value)


@pytest.mark.parametrize("kind", ["list", "array", "npz", "none"])
def test_contact_lists_of_every_kind(tmp_path, kind):
    mesh = _write(_ball(), tmp_path / "thing.ply")
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
    mesh = _write(_ball(), tmp_path / "thing.ply")
    flat = tuple(np.diag([2.0, 1, 1, 1]).ravel())
    with pytest.raises(UserError, match="object 'thing': symmetry"):
        ObjectMesh.load(_entry(mesh, symmetry=Symmetry(discrete=(flat,))))
