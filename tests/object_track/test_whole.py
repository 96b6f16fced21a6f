"""Turns that a mesh hardly shows, and what symmetry leaves unseen over a whole track."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from intercap_core.config import ObjectTrackSettings, Symmetry
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.symmetry import SymmetryGroup
from intercap_core.object_track.given_poses import GivenPose
from intercap_core.object_track.tracker import Tracker
from intercap_core.object_track.turns import near_turns
from intercap_core.object_track.view import View, ViewGeometry
from tests.geometry.rigid.conftest import catalogue
from tests.helpers.object_capture import ObjectCapture


def mesh_of(shape: trimesh.Trimesh, symmetry: SymmetryGroup | None = None) -> ObjectMesh:
    return ObjectMesh(
        name="thing",
        vertices=np.asarray(shape.vertices, float),
        faces=np.asarray(shape.faces, np.int32),
        contact_vertices=np.arange(len(shape.vertices)),
        symmetry=symmetry or SymmetryGroup.none(),
        colours=np.full((len(shape.vertices), 3), 128, np.uint8),
        watertight=bool(shape.is_watertight),
    )


def mug() -> ObjectMesh:
    body = trimesh.creation.cylinder(radius=0.04, height=0.1, sections=32)
    handle = trimesh.creation.box((0.03, 0.012, 0.06))
    handle.apply_translation((0.053, 0, 0))
    return mesh_of(trimesh.util.concatenate([body, handle]))


def turns_of(mesh: ObjectMesh) -> np.ndarray:
    field = DistanceField(mesh.vertices, mesh.faces, watertight=mesh.watertight, threads=1)
    return near_turns(mesh, field)


def angles(turns: np.ndarray) -> np.ndarray:
    return np.degrees(Rotation.from_matrix(turns[:, :3, :3]).magnitude())


def test_a_mug_may_be_turned_about_its_axis() -> None:
    turns = turns_of(mug())
    upright = turns[turns[:, 2, 2] > 0.99]
    assert np.allclose(turns[0], np.eye(4))
    assert len(upright) >= 13
    # about the middle of the cup, not of the box around cup and handle
    assert np.abs(upright[:, :3, 3]).max() < 0.004


def test_a_box_with_a_small_mark_may_be_turned_about() -> None:
    box = trimesh.creation.box((0.4, 0.2, 0.6)).subdivide().subdivide()
    mark = trimesh.creation.box((0.02, 0.02, 0.02))
    mark.apply_translation((0.1, 0.11, 0.2))
    turns = turns_of(mesh_of(trimesh.util.concatenate([box, mark])))
    assert len(turns) == 4
    assert angles(turns) == pytest.approx([0, 180, 180, 180], abs=1e-6)


def test_an_object_without_near_symmetry_has_no_turns() -> None:
    corner = trimesh.creation.box((0.5, 0.1, 0.1))
    other = trimesh.creation.box((0.1, 0.4, 0.1))
    third = trimesh.creation.box((0.1, 0.1, 0.3))
    other.apply_translation((0.2, 0.2, 0))
    third.apply_translation((-0.2, 0, 0.15))
    assert len(turns_of(mesh_of(trimesh.util.concatenate([corner, other, third])))) == 1


def test_what_the_symmetry_group_holds_is_no_turn() -> None:
    box = trimesh.creation.box((0.4, 0.2, 0.6))
    half = np.diag([-1.0, -1.0, 1.0, 1.0]).ravel().tolist()
    group = SymmetryGroup.from_settings(Symmetry(discrete=[half]))
    assert len(turns_of(mesh_of(box, group))) == 2


class Lifted(ObjectCapture):
    """At rest for the first six frames, then on its way at 60 cm a second."""

    def pose_at(self, t: float) -> np.ndarray:
        return super().pose_at(max(0.0, t - 5))


def views_of(capture: ObjectCapture, t: int) -> list[View]:
    found = []
    for c, camera in enumerate(capture.rig):
        depth, person, candidates = capture.image(t, c)
        geometry = ViewGeometry.for_object(camera, capture.mesh.diameter)
        found.append(View.build(geometry, depth, person, candidates))
    return found


@pytest.mark.parametrize("name", ["bottle", "football", "cup"])
def test_rest_and_what_symmetry_hides(name: str) -> None:
    mesh = ObjectMesh.load(catalogue()[name]).simplified(600)
    capture = Lifted.make(mesh, 11, cameras=3, label=name, speed=0.04, turn_deg=4.0)
    tracker = Tracker(
        mesh,
        lambda t: views_of(capture, t),
        [[[name]] * 3] * 11,
        ObjectTrackSettings(),
        times=capture.times,
        labels=(name,),
        up=capture.master_from_room[:3, 2],
    )
    start = capture.poses[0].copy()
    start[:3, 3] += 0.005
    frames = tracker.run([GivenPose(0, start, 0.01, np.radians(5.0))]).frames
    poses = np.array([frame.fit.pose for frame in frames])
    resting = np.array([frame.resting for frame in frames])
    assert resting[:5].all() and not resting[7:].any()
    assert (poses[:5] == poses[0]).all()
    centre = poses[:, :3, :3] @ mesh.centre_of_mass + poses[:, :3, 3]
    true = capture.poses[:, :3, :3] @ mesh.centre_of_mass + capture.poses[:, :3, 3]
    assert np.linalg.norm(centre - true, axis=1).max() < 0.006
    for frame in frames:
        turns = frame.fit.covariance[:3, :3]
        free = frame.free_axis
        if name == "bottle":
            assert np.allclose(free, frame.fit.pose[:3, 2], atol=1e-6)
        elif name == "football":
            assert np.linalg.norm(free) == pytest.approx(1)
        else:
            assert (free == 0).all()
            continue
        assert free @ turns @ free > 3.0  # any turn about it is as likely
        across = np.cross(free, [1.0, 0.3, 0.2])
        across /= np.linalg.norm(across)
        if name == "bottle":
            assert across @ turns @ across < 0.05
    # the spin that nothing shows does not jump about
    steps = mesh.symmetry.none().rotation_error_deg(poses[1:, :3, :3], poses[:-1, :3, :3])
    assert steps.max() < 12
