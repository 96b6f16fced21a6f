"""Rays meet a mesh where Embree says that they do."""

from __future__ import annotations

import numpy as np

from intercap_core.body_fit.first_hit import first_hits
from intercap_core.geometry.rigid.distance import o3d
from intercap_core.geometry.rigid.surfaces import vertex_normals
from tests.helpers.bodies import open_body


def test_rays_through_the_body_and_from_it() -> None:
    model = open_body()
    points, faces = model.template.double().numpy(), model.faces.numpy()
    normals = vertex_normals(points, faces)
    at = np.arange(0, len(points), 17)
    origins = np.concatenate([points[at] - 1e-3 * normals[at], points[at] + 1e-3 * normals[at]])
    directions = np.concatenate([-normals[at], normals[at]])
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        o3d.core.Tensor.from_numpy(points.astype(np.float32)),
        o3d.core.Tensor.from_numpy(faces.astype(np.uint32)),
    )
    rays = np.concatenate([origins, directions], 1).astype(np.float32)
    true = scene.cast_rays(o3d.core.Tensor.from_numpy(rays))["t_hit"].numpy()
    found = first_hits(points, faces, origins, directions)
    assert np.isfinite(found).any() and not np.isfinite(found).all()
    # but for rays along a triangle, which single precision takes either way
    agree = np.isclose(found, true, rtol=0, atol=2e-6) | ((found == np.inf) & (true == np.inf))
    assert agree.mean() > 0.998


def test_no_ray_slips_between_two_triangles() -> None:
    """A plane of two triangles, met on the edge that they share; beside it there is nothing."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    step = np.linspace(0.01, 0.99, 50)
    origins = np.stack([step, step, np.full(50, 2.0)], 1)
    down = np.tile([0.0, 0, -1], (50, 1))
    np.testing.assert_allclose(first_hits(corners, faces, origins, down), 2.0)
    assert np.isinf(first_hits(corners, faces, origins, -down)).all()
    assert np.isinf(first_hits(corners, faces, np.add(origins, [2.0, 0, 0]), down)).all()
