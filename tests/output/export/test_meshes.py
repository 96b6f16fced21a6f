"""Meshes by frame, read back by trimesh and open3d."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
import trimesh

from intercap_core import artefacts
from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.output.export import meshes
from intercap_core.output.export.motion import read_motion
from intercap_core.schemas import JOINT
from tests.helpers import exported
from tests.helpers import fitted_capture as fitted


@pytest.fixture(scope="module")
def expected(lively: fitted.Capture) -> tuple[np.ndarray, np.ndarray]:
    """Vertices of body and object (T, V, 3), master frame."""
    with artefacts.read(lively.paths["joint"], JOINT) as joint:
        bodies, _ = exported.posed(lively.model, joint)
        turned = lively.mesh.vertices @ joint["rotation"].transpose(0, 2, 1)
        return bodies.astype(float), turned + joint["translation"][:, None]


def _by_open3d(path: Path) -> tuple[np.ndarray, np.ndarray]:
    mesh = o3d.io.read_triangle_mesh(str(path))
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles)


def _by_trimesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.load(path, process=False, maintain_order=True)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


@pytest.mark.parametrize("read", [_by_open3d, _by_trimesh])
@pytest.mark.parametrize("kind", ["ply", "obj"])
@pytest.mark.parametrize("frame", ["z-up", "camera"])
def test_meshes_are_those_of_the_joint_result(
    kind: str, frame: str, read, lively: fitted.Capture, expected, zup_from_master, tmp_path: Path
) -> None:
    out = exported.run(
        lively, tmp_path / "out", formats=("meshes",), mesh_format=kind, frame=frame, mesh_every=2
    )
    names = sorted(path.name for path in (out / "meshes" / "Mesh").iterdir())
    kept = (0, 2, 4)
    ends = (f"_second.{kind}", f"_second_obj.{kind}")
    assert names == sorted(f"{t:05d}{end}" for t in kept for end in ends)
    place = zup_from_master if frame == "z-up" else np.eye(4)
    for t in kept:
        for points, faces, end in (
            (expected[0][t], lively.model.faces.numpy(), ends[0]),
            (expected[1][t], lively.mesh.faces, ends[1]),
        ):
            vertices, triangles = read(out / "meshes" / "Mesh" / f"{t:05d}{end}")
            placed = apply(place, points)
            assert np.abs(vertices[triangles] - placed[faces]).max() < 2e-6
            if (kind, read) != ("obj", _by_open3d):  # which numbers an obj's vertices anew
                assert np.abs(vertices - placed).max() < 2e-6
                np.testing.assert_array_equal(triangles, faces)
    head = (out / "meshes" / "Mesh" / names[0]).read_bytes()[:600].decode("ascii", "replace")
    header = "up: z (" if frame == "z-up" else "frame: master colour camera: x right, y down"
    assert header in head and "units: metres" in head and "sequence cap, frame 0" in head


def test_ply_files_mark_touching_vertices(everything: Path) -> None:
    with np.load(everything / "contact" / "contact_vertices.npz") as content:
        for name, end in (("body", "second"), ("object", "second_obj")):
            offsets, vertices = (content[f"{name}_contact_{k}"] for k in ("offsets", "vertices"))
            for t in range(len(offsets) - 1):
                path = everything / "meshes" / "Mesh" / f"{t:05d}_{end}.ply"
                mesh = trimesh.load(path, process=False)
                touching = mesh.metadata["_ply_raw"]["vertex"]["data"]["contact"].ravel()
                assert set(np.unique(touching)) == {0, 1}
                marked = np.flatnonzero(touching)
                np.testing.assert_array_equal(marked, vertices[offsets[t] : offsets[t + 1]])


def test_meshes_are_written_only_on_request(capture: fitted.Capture, tmp_path: Path) -> None:
    out = exported.run(capture, tmp_path / "out")
    assert not (out / "meshes").exists()
    assert "meshes" not in json.loads((out / "export.json").read_text())["formats"]


def _write(capture: fitted.Capture, bodies: np.ndarray, mesh: ObjectMesh | None, out: Path) -> list:
    """Write meshes of a motion whose object has no pose in frame 1; return the sorted files."""
    motion = read_motion(capture.paths["joint"], 15.0, fitted.BODY_MODELS, "neutral")
    motion.translation[1] = np.nan
    about = exported.plain_about(motion)
    meshes.write(out, motion, bodies, mesh, about, kind="ply", every=1)
    return sorted((out / "Mesh").iterdir())


def test_without_an_object_only_bodies_are_written(
    capture: fitted.Capture, expected, tmp_path: Path
) -> None:
    files = _write(capture, expected[0], None, tmp_path / "out")
    assert [path.name for path in files] == [f"{t:05d}_second.ply" for t in range(5)]
    mesh = trimesh.load(files[0], process=False)
    assert "contact" not in mesh.metadata["_ply_raw"]["vertex"]["data"].dtype.names


def test_frames_without_an_object_pose_have_no_object_mesh(
    capture: fitted.Capture, expected, tmp_path: Path
) -> None:
    files = _write(capture, expected[0], capture.mesh, tmp_path / "out")
    objects = {path.name for path in files if path.stem.endswith("_obj")}
    assert objects == {f"{t:05d}_second_obj.ply" for t in (0, 2, 3, 4)}
