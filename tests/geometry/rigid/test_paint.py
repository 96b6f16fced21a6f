"""Colours that a mesh file brings."""

import numpy as np
import pytest
import trimesh
from PIL import Image

from intercap_core.entries import ObjectEntry
from intercap_core.geometry.rigid.mesh import ObjectMesh, Paint
from tests.geometry.rigid.conftest import catalogue


def any_mesh() -> ObjectMesh:
    return ObjectMesh.load(catalogue()["toolbox"])


def test_colours_of_vertices(tmp_path):
    box = trimesh.creation.box((0.2, 0.2, 0.2)).subdivide().subdivide()
    red = box.vertices[:, 0] > 0
    colours = np.where(red[:, None], (200, 20, 20, 255), (20, 20, 200, 255)).astype(np.uint8)
    box.visual = trimesh.visual.ColorVisuals(box, vertex_colors=colours)
    box.export(tmp_path / "box.ply")
    mesh = ObjectMesh.load(ObjectEntry(name="box", mesh=tmp_path / "box.ply"))
    paint = Paint.load(tmp_path / "box.ply", mesh)
    assert paint is not None and np.linalg.norm(paint.normals, axis=1) == pytest.approx(1)
    right, left = paint.points[:, 0] > 0.06, paint.points[:, 0] < -0.06
    assert (paint.colours[right] == (200, 20, 20)).all()
    assert (paint.colours[left] == (20, 20, 200)).all()
    top = paint.points[:, 2] > 0.099
    assert (paint.normals[top] @ (0, 0, 1) > 0.9).mean() > 0.95
    # of a file that is wound inward the loader turns the faces
    box.invert()
    box.export(tmp_path / "inward.ply")
    inward = ObjectMesh.load(ObjectEntry(name="box", mesh=tmp_path / "inward.ply"))
    paint = Paint.load(tmp_path / "inward.ply", inward)
    top = paint.points[:, 2] > 0.099
    assert (paint.normals[top] @ (0, 0, 1) > 0.9).mean() > 0.95


def test_a_texture_is_finer_than_its_mesh(tmp_path):
    """Two triangles, of which a texture of four fields shows more than their corners do."""
    fields = np.zeros((64, 64, 3), np.uint8)
    fields[:32, :32], fields[:32, 32:] = (250, 0, 0), (0, 250, 0)
    fields[32:, :32], fields[32:, 32:] = (0, 0, 250), (250, 250, 0)
    Image.fromarray(fields).save(tmp_path / "fields.png")
    (tmp_path / "sheet.mtl").write_text("newmtl a\nmap_Kd fields.png\n")
    (tmp_path / "sheet.obj").write_text(
        "mtllib sheet.mtl\nusemtl a\n"
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
        "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    )
    paint = Paint.load(tmp_path / "sheet.obj", any_mesh())
    assert paint is not None
    x, y = paint.points[:, 0], paint.points[:, 1]
    corner = (x < 0.45) & (y > 0.55)  # the first rows of an image are at the top
    assert (paint.colours[corner] == (250, 0, 0)).all()
    assert (paint.colours[(x > 0.55) & (y < 0.45)] == (250, 250, 0)).all()


def test_one_colour_counts_as_none(tmp_path):
    box = trimesh.creation.box((0.2, 0.2, 0.2))
    box.export(tmp_path / "bare.obj", include_normals=False)
    assert Paint.load(tmp_path / "bare.obj", any_mesh()) is None
    box.visual = trimesh.visual.ColorVisuals(box, vertex_colors=[90, 90, 90, 255])
    box.export(tmp_path / "grey.ply")
    assert Paint.load(tmp_path / "grey.ply", any_mesh()) is None


@pytest.mark.parametrize("texture", ["missing.png", "notes.txt"])
def test_an_unreadable_texture_counts_as_none(tmp_path, texture):
    box = trimesh.creation.box((0.2, 0.2, 0.2))
    (tmp_path / "notes.txt").write_text("no image")
    (tmp_path / "box.mtl").write_text(f"newmtl a\nmap_Kd {texture}\n")
    rows = [f"v {x} {y} {z}" for x, y, z in box.vertices] + ["vt 0 0"]
    rows += [f"f {a + 1}/1 {b + 1}/1 {c + 1}/1" for a, b, c in box.faces]
    (tmp_path / "box.obj").write_text("\n".join(["mtllib box.mtl", "usemtl a", *rows]) + "\n")
    mesh = ObjectMesh.load(ObjectEntry(name="box", mesh=tmp_path / "box.obj"))
    assert len(mesh.faces) == 12 and not np.ptp(mesh.colours, axis=0).any()
    assert Paint.load(tmp_path / "box.obj", mesh) is None
