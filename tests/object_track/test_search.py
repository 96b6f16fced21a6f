"""Search without a start, the grid of rotations, and near symmetries of meshes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from intercap_core.entries import Symmetry
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.symmetry import SymmetryGroup
from intercap_core.object_track.fit import assess_all
from intercap_core.object_track.search import rank_frames, search_pose
from intercap_core.object_track.turns import find_near_symmetries, rotation_grid
from tests.geometry.rigid.conftest import catalogue


def field_of(mesh: ObjectMesh) -> DistanceField:
    return DistanceField(mesh.vertices, mesh.faces, watertight=mesh.watertight, threads=1)


def test_search_finds_the_pose_without_a_start(context, capture, views):
    mesh, up = context.mesh, capture.master_from_room[:3, 2]
    best, *others = search_pose(context, field_of(mesh), views, up=up)
    assert np.linalg.norm(best.pose[:3, 3] - capture.poses[0][:3, 3]) < 0.003
    assert mesh.symmetry.rotation_error_deg(best.pose[:3, :3], capture.poses[0][:3, :3]) < 1
    (truth,) = assess_all(context, views, capture.poses[:1])
    assert truth.log_ratio == pytest.approx(best.log_ratio, abs=3)
    assert all(other.log_ratio < best.log_ratio for other in others)
    empty = [replace(view, candidates=()) for view in views]
    assert search_pose(context, field_of(mesh), empty) == []


@pytest.mark.parametrize("depth", [True, False])
def test_search_in_two_views_compares_outlines(context, capture, views, depth):
    two = [view if depth else replace(view, depth=None) for view in (views[0], views[2])]
    found = search_pose(context, field_of(context.mesh), two, up=capture.master_from_room[:3, 2])
    poses = np.array([fit.pose for fit in found])
    shift = np.linalg.norm((poses - capture.poses[0])[:, :3, 3], axis=1)
    turn = context.mesh.symmetry.rotation_error_deg(poses[:, :3, :3], capture.poses[0, :3, :3])
    # outlines alone do not tell a half turn
    assert ((shift < 0.02) & (turn < 5)).any() and (depth or len(found) > 1)


def test_the_rotation_grid_has_no_gap():
    targets = Rotation.random(200, rng=np.random.default_rng(0)).as_matrix()
    for name, widest in (("cup", 50.0), ("stool", 50.0), ("bottle", 40.0), ("football", 0.1)):
        symmetry = SymmetryGroup.from_settings(catalogue()[name].symmetry)
        grid = rotation_grid(symmetry, None)
        gaps = [symmetry.rotation_error_deg(grid, target).min() for target in targets]
        assert max(gaps) < widest
        assert name != "bottle" or len(grid) < 60


def test_frames_with_more_likely_views_come_first():
    labels = [[["person"], []], [["bed"], ["cup"]], [["cup"], ["cup", "bed"]], [["cup"], []]]
    order = rank_frames(labels, ("cup",))
    assert order[0] == 2 and sorted(order) == [0, 1, 2, 3]


def turns_of(*shapes: trimesh.Trimesh, symmetry: SymmetryGroup | None = None) -> np.ndarray:
    """Near symmetries of the union of the shapes."""
    shape = trimesh.util.concatenate(shapes)
    mesh = ObjectMesh(
        name="shape",
        vertices=np.asarray(shape.vertices, float),
        faces=np.asarray(shape.faces, np.int32),
        contact_vertices=np.arange(len(shape.vertices)),
        symmetry=symmetry or SymmetryGroup.none(),
        colours=np.full((len(shape.vertices), 3), 128, np.uint8),
        watertight=bool(shape.is_watertight),
    )
    return find_near_symmetries(mesh, field_of(mesh))


def box_at(extents: tuple[float, ...], place: tuple[float, ...] = (0, 0, 0)) -> trimesh.Trimesh:
    box = trimesh.creation.box(extents)
    box.apply_translation(place)
    return box


def test_a_mug_has_near_symmetries_about_its_axis():
    body = trimesh.creation.cylinder(radius=0.04, height=0.1, sections=32)
    turns = turns_of(body, box_at((0.03, 0.012, 0.06), (0.053, 0, 0)))
    upright = turns[turns[:, 2, 2] > 0.99]
    assert np.allclose(turns[0], np.eye(4)) and len(upright) >= 13
    # about the middle of the cup, not of the box around cup and handle
    assert np.abs(upright[:, :3, 3]).max() < 0.004


def test_a_box_with_a_small_mark_has_half_turns():
    box = box_at((0.4, 0.2, 0.6)).subdivide().subdivide()
    turns = turns_of(box, box_at((0.02, 0.02, 0.02), (0.1, 0.11, 0.2)))
    angles = np.degrees(Rotation.from_matrix(turns[:, :3, :3]).magnitude())
    assert angles == pytest.approx([0, 180, 180, 180], abs=1e-6)


def test_an_irregular_object_has_no_near_symmetry():
    parts = (
        box_at((0.5, 0.1, 0.1)),
        box_at((0.1, 0.4, 0.1), (0.2, 0.2, 0)),
        box_at((0.1, 0.1, 0.3), (-0.2, 0, 0.15)),
    )
    assert len(turns_of(*parts)) == 1


def test_elements_of_the_symmetry_group_are_left_out():
    half = np.diag([-1.0, -1.0, 1.0, 1.0]).ravel().tolist()
    group = SymmetryGroup.from_settings(Symmetry(discrete=[half]))
    assert len(turns_of(box_at((0.4, 0.2, 0.6)), symmetry=group)) == 2
