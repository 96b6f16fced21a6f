"""Points of an object inside a body, on a body whose distances are known: a ball."""

from __future__ import annotations

import numpy as np
import trimesh

from intercap_core.joint.terms.penetration import DEEPEST_IN_BODY, WATCHED_OUTSIDE, find_embedded

RADIUS = 0.1


def test_depth_and_direction_in_a_ball() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    rng = np.random.default_rng(0)
    way = rng.normal(size=(300, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    distance = rng.uniform(-0.03, 0.02, 300)
    points = way * (RADIUS + distance)[:, None]
    held = find_embedded(points, np.asarray(ball.vertices), np.asarray(ball.faces))
    # facets of 6 mm lie up to 0.1 mm inside the ball
    sure = np.minimum(np.abs(distance + DEEPEST_IN_BODY), np.abs(distance - WATCHED_OUTSIDE)) > 2e-4
    near = (distance > -DEEPEST_IN_BODY) & (distance < WATCHED_OUTSIDE)
    assert np.array_equal(np.isin(np.arange(300), held.point)[sure], near[sure])
    np.testing.assert_allclose(held.distance, distance[held.point], atol=2e-4)
    off = np.abs(distance[held.point]) > 5e-4
    assert ((held.normal * way[held.point]).sum(axis=1)[off] > 0.98).all()
    gap = np.linalg.norm(ball.vertices[held.vertex] - points[held.point], axis=1)
    assert (gap < np.abs(held.distance) + 0.008).all()
