"""Holes of meshes are found, closed if they are small, and refused otherwise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from intercap_core.entries import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.geometry.rigid.closing import close_mesh, find_holes
from intercap_core.geometry.rigid.mesh import ObjectMesh


def ball_without(*faces: int) -> trimesh.Trimesh:
    ball = trimesh.creation.icosphere(3, 0.1)
    return trimesh.Trimesh(ball.vertices, np.delete(ball.faces, faces, axis=0), process=False)


def around(vertex: int) -> list[int]:
    """The faces around a vertex of the ball: taken out, they leave one flat hole."""
    faces = trimesh.creation.icosphere(3, 0.1).faces
    return np.flatnonzero((faces == vertex).any(1)).tolist()


def lidless_box() -> trimesh.Trimesh:
    box = trimesh.creation.box((0.2, 0.3, 0.4))
    return trimesh.Trimesh(box.vertices, box.faces[box.face_normals[:, 2] < 0.5], process=False)


def loose(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Each face with vertices of its own, as STL files have them."""
    triangles = mesh.vertices[mesh.faces].reshape(-1, 3)
    return trimesh.Trimesh(triangles, np.arange(len(triangles)).reshape(-1, 3), process=False)


def turned(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    faces = mesh.faces.copy()
    faces[::3] = faces[::3, ::-1]
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def touching() -> list[int]:
    """Every other face around a vertex: holes that meet in it."""
    return around(5)[::2]


@pytest.mark.parametrize(
    ("mesh", "holes"),
    [
        (ball_without(*around(5)), 1),
        (ball_without(*around(5), *around(100)), 2),
        (ball_without(*touching()), None),
        (loose(ball_without(*around(5))), 1),
        (turned(ball_without(*around(5))), 1),
        (ball_without(*range(30)), None),
    ],
)
def test_small_holes_are_closed(tmp_path: Path, mesh: trimesh.Trimesh, holes: int | None) -> None:
    source, output = tmp_path / "open.ply", tmp_path / "closed.ply"
    mesh.export(source)
    before = source.read_bytes()
    done = close_mesh(source, output, widest_m=0.15, share=0.1)
    assert done.watertight and not done.strays
    assert holes is None or len(done.closed) == holes
    closed = ObjectMesh.load(ObjectEntry(name="ball", mesh=output))
    assert closed.watertight
    volume = trimesh.Trimesh(closed.vertices, closed.faces).volume
    assert volume == pytest.approx(trimesh.creation.icosphere(3, 0.1).volume, rel=0.05)
    # vertices of the file keep their numbers and places
    written = trimesh.load(output, process=False)
    np.testing.assert_allclose(written.vertices[: len(mesh.vertices)], mesh.vertices, atol=1e-7)
    assert source.read_bytes() == before


def test_a_flat_cover_restores_a_flat_wall(tmp_path: Path) -> None:
    lidless_box().export(tmp_path / "box.ply")
    done = close_mesh(tmp_path / "box.ply", tmp_path / "whole.ply", widest_m=0.4, share=0.1)
    (hole,) = done.closed
    assert hole.width_m == pytest.approx(np.hypot(0.2, 0.3))
    assert hole.bulge_m == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(hole.middle, [0, 0, 0.2], atol=1e-7)
    whole = trimesh.load(tmp_path / "whole.ply")
    assert whole.volume == pytest.approx(0.2 * 0.3 * 0.4, rel=1e-6)


@pytest.mark.parametrize(
    ("make", "output", "says"),
    [
        (lambda path: lidless_box().export(path), "out.ply",
         "1 holes are wider than 40.0 mm (the object is 400 mm long): 4 edges, 360.6 mm wide"),
        (lambda path: ball_without().export(path), "out.ply", "has no hole to close"),
        (lambda path: ball_without(3).export(path), "mesh.ply", "exists, and is not written over"),
        (lambda path: ball_without(3).export(path), "out.stl", "a name that ends in .ply or .obj"),
        (lambda path: path.write_text("no mesh"), "out.ply", "mesh.ply: "),
        (lambda path: None, "out.ply", "there is no such mesh"),
    ],
)  # fmt: skip
def test_unsuitable_meshes_are_refused(tmp_path: Path, make, output: str, says: str) -> None:
    source = tmp_path / "mesh.ply"
    make(source)
    files = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(UserError) as caught:
        close_mesh(source, tmp_path / output, widest_m=None, share=0.1)
    assert says in str(caught.value)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == files  # nothing is left


def test_edges_of_three_faces_are_no_hole() -> None:
    ball = trimesh.creation.icosphere(1, 0.1)
    fin = np.array([[*ball.faces[0][:2], len(ball.vertices)]])
    vertices = np.concatenate([ball.vertices, [[0, 0, 0.3]]])
    holes, strays = find_holes(vertices, np.concatenate([ball.faces, fin]))
    assert not holes and strays == 2
