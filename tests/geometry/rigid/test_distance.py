"""Signed distances against closed forms, and the import of Open3D's core."""

import subprocess
import sys

import numpy as np
import pytest
import trimesh

from intercap_core.geometry.rigid.distance import DistanceField, SurfacePart


def test_box_against_the_closed_form():
    half = np.array([0.2, 0.1, 0.05])
    box = trimesh.creation.box(2 * half)
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (5000, 3))
    outside = np.abs(points) - half
    expected = np.linalg.norm(np.maximum(outside, 0), axis=1) + np.minimum(outside.max(1), 0)
    field = DistanceField(box.vertices, box.faces)
    signed = field.signed_distance(points)
    np.testing.assert_allclose(signed, expected, atol=1e-6)
    np.testing.assert_array_equal(field.inside(points), expected < 0)
    np.testing.assert_allclose(field.distance(points), np.abs(expected), atol=1e-6)


def test_closest_points_lie_on_their_faces():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.11)
    points = np.random.default_rng(2).normal(size=(1000, 3)) * 0.1
    field = DistanceField(ball.vertices, ball.faces)
    found = field.closest(points)
    corners = np.asarray(ball.vertices)[np.asarray(ball.faces)[found.faces]]
    np.testing.assert_allclose(
        (corners * found.barycentric[..., None]).sum(1), found.points, atol=1e-6
    )
    np.testing.assert_allclose(
        np.linalg.norm(points - found.points, axis=1), field.distance(points), atol=1e-6
    )
    assert (np.einsum("ij,ij->i", found.normals, found.points) > 0).all()


def test_an_open_mesh_is_not_deeper_than_the_closed_one():
    """Below the missing lid the nearest face is a side, but the boundary is the lid; points outside
    the box are not inside."""
    box = trimesh.creation.box((0.4, 0.3, 0.2)).subdivide().subdivide().subdivide()
    kept = box.triangles_center[:, 2] < 0.0999
    field = DistanceField(box.vertices, box.faces[kept], watertight=False)
    solid = DistanceField(box.vertices, box.faces)
    points = np.random.default_rng(6).uniform(-0.75, 0.75, size=(20000, 3)) * box.extents
    depth, true = field.signed_distance(points), solid.signed_distance(points)
    inside = depth < 0
    assert (depth >= true - 1e-6).all()
    np.testing.assert_allclose(depth[inside], true[inside], atol=1e-6)
    # near the hole half of the surface is not around a point
    assert inside.sum() > 0.8 * (true < 0).sum() > 0
    np.testing.assert_array_equal(field.inside(points), inside)
    assert not field.inside(points + 2 * box.extents).any()
    below = np.array([[0.0, 0.0, 0.02], [0.03, 0.02, 0.03]])
    found, closest = field.boundary(below)
    assert found.all()
    np.testing.assert_allclose(closest.points, [[0, 0, 0.1], [0.03, 0.02, 0.1]], atol=1e-6)
    np.testing.assert_allclose(closest.normals, [[0, 0, 1.0]] * 2, atol=1e-6)


def test_a_tenth_of_the_faces_may_be_missing():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.11)
    rng = np.random.default_rng(7)
    kept = rng.permutation(len(ball.faces))[: int(0.9 * len(ball.faces))]
    points = rng.normal(size=(4000, 3)) * 0.07
    points = points[np.abs(np.linalg.norm(points, axis=1) - 0.11) > 0.005]
    true = 0.11 - np.linalg.norm(points, axis=1)
    field = DistanceField(ball.vertices, ball.faces[kept], watertight=False)
    found = -field.signed_distance(points)
    assert (np.sign(found) != np.sign(true)).mean() < 0.002
    np.testing.assert_allclose(found, true, atol=0.006)


def test_distances_to_the_top_of_a_box():
    """Only points inside that are nearest to the top are below it."""
    half = np.array([0.2, 0.1, 0.05])
    box = trimesh.creation.box(2 * half)
    top = np.flatnonzero(box.vertices[:, 2] > 0)
    field = DistanceField(box.vertices, box.faces)
    points = np.random.default_rng(4).uniform(-0.3, 0.3, (5000, 3))
    below, found = SurfacePart(field, box.vertices, box.faces, top).boundary(points)
    expected = np.column_stack(
        [np.clip(points[:, :2], -half[:2], half[:2]), np.full(len(points), half[2])]
    )
    np.testing.assert_allclose(found.points, expected, atol=1e-6)
    assert (np.asarray(box.vertices)[np.asarray(box.faces)[found.faces]][..., 2] > 0).all()
    room = half - np.abs(points)  # to the nearest side along each axis
    inside = (room > 0).all(1)
    assert below.any() and (inside & ~below).any()
    np.testing.assert_array_equal(
        below, inside & (points[:, 2] > 0) & (room[:, 2] <= room[:, :2].min(1))
    )


def test_a_single_vertex_spans_the_faces_around_it():
    box = trimesh.creation.box((0.2, 0.2, 0.2))
    field = DistanceField(box.vertices, box.faces)
    part = SurfacePart(field, box.vertices, box.faces, np.array([5]))
    around = (np.asarray(box.faces) == 5).any(1)
    only = DistanceField(box.vertices, np.asarray(box.faces)[around])
    points = np.random.default_rng(5).normal(size=(200, 3)) * 0.2
    found = part.boundary(points)[1]
    np.testing.assert_allclose(found.points, only.closest(points).points, atol=1e-9)
    assert around[found.faces].all()
    with pytest.raises(ValueError, match="no face"):
        SurfacePart(field, box.vertices, np.asarray(box.faces)[~around], np.array([5]))


CORE_FIRST = """
import sys, intercap_core.stages.object_track
from intercap_core.geometry.rigid.open3d_core import o3d as ours
assert not {"sklearn", "pandas", "dash", "matplotlib", "torch", "open3d"} & set(sys.modules)
import open3d
assert open3d.t.geometry.RaycastingScene is ours.t.geometry.RaycastingScene
"""
WHOLE_FIRST = "import open3d; from intercap_core.geometry.rigid.open3d_core import o3d as ours"


@pytest.mark.parametrize("code", [CORE_FIRST, WHOLE_FIRST])
def test_stages_import_the_core_of_open3d_that_the_whole_package_has(code):
    code += "\nassert ours.core.Tensor is open3d.core.Tensor"
    subprocess.run([sys.executable, "-c", code], check=True)
