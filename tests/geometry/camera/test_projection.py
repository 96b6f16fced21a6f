"""Projection against OpenCV, its inverse and finite differences, in numpy, torch and kernels."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from intercap_core.geometry.camera.intrinsics import Intrinsics
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

# A colour and a depth lens with strong distortion of both radial and tangential kind.
COLOUR = Intrinsics(
    1920, 1080, 918.0, 917.0, 959.2, 549.4,
    np.array([0.33, -2.489, -1.6e-4, -1.3e-4, 1.454, 0.209, -2.303, 1.375]),
)  # fmt: skip
DEPTH = Intrinsics(
    640, 576, 504.6, 504.7, 332.8, 348.8,
    np.array([0.548, -0.021, 2.1e-5, -7.2e-5, -0.0027, 0.89, 0.086, -0.0139]), 1.74,
)  # fmt: skip
PINHOLE = Intrinsics(640, 480, 500.0, 510.0, 320.0, 240.0)
LENSES = [COLOUR, DEPTH, PINHOLE]


def points_in_view(lens: Intrinsics, count: int = 500, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    pixels = rng.uniform([0, 0], [lens.width, lens.height], (count, 2))
    return lens.unproject(pixels) * rng.uniform(0.3, 6.0, (count, 1))


def random_points(count: int = 400, seed: int = 1) -> np.ndarray:
    """Points all around the camera; some on the axis, at the nearest depth and behind."""
    points = np.random.default_rng(seed).uniform([-3, -3, -0.5], [3, 3, 3.0], (count, 3))
    points[: count // 3, :2] *= 0.3  # so that many are within the radius
    points[0] = 0, 0, 1
    points[1] = 0.1, -0.2, -1
    points[2] = 1e-4, 2e-4, MIN_DEPTH_M
    points[3] = 1e-4, 2e-4, MIN_DEPTH_M / 2
    return points


@pytest.mark.parametrize("lens", LENSES)
def test_projection_equals_opencv(lens):
    points = points_in_view(lens)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.matrix, lens.distortion)
    assert np.abs(lens.project(points) - expected[:, 0]).max() < 1e-9


@pytest.mark.parametrize("lens", LENSES)
def test_unprojection_inverts_projection(lens):
    x = np.linspace(-2.0 * lens.width, 3.0 * lens.width, 60)
    y = np.linspace(-2.0 * lens.height, 3.0 * lens.height, 60)
    pixels = np.stack(np.meshgrid(x, y), -1)
    rays = lens.unproject(pixels)
    assert rays.shape == (60, 60, 3)
    assert np.all(rays[..., 2] == 1)
    assert np.abs(lens.project(rays * 2.5) - pixels).max() < 1e-6


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("points", [points_in_view(COLOUR), random_points()])
def test_jacobian_matches_finite_differences(lens, points):
    pixels, jacobian = lens.project_with_jacobian(points)
    step = 1e-6
    offsets = np.eye(3) * step
    numeric = np.stack(
        [(lens.project(points + o) - lens.project(points - o)) / (2 * step) for o in offsets], -1
    )
    assert np.array_equal(pixels, lens.project(points))
    # Skip points within the step of a kink: the metric radius and the nearest depth.
    z = points[:, 2]
    radius = np.hypot(points[:, 0], points[:, 1]) / np.maximum(z, 1e-3)
    smooth = (np.abs(z - 1e-3) > 0.02) & (np.abs(radius - lens.metric_radius) > 1e-3)
    scale = np.abs(numeric).max(axis=(1, 2), keepdims=True) + 1.0
    assert (np.abs(jacobian - numeric) / scale)[smooth].max() < 1e-5


@pytest.mark.parametrize("lens", LENSES)
def test_torch_equals_numpy_and_autograd(lens):
    points = random_points().reshape(20, 20, 3)
    points[0, 0] = 0, 0, 1  # on the axis, where a square root would have no derivative
    pixels, jacobian = lens.project_with_jacobian(points)
    tensor = torch.tensor(points, requires_grad=True)
    torch_pixels, torch_jacobian = lens.project_with_jacobian(tensor)
    assert np.allclose(torch_pixels.detach().numpy(), pixels, rtol=1e-12, atol=1e-9)
    assert np.allclose(torch_jacobian.detach().numpy(), jacobian, rtol=1e-9, atol=1e-9)
    for axis in range(2):
        (gradient,) = torch.autograd.grad(torch_pixels[..., axis].sum(), tensor, retain_graph=True)
        assert np.allclose(gradient.numpy(), jacobian[..., axis, :], rtol=1e-6, atol=1e-6)


def test_parameters_of_several_cameras_broadcast():
    points = random_points(120).reshape(4, 3, 10, 3)
    parameters = np.stack([lens.parameters for lens in LENSES])[:, None]
    together = project(points, parameters)
    for index, lens in enumerate(LENSES):
        assert np.array_equal(together[:, index], lens.project(points[:, index]))


def test_projection_never_folds_back_into_the_image():
    """Moving outwards moves the pixel outwards, however far: a polynomial alone would return."""
    for lens in LENSES:
        angles = np.linspace(0, 2 * np.pi, 33)
        radii = np.linspace(0.01, 20, 4000)[:, None]
        ring = np.stack([radii * np.cos(angles), radii * np.sin(angles)], -1)
        points = np.concatenate([ring, np.ones((*ring.shape[:-1], 1))], -1)
        distance = np.linalg.norm(lens.project(points) - (lens.cx, lens.cy), axis=-1)
        assert np.all(np.diff(distance, axis=0) > 0)


def test_points_outside_the_lens_model_are_finite_and_flagged():
    points = np.array([[1.8, 0, 1.0], [1.6, 0, 1.0], [0, 0, -1.0], [0.0, 0, 0], [0, 0, 1.0]])
    assert np.all(np.isfinite(COLOUR.project(points)))
    assert COLOUR.inside_model(points).tolist() == [False, True, False, False, True]
    assert COLOUR.sees(points).tolist() == [False, False, False, False, True]


def test_a_crop_shifts_and_a_scale_keeps_the_edges():
    points = points_in_view(COLOUR)
    pixels = COLOUR.project(points)
    assert np.allclose(COLOUR.cropped(100, 50, 600, 400).project(points), pixels - (100, 50))
    half = COLOUR.scaled(0.5)
    assert (half.width, half.height) == (960, 540)
    assert np.allclose(half.project(points), (pixels + 0.5) / 2 - 0.5)


def test_the_ray_table_is_nan_outside_the_radius():
    table = DEPTH.rays
    assert table.shape == (576, 640, 2) and table.dtype == np.float32
    assert np.allclose(table[123, 456], DEPTH.unproject(np.array([456.0, 123.0]))[:2], atol=1e-6)
    wide = Intrinsics(1024, 1024, 504.6, 504.7, 524.0, 529.0, DEPTH.distortion, 1.7)
    outside = np.isnan(wide.rays[..., 0])
    assert outside[0, 0] and not outside[512, 512]


@pytest.mark.parametrize("lens", [*LENSES, COLOUR.scaled(2.0), COLOUR.cropped(300, 7, 1001, 902)])
def test_interpolated_rays_project_to_their_pixels(lens):
    v, u = np.mgrid[0 : lens.height : 7, 0 : lens.width : 11]
    xy = lens.rays[v, u].astype(np.float64)
    rays = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], -1)
    assert np.abs(lens.project(rays) - np.stack([u, v], -1)).max() < 5e-4  # float32's own share
    corners = np.array([[0, 0], [lens.width - 1, lens.height - 1]])
    exact = lens.unproject(corners)[:, :2]
    assert np.allclose(lens.rays[corners[:, 1], corners[:, 0]], exact, atol=1e-6)


def test_parameters_round_trip():
    again = Intrinsics.from_parameters((COLOUR.width, COLOUR.height), COLOUR.parameters)
    assert np.array_equal(again.parameters, COLOUR.parameters)
    assert (again.width, again.height) == (1920, 1080)


@pytest.mark.parametrize(
    "change", [{"width": 0}, {"fx": -1.0}, {"distortion": np.zeros(5)}, {"metric_radius": 0.0}]
)
def test_impossible_lenses_are_refused(change):
    values = dict(width=4, height=4, fx=1.0, fy=1.0, cx=0.0, cy=0.0) | change
    with pytest.raises(ValueError):
        Intrinsics(**values)


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


@pytest.mark.parametrize("seed", range(6))
def test_compiled_kernels_equal_numpy(seed):
    lens, points = random_lens(seed), random_points(300, seed)
    covered = inside_model(points, lens)
    assert 20 < covered.sum() < len(points) - 20 and (points[:, 2] < MIN_DEPTH_M).any()
    pixels, jacobian = project_with_jacobian(points, lens)
    compiled = np.array([project_point_with_jacobian(*point, lens) for point in points])
    np.testing.assert_allclose(compiled[:, :2], pixels, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(compiled[:, 2:].reshape(-1, 2, 3), jacobian, rtol=1e-11, atol=1e-9)
    alone = np.array([project_point(*point, lens) for point in points])
    np.testing.assert_allclose(alone, pixels, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_single_precision_stays_single(seed):
    lens, points = random_lens(seed), random_points(300, seed)
    points = points[inside_model(points, lens)].astype(np.float32)
    single = lens.astype(np.float32)
    expected = project(points, single)
    for point, pixel in zip(points, expected, strict=True):
        inverse = np.float32(1) / point[2]
        xd, yd = distort(point[0] * inverse, point[1] * inverse, tuple(single[4:12]))
        found = single[:2] * np.array([xd, yd], np.float32) + single[2:4]
        assert np.array_equal(found, pixel)
