"""The lens model's forms against one another: numpy, torch, compiled, and warp where installed.

Random lenses, points within and beyond the metric radius, nearer than the nearest depth and behind
the camera; Jacobians against finite differences.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from intercap_core.geometry.camera.projection import (
    MIN_DEPTH_M,
    inside_model,
    project,
    project_with_jacobian,
)
from intercap_core.geometry.camera.projection_kernels import (
    distort,
    project_point,
    project_point_with_jacobian,
)

STEP_M = 1e-7


def random_lens(seed: int) -> np.ndarray:
    """Parameters (13,) scattered about those of a wide depth or a colour lens."""
    rng = np.random.default_rng(seed)
    focal = rng.uniform(300, 1200, 2)
    centre = rng.uniform(200, 1000, 2)
    colour = np.array([0.33, -2.489, -1.6e-4, -1.3e-4, 1.454, 0.209, -2.303, 1.375])
    wide = np.array([0.548, -0.021, 2.1e-5, -7.2e-5, -0.0027, 0.89, 0.086, -0.0139])
    distortion = (colour, wide)[seed % 2] * rng.uniform(0.95, 1.05, 8)
    distortion[2:4] += rng.normal(0, 1e-3, 2)
    return np.array([*focal, *centre, *distortion, rng.uniform(0.6, 0.8)])


def random_points(seed: int, count: int = 300) -> np.ndarray:
    """Points all around the camera; some on the axis, at the nearest depth and behind."""
    points = np.random.default_rng(seed).uniform([-3, -3, -0.5], [3, 3, 3.0], (count, 3))
    points[: count // 3, :2] *= 0.3  # so that many are within the radius
    points[0] = 0, 0, 1
    points[1] = 0.1, -0.2, -1
    points[2] = 1e-4, 2e-4, MIN_DEPTH_M
    points[3] = 1e-4, 2e-4, MIN_DEPTH_M / 2
    return points


@pytest.mark.parametrize("seed", range(6))
def test_plain_and_compiled_forms_are_equal(seed):
    lens, points = random_lens(seed), random_points(seed)
    covered = inside_model(points, lens)
    assert 20 < covered.sum() < len(points) - 20
    pixels, jacobian = project_with_jacobian(points, lens)
    compiled = np.array([project_point_with_jacobian(*point, lens) for point in points])
    np.testing.assert_allclose(compiled[:, :2], pixels, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(compiled[:, 2:].reshape(-1, 2, 3), jacobian, rtol=1e-11, atol=1e-9)
    alone = np.array([project_point(*point, lens) for point in points])
    np.testing.assert_allclose(alone, pixels, rtol=1e-12, atol=1e-9)
    tensors = project_with_jacobian(torch.from_numpy(points), lens)
    np.testing.assert_allclose(tensors[0].numpy(), pixels, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(tensors[1].numpy(), jacobian, rtol=1e-11, atol=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_the_compiled_jacobian_matches_finite_differences(seed):
    lens, points = random_lens(seed), random_points(seed)
    x, y, z = points.T
    radius = np.hypot(x, y) / np.maximum(z, MIN_DEPTH_M)
    # Not within a step of a kink: the metric radius, the nearest depth.
    smooth = (np.abs(z - MIN_DEPTH_M) > 1e-2) & (np.abs(radius - lens[12]) > 1e-3)
    points = points[smooth]
    jacobian = np.array([project_point_with_jacobian(*p, lens)[2:] for p in points])
    numeric = np.empty((len(points), 2, 3))
    for axis, offset in enumerate(STEP_M * np.eye(3)):
        after = np.array([project_point(*p, lens) for p in points + offset])
        before = np.array([project_point(*p, lens) for p in points - offset])
        numeric[..., axis] = (after - before) / (2 * STEP_M)
    scale = np.abs(numeric).max(axis=(1, 2), keepdims=True) + 1.0
    assert (np.abs(jacobian.reshape(-1, 2, 3) - numeric) / scale).max() < 1e-5
    behind = points[:, 2] < MIN_DEPTH_M
    assert behind.any() and not jacobian[behind][:, [2, 5]].any()


@pytest.mark.parametrize("seed", range(4))
def test_single_precision_stays_single(seed):
    lens, points = random_lens(seed), random_points(seed)
    points = points[inside_model(points, lens)].astype(np.float32)
    single = lens.astype(np.float32)
    expected = project(points, single)
    for point, pixel in zip(points, expected, strict=True):
        inverse = np.float32(1) / point[2]
        xd, yd = distort(point[0] * inverse, point[1] * inverse, tuple(single[4:12]))
        found = single[:2] * np.array([xd, yd], np.float32) + single[2:4]
        assert np.array_equal(found, pixel)
