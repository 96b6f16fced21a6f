"""Triangulation of known points, with wrong views."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.camera.triangulation import midpoints, reproject, triangulate
from tests.helpers.synthetic_capture import ring

RIG, UP = ring()


def cloud(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return apply(invert(UP), rng.uniform((-0.6, -0.6, 0.1), (0.6, 0.6, 1.7), (count, 3)))


def test_rays_that_meet_and_rays_that_do_not():
    one, two = np.array([1.0, 0, 0]), np.array([0.0, 1, 0])
    at, other = np.zeros(3), np.array([2.0, -3.0, 0.1])
    point, gap = midpoints(one, two, at, other)
    np.testing.assert_allclose(point, [2, 0, 0.05])
    np.testing.assert_allclose(gap, 0.1)
    for direction, origin in ((-two, other), (one, other), (one + 0.03 * two, other)):
        assert np.isnan(midpoints(one, direction, at, origin)[0]).all()


def test_exact_pixels_give_exact_points():
    points = cloud(200)
    pixels = reproject(points, RIG)
    found = triangulate(pixels, np.ones(pixels.shape[:2]), RIG, max_error_px=20)
    np.testing.assert_allclose(found.points, points, atol=1e-6)
    assert found.inlier.all() and found.error.max() < 1e-3
    assert (found.views == 6).all()


@pytest.mark.parametrize("wrong", [1, 2, 3])
def test_wrong_views_are_outliers(wrong):
    rng = np.random.default_rng(wrong)
    points = cloud(300, seed=wrong)
    pixels = reproject(points, RIG) + rng.normal(0, 2, (300, 6, 2))
    wrong_views = np.argsort(rng.random((300, 6)), axis=1)[:, :wrong]
    rows = np.arange(300)[:, None]
    pixels[rows, wrong_views] += rng.uniform(80, 200, (300, wrong, 2)) * rng.choice(
        [-1, 1], (300, wrong, 2)
    )
    found = triangulate(pixels, np.ones((300, 6)), RIG, max_error_px=20)
    error = np.linalg.norm(found.points - points, axis=1)
    assert np.median(error) < 0.008 and (error < 0.05).mean() > 0.98
    assert found.inlier[rows, wrong_views].mean() < 0.02


def test_facing_cameras_agree_by_chance():
    """Two views show points near the line between two cameras; the camera opposite lies, of points
    farther along the first one's rays."""
    facing = Rig(tuple(RIG[c] for c in (0, 3, 1)))
    first, opposite = (camera.master_from_colour[:3, 3] for camera in (facing[0], facing[1]))
    along = (0.5 + np.linspace(-0.05, 0.05, 20))[:, None]
    points = first + along * (opposite - first) + np.array([0, 0.2, 0.0])
    lie = first + 1.25 * (points - first)
    pixels = reproject(points, facing)
    pixels[:, 1] = reproject(lie, facing)[:, 1]
    weights = np.tile([0.9, 0.9, 0.4], (20, 1))  # and it is surer than the view from the side
    found = triangulate(pixels, weights, facing, max_error_px=20)
    # without a cost of chance the two that face each other win, and the point is anywhere between
    np.testing.assert_allclose(found.points, points, atol=0.05)
    assert found.inlier[:, 2].all()


def test_too_few_views_give_no_point():
    pixels = reproject(cloud(4), RIG)
    weights = np.zeros((4, 6))
    weights[1, 0] = 1
    weights[2, :2] = 1
    weights[3] = 1
    pixels[3] += np.random.default_rng(0).uniform(200, 900, (6, 2))  # nobody agrees with anybody
    found = triangulate(pixels, weights, RIG, max_error_px=3)
    np.testing.assert_array_equal(np.isfinite(found.points[:, 0]), [False, False, True, False])
    np.testing.assert_array_equal(found.views, [0, 0, 2, 0])
    assert np.isnan(found.error[[0, 1, 3]]).all() and np.isnan(found.view_error[0]).all()


def test_limits_scale_with_the_image_size():
    half = type(RIG)(tuple(
        type(c)(c.name, c.colour.scaled(0.5), c.depth, c.colour_from_depth, c.master_from_colour)
        for c in RIG
    ))  # fmt: skip
    points = cloud(50)
    pixels = reproject(points, half)
    pixels[:, 0] += 15  # 30 px at 1080p
    found = triangulate(pixels, np.ones((50, 6)), half, max_error_px=20)
    assert not found.inlier[:, 0].any() and found.inlier[:, 1:].all()
