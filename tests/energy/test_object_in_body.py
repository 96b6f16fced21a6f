"""Points of an object inside a body, on a body whose distances are known: a ball."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from intercap_core.energy import object_in_body
from intercap_core.energy.constants import DEEPEST_IN_BODY, WATCHED_OUTSIDE

RADIUS = 0.1


def test_depth_and_direction_in_a_ball() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    rng = np.random.default_rng(0)
    way = rng.normal(size=(300, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    distance = rng.uniform(-0.03, 0.02, 300)
    points = way * (RADIUS + distance)[:, None]
    held = object_in_body.embedded(points, np.asarray(ball.vertices), np.asarray(ball.faces))
    # facets of 6 mm lie up to 0.1 mm inside the ball
    sure = np.minimum(np.abs(distance + DEEPEST_IN_BODY), np.abs(distance - WATCHED_OUTSIDE)) > 2e-4
    near = (distance > -DEEPEST_IN_BODY) & (distance < WATCHED_OUTSIDE)
    assert np.array_equal(np.isin(np.arange(300), held.point)[sure], near[sure])
    np.testing.assert_allclose(held.distance, distance[held.point], atol=2e-4)
    off = np.abs(distance[held.point]) > 5e-4
    assert ((held.normal * way[held.point]).sum(axis=1)[off] > 0.98).all()
    gap = np.linalg.norm(ball.vertices[held.vertex] - points[held.point], axis=1)
    assert (gap < np.abs(held.distance) + 0.008).all()


def test_derivative_by_the_object() -> None:
    rng = np.random.default_rng(1)
    points, normals = rng.normal(size=(2, 4, 3)), rng.normal(size=(2, 4, 3))
    translation, twist = rng.normal(size=(2, 3)), rng.normal(size=6)
    found = object_in_body.by_object(points, normals, translation) @ twist

    def moved(step: float) -> np.ndarray:
        turn = Rotation.from_rotvec(step * twist[:3]).as_matrix()
        there = (points - translation[:, None]) @ turn.T + translation[:, None] + step * twist[3:]
        return (there * normals).sum(axis=2)

    assert found == pytest.approx((moved(1e-5) - moved(-1e-5)) / 2e-5, abs=1e-6)
