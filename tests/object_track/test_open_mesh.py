"""A mesh that is not closed is fitted like the closed object that the cameras see."""

from __future__ import annotations

import numpy as np
import trimesh

from intercap_core.config import ObjectEntry
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.fit import fit_pose
from intercap_core.object_track.view import View, ViewGeometry
from tests.geometry.rigid.conftest import catalogue
from tests.helpers.object_capture import ObjectCapture


def open_below(mesh: ObjectMesh, path) -> ObjectMesh:
    """The mesh without the faces of its lower end, through the loader."""
    below = mesh.vertices[mesh.faces].mean(1)[:, 2] < mesh.vertices[:, 2].min() + 0.03
    trimesh.Trimesh(mesh.vertices, mesh.faces[~below], process=False).export(path)
    return ObjectMesh.load(ObjectEntry(name="suitcase", mesh=path))


def test_a_mesh_with_a_hole_is_fitted(tmp_path):
    closed = ObjectMesh.load(catalogue()["suitcase"])
    opened = open_below(closed, tmp_path / "open.ply").simplified(600)
    assert closed.watertight and not opened.watertight
    capture = ObjectCapture.make(closed.simplified(600), 2)
    views = []
    for c, camera in enumerate(capture.rig):
        depth, person, candidates = capture.image(0, c)
        geometry = ViewGeometry.for_object(
            camera, 2 * closed.radius, time_offset_s=capture.time_offset[c]
        )
        views.append(View.build(geometry, depth, person, candidates))
    truth = capture.poses[0]
    start = truth.copy()
    start[:3, 3] += [0.02, -0.02, 0.02]
    fit = fit_pose(
        opened, views, start, prior=None, min_overlap=0.3, background_term=True,
        labels=("suitcase",),
    )  # fmt: skip
    assert np.linalg.norm(fit.pose[:3, 3] - truth[:3, 3]) < 0.01
    assert closed.symmetry.rotation_error_deg(fit.pose[:3, :3], truth[:3, :3]) < 2
