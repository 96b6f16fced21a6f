"""The compiled tree finds what Embree and a plain search over all faces find."""

from __future__ import annotations

import igl
import numpy as np
import pytest
import trimesh

from intercap_core.rigid.distance import DistanceField
from intercap_core.rigid.surface_tree import SurfaceTree


def _bumpy(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    sphere = trimesh.creation.icosphere(subdivisions=4)
    generator = np.random.default_rng(seed)
    return 0.3 * sphere.vertices * generator.uniform(
        0.7, 1.3, (len(sphere.vertices), 1)
    ), sphere.faces


@pytest.mark.parametrize("reach", [0.02, 0.1, 10.0])
def test_distances_are_those_of_other_libraries_up_to_the_reach(reach: float) -> None:
    vertices, faces = _bumpy()
    points = np.random.default_rng(1).uniform(-0.6, 0.6, (3000, 3))
    found = SurfaceTree(vertices, faces).shaped(vertices).distance(points, reach)
    peer = np.sqrt(igl.point_mesh_squared_distance(points, vertices, faces.astype(np.int64))[0])
    assert found == pytest.approx(np.minimum(peer, reach), abs=1e-6)
    assert found == pytest.approx(
        np.minimum(DistanceField(vertices, faces).distance(points), reach), abs=1e-6
    )
    assert (found < reach).any() and (found == reach).any() == (reach < 1)


def test_another_shape_of_the_mesh_is_as_exact() -> None:
    tree = SurfaceTree(*_bumpy())
    vertices, faces = _bumpy(seed=5)
    bent = vertices @ np.diag([0.2, 3.0, 1.0]) + np.array([1.0, 2.0, 3.0])
    points = np.random.default_rng(2).uniform(-1, 1, (2000, 3)) + np.array([1.0, 2.0, 3.0])
    found = tree.shaped(bent).distance(points, 5.0)
    assert found == pytest.approx(DistanceField(bent, faces).distance(points), abs=2e-6)


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
