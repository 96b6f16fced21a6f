"""Meshes of public bug reports, and further cases of each kind."""

from __future__ import annotations

import json
import logging
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from intercap_core.entries import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.geometry.rigid.mesh import ObjectMesh
from tests.cases import open_case


def load(path: Path, **more) -> ObjectMesh:
    return ObjectMesh.load(ObjectEntry.model_validate({"name": "box", "mesh": path} | more))


def box(folder: Path, suffix: str, offset=(0.0, 0.0, 0.0)) -> Path:
    path = folder / f"box.{suffix}"
    mesh = trimesh.creation.box((0.3, 0.2, 0.4))
    mesh.apply_translation(offset)
    mesh.export(path)
    return path


def test_relative_indices_give_the_same_solid(tmp_path):
    project = open_case("b08", tmp_path)
    relative = load(project.path.parent / "box.obj")
    absolute = load(project.path.parent / "box_absolute.obj")
    np.testing.assert_allclose(relative.centre_of_mass, absolute.centre_of_mass)
    assert relative.watertight and len(relative.faces) == len(absolute.faces) == 24


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (" ", "\t"), ("\nv ", "\nv\t"), ("\nv", "\n  v"), ("\n#", "\ufeff#"), ("\nf", "\n\tf"),
        ("\nf", " # note\nf"), ("\nv", "#note\nv"), ("\nv ", "\nv \\\n"),
    ],
)  # fmt: skip
def test_spaces_and_comments_of_obj_are_read(tmp_path, before, after):
    path = box(tmp_path, "obj")
    (tmp_path / "contact.json").write_text("[5, 6]")
    plain = load(path, contact_vertices=tmp_path / "contact.json")
    path.write_text(("\n" + path.read_text()).replace(before, after))
    mesh = load(path, contact_vertices=tmp_path / "contact.json")
    np.testing.assert_array_equal(mesh.vertices, plain.vertices)
    np.testing.assert_array_equal(mesh.contact_vertices, plain.contact_vertices)


def test_a_vertex_with_two_numbers_is_refused(tmp_path):
    path = box(tmp_path, "obj")
    path.write_text(path.read_text() + "v 1 2\n")
    with pytest.raises(UserError, match="vertex has other than three"):
        load(path)


def test_relative_indices_before_the_first_vertex_are_refused(tmp_path):
    path = tmp_path / "box.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf -4 -2 -1\n")
    with pytest.raises(UserError, match="a face names vertex -4 of 3 above it"):
        load(path)


@pytest.mark.parametrize("face", ["0 1 2", "1 2/1/1 0/1/1", "1 2 0"])
def test_indices_from_0_are_refused(tmp_path, face):
    path = tmp_path / "box.obj"
    path.write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf {face}\n")
    with pytest.raises(UserError, match="a face names vertex 0, vertices of OBJ are counted from"):
        load(path)


def test_a_mask_of_contact_vertices_is_refused(tmp_path):
    (tmp_path / "contact.json").write_text("[0, 1, 1, 0, 0, 0, 0, 1]")
    with pytest.raises(UserError, match="is a mask of all 8 vertices; write the ids"):
        load(box(tmp_path, "obj"), contact_vertices=tmp_path / "contact.json")


def test_contact_vertices_have_the_numbers_of_an_obj_with_seams(tmp_path):
    project = open_case("b34", tmp_path)
    mesh = ObjectMesh.load(project.objects["box"])
    touched = mesh.vertices[mesh.contact_vertices]
    expected = {(x, 0.1, z) for x in (-0.15, 0.15) for z in (-0.2, 0.2)}
    assert {tuple(v) for v in touched.round(6).tolist()} == expected


def test_contact_vertices_have_the_numbers_of_a_ply_with_texture(tmp_path):
    corners = trimesh.creation.box((0.3, 0.2, 0.4))
    lines = ["ply", "format ascii 1.0", f"element vertex {len(corners.vertices)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"element face {len(corners.faces)}", "property list uchar int vertex_indices"]
    lines += ["property list uchar float texcoord", "end_header"]
    lines += [" ".join(map(str, v)) for v in corners.vertices]
    lines += [
        " ".join(map(str, (3, *face, 6, n / 20, 0, 0, n / 20, 1, 1)))
        for n, face in enumerate(corners.faces)
    ]
    (tmp_path / "box.ply").write_text("\n".join(lines) + "\n")
    (tmp_path / "contact.json").write_text("[5, 6]")
    mesh = load(tmp_path / "box.ply", contact_vertices=tmp_path / "contact.json")
    touched = np.unique(mesh.vertices[mesh.contact_vertices].round(5), axis=0)
    np.testing.assert_allclose(touched, np.unique(corners.vertices[[5, 6]], axis=0), atol=1e-5)


def test_a_list_of_contact_vertices_of_an_stl_is_doubtful(tmp_path, caplog):
    (tmp_path / "contact.json").write_text("[5, 6]")
    load(box(tmp_path, "stl"), contact_vertices=tmp_path / "contact.json")
    assert "STL numbers no vertices" in caplog.text


def test_draco_is_named_and_nothing_is_printed(tmp_path, caplog, capfd):
    project = open_case("b23", tmp_path)
    with pytest.raises(UserError, match="requires KHR_draco_mesh_compression, which is not read"):
        ObjectMesh.load(project.objects["box"])
    assert not caplog.records and capfd.readouterr() == ("", "")
    assert not logging.getLogger("trimesh").disabled


@pytest.mark.parametrize(
    ("names", "unread"),
    [
        (["EXT_meshopt_compression"], "EXT_meshopt_compression"),
        (["KHR_mesh_quantization"], "KHR_mesh_quantization"),
        (["EXT_mesh_gpu_instancing", "KHR_materials_unlit"], "EXT_mesh_gpu_instancing"),
        (["KHR_texture_transform", "KHR_materials_unlit"], None),
    ],
)
def test_required_extensions_of_gltf(tmp_path, names, unread):
    path = box(tmp_path, "glb")
    content = path.read_bytes()
    (length,) = struct.unpack("<I", content[12:16])
    head = json.loads(content[20 : 20 + length]) | {"extensionsRequired": names}
    text = json.dumps(head).encode()
    text += b" " * (-len(text) % 4)
    body = content[20 + length :]
    size = 20 + len(text) + len(body)
    path.write_bytes(
        struct.pack("<4sII", b"glTF", 2, size) + struct.pack("<I4s", len(text), b"JSON") + text
        + body
    )  # fmt: skip
    if unread is None:
        np.testing.assert_allclose(np.ptp(load(path).vertices, axis=0), (0.3, 0.2, 0.4), atol=1e-6)
        return
    with pytest.raises(UserError, match=f"requires {unread}, which is not read"):
        load(path)


def test_nodes_of_gltf_place_and_scale_the_mesh(tmp_path):
    scene = trimesh.Scene()
    place = trimesh.transformations.translation_matrix((0, 0, 0.5)) @ np.diag((0.5, 0.5, 0.5, 1))
    scene.add_geometry(trimesh.creation.box((0.3, 0.2, 0.4)), transform=place)
    scene.export(tmp_path / "box.glb")
    mesh = load(tmp_path / "box.glb")
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), (0.15, 0.1, 0.2), atol=1e-6)
    np.testing.assert_allclose(mesh.centre_of_mass, (0, 0, 0.5), atol=1e-6)


def test_a_mesh_far_from_its_origin_is_noted(tmp_path, caplog):
    load(box(tmp_path, "ply"))
    assert not caplog.records
    load(box(tmp_path, "ply", (10, 0, 0)))
    assert "lies up to 10.1 m from its origin" in caplog.text


@pytest.mark.parametrize(
    "symmetry",
    [
        {"continuous": [{"axis": [0, 0, 1], "offset": [49, 0, 0]}]},
        {"continuous": [{"axis": [0, 0, 1], "offset": [0.3, 0, 0]}]},
        {"discrete": [[-1, 0, 0, 300, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]},
    ],
)
def test_a_symmetry_that_moves_the_centre_is_refused(tmp_path, symmetry):
    with pytest.raises(UserError, match="its symmetry moves the centre of"):
        load(box(tmp_path, "ply"), symmetry=symmetry)


def test_a_symmetry_about_an_axis_through_the_mesh_is_used(tmp_path):
    load(
        box(tmp_path, "ply", (1, 0, 0)),
        symmetry={"continuous": [{"axis": [0, 0, 1], "offset": [1, 0, 0]}]},
    )
