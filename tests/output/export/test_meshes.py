"""Meshes by frame, read back by trimesh and open3d."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from intercap_core import artefacts
from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.rigid.open3d_core import o3d
from intercap_core.output.export import meshes
from intercap_core.output.export.motion import read_motion
from intercap_core.output.export.silhouettes import Scenes
from intercap_core.schemas import JOINT
from tests.helpers import exported
from tests.helpers import fitted_capture as fitted


def _by_open3d(path: Path) -> tuple[np.ndarray, np.ndarray]:
    mesh = o3d.io.read_triangle_mesh(str(path))
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles)


def _by_trimesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.load(path, process=False, maintain_order=True)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


@pytest.mark.parametrize("read", [_by_open3d, _by_trimesh])
@pytest.mark.parametrize("kind", ["ply", "obj"])
def test_meshes_are_those_of_the_joint_result(
    kind: str, read, lively: fitted.Capture, bodies, zup_from_master, upright: Path, in_camera: Path
) -> None:
    """As ply in the z-up frame, as obj in the camera's."""
    out, place = (upright, zup_from_master) if kind == "ply" else (in_camera, np.eye(4))
    with artefacts.read(lively.paths["joint"], JOINT) as joint:
        turned = lively.mesh.vertices @ joint["rotation"].transpose(0, 2, 1)
        objects = turned + joint["translation"][:, None]
    names = sorted(path.name for path in (out / "meshes" / "Mesh").iterdir())
    kept = (0, 2)
    ends = (f"_second.{kind}", f"_second_obj.{kind}")
    assert names == sorted(f"{t:05d}{end}" for t in kept for end in ends)
    for t in kept:
        for points, faces, end in (
            (bodies[t].astype(float), lively.model.faces.numpy(), ends[0]),
            (objects[t], lively.mesh.faces, ends[1]),
        ):
            vertices, triangles = read(out / "meshes" / "Mesh" / f"{t:05d}{end}")
            placed = apply(place, points)
            assert np.abs(vertices[triangles] - placed[faces]).max() < 2e-6
            if (kind, read) != ("obj", _by_open3d):  # which numbers an obj's vertices anew
                assert np.abs(vertices - placed).max() < 2e-6
                np.testing.assert_array_equal(triangles, faces)
    head = (out / "meshes" / "Mesh" / names[0]).read_bytes()[:600].decode("ascii", "replace")
    header = "up: z (" if kind == "ply" else "frame: master colour camera: x right, y down"
    assert header in head and "units: metres" in head
    assert f"sequence {exported.NAME}, frame 0" in head


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


@pytest.mark.parametrize("with_object", [True, False])
def test_frames_without_an_object_pose_have_no_object_mesh(
    with_object: bool, capture: fitted.Capture, bodies, tmp_path: Path
) -> None:
    motion = read_motion(capture.paths["joint"], 15.0, fitted.BODY_MODELS, "neutral")
    motion.translation[1] = np.nan
    scenes = Scenes(
        motion, capture.rig, capture.mesh if with_object else None, np.zeros((4, 3), int),
        np.arange(4) / 15, np.zeros(3), bodies,
    )  # fmt: skip
    meshes.write(tmp_path, exported.content(scenes, capture.object_))
    objects = [f"{t:05d}_second_obj.ply" for t in (0, 2, 3) if with_object]
    expected = sorted([*(f"{t:05d}_second.ply" for t in range(4)), *objects])
    assert sorted(path.name for path in (tmp_path / "Mesh").iterdir()) == expected
    first = trimesh.load(tmp_path / "Mesh" / expected[0], process=False)
    assert "contact" not in first.metadata["_ply_raw"]["vertex"]["data"].dtype.names
