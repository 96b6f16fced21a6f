"""The compiled tree finds what Embree and a plain search over all faces find."""

from __future__ import annotations

import igl
import numpy as np
import pytest
import trimesh

from intercap_core.geometry.rigid.distance import DistanceField, o3d
from intercap_core.geometry.rigid.surface_tree import SurfaceTree


def _bumpy(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    sphere = trimesh.creation.icosphere(subdivisions=4)
    generator = np.random.default_rng(seed)
    return 0.3 * sphere.vertices * generator.uniform(
        0.7, 1.3, (len(sphere.vertices), 1)
    ), sphere.faces


@pytest.mark.parametrize("reach", [0.02, 0.1, 10.0])
def test_distances_equal_embree_up_to_the_reach(reach: float) -> None:
    vertices, faces = _bumpy()
    points = np.random.default_rng(1).uniform(-0.6, 0.6, (3000, 3))
    found = SurfaceTree(vertices, faces).shaped(vertices).distance(points, reach)
    peer = DistanceField(vertices, faces).distance(points)
    assert found == pytest.approx(np.minimum(peer, reach), abs=1e-6)
    assert (found < reach).any() and (found == reach).any() == (reach < 1)


@pytest.mark.parametrize("count", [1, 2, 4, 5, 9])
def test_few_faces(count: int) -> None:
    generator = np.random.default_rng(count)
    vertices = generator.uniform(-1, 1, (3 * count, 3))
    faces = np.arange(3 * count).reshape(count, 3)
    points = generator.uniform(-2, 2, (200, 3))
    found = SurfaceTree(vertices, faces).shaped(vertices).distance(points, 9.0)
    peer = np.sqrt(igl.point_mesh_squared_distance(points, vertices, faces)[0])
    assert found == pytest.approx(peer, abs=1e-6)


def test_faces_without_area_and_points_on_the_surface() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]])
    faces = np.array([[0, 1, 2], [0, 1, 3], [3, 3, 3]])  # a face, a line, a point
    points = np.array([[0.2, 0.2, 0], [1.5, 0.3, 0], [3.0, 0, 0], [0.2, 0.2, -0.4]])
    found = SurfaceTree(vertices, faces).shaped(vertices).distance(points, 9.0)
    assert found == pytest.approx([0, 0.3, 1, 0.4], abs=1e-6)
    assert not len(SurfaceTree(vertices, faces).shaped(vertices).distance(np.zeros((0, 3)), 1.0))


def _pair() -> tuple[np.ndarray, np.ndarray]:
    """Two bumpy balls that cut each other."""
    (one, faces), (other, _) = _bumpy(), _bumpy(seed=3)
    return np.concatenate([one, other + np.array([0.35, 0.1, 0])]), np.concatenate(
        [faces, faces + len(one)]
    )


def _box() -> tuple[np.ndarray, np.ndarray]:
    box = trimesh.creation.box((0.5, 0.5, 0.5)).subdivide().subdivide()
    return box.vertices, box.faces


def _asked(kind: str) -> np.ndarray:
    points = np.random.default_rng(7).uniform(-0.6, 0.6, (4000, 3))
    if kind == "neighbours":
        points = points[np.lexsort(np.round(points, 1).T)]
    elif kind == "grid":  # its rays run through corners and along edges and faces of the box
        points = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 17)] * 3), -1).reshape(-1, 3)
    return points


@pytest.mark.parametrize("kind", ["scattered", "neighbours", "grid"])
@pytest.mark.parametrize("mesh", [_bumpy, _pair, _box])
@pytest.mark.parametrize(("reach", "deepest"), [(0.005, 0.25), (2.0, 2.0)])
def test_signed_distances_equal_embree(mesh, kind: str, reach: float, deepest: float):
    vertices, faces = mesh()
    points = _asked(kind)
    tree, peer = SurfaceTree(vertices, faces), DistanceField(vertices, faces)
    assert tree.closed
    away = peer.distance(points)
    points, away = points[away > 1e-5], away[away > 1e-5]  # on the surface there are no sides
    expected = np.where(peer.inside(points), -np.minimum(away, deepest), np.minimum(away, reach))
    found = tree.shaped(vertices).signed_distance(points, reach, deepest)
    assert found == pytest.approx(expected, abs=1e-6)
    assert (found < 0).any() and (found > 0).any()


def test_another_shape_of_the_mesh_is_as_exact() -> None:
    tree = SurfaceTree(*_bumpy())
    vertices, faces = _bumpy(seed=5)
    offset = np.array([1.0, 2.0, 3.0])
    bent = vertices @ np.diag([0.2, 3.0, 1.0]) + offset
    points = np.random.default_rng(2).uniform(-1, 1, (2000, 3)) + offset
    found = tree.shaped(bent).signed_distance(points, 9.0, 9.0)
    assert found == pytest.approx(DistanceField(bent, faces).signed_distance(points), abs=2e-6)


def test_points_that_are_not_finite_are_out_of_reach_and_holes_are_noticed() -> None:
    vertices, faces = _box()
    points = np.array([[0.0, 0, 0], [np.nan, 0, 0], [0, 0, 0.1], [0, np.inf, 0], [0, 0, 0.4]])
    found = SurfaceTree(vertices, faces).shaped(vertices).signed_distance(points, 0.2, 0.3)
    assert found == pytest.approx([-0.25, 0.2, -0.15, 0.2, 0.15], abs=1e-6)
    assert not SurfaceTree(vertices, faces[1:]).closed


@pytest.mark.parametrize("mesh", [_bumpy, _pair, _box])
@pytest.mark.parametrize("kind", ["scattered", "neighbours", "grid"])
def test_blocked_segments_equal_rays_of_embree(mesh, kind: str) -> None:
    vertices, faces = mesh()
    starts = _asked(kind)
    ends = np.random.default_rng(8).uniform(-0.7, 0.7, starts.shape)
    if kind == "grid":  # along the axes, all to one end
        ends = starts + np.random.default_rng(9).choice([-0.6, 0, 0.6], (len(starts), 3))
    rays = np.concatenate([starts, ends - starts], axis=1).astype(np.float32)
    field = DistanceField(vertices, faces)
    clear = (field.distance(starts) > 1e-5) & (field.distance(ends) > 1e-5)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor.from_numpy(vertices.astype(np.float32)),
        o3d.core.Tensor.from_numpy(faces.astype(np.uint32)),
    )
    expected = scene.test_occlusions(o3d.core.Tensor.from_numpy(rays), tnear=0.0, tfar=1.0).numpy()
    found = np.zeros(len(starts), bool)
    SurfaceTree(vertices, faces).shaped(vertices).blocks(starts, ends, found)
    grazing = found[clear] != expected[clear]  # single precision decides at an edge
    assert grazing.mean() < (0.02 if kind == "grid" else 5e-4)
    assert 0.02 < expected.mean() < 0.98
    share = SurfaceTree(vertices, faces).shaped(vertices).first_hit(starts, ends)
    np.testing.assert_array_equal(share <= 1, found)
    first = scene.cast_rays(o3d.core.Tensor.from_numpy(rays))["t_hit"].numpy()
    both = clear & found & (first <= 1)
    assert (np.abs(share - first)[both] > 1e-4).mean() < (0.02 if kind == "grid" else 5e-4)
    before = np.random.default_rng(1).random(len(starts)) < 0.5
    again = before.copy()
    SurfaceTree(vertices, faces).shaped(vertices).blocks(starts, ends, again)
    if kind != "grid":  # ways within a face's plane depend on which face is asked first
        np.testing.assert_array_equal(again, found | before)
