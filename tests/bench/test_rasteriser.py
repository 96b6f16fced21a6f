"""The baseline's differentiable rasteriser: gradients, coverage, several views."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from bench.rasteriser import OverdrawRasteriser, Pixels

SIZES = np.array([[64, 60], [58, 64]])
FOCAL = 200.0


def _box() -> tuple[np.ndarray, np.ndarray]:
    box = trimesh.creation.box((0.5, 0.3, 0.2))
    vertices, faces = trimesh.remesh.subdivide(box.vertices, box.faces)
    return trimesh.remesh.subdivide(vertices, faces)


def _projected(vertices: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """Corners (2, N, 2) and depths (2, N) of the box turned in two ways, 2.5 m away."""
    turns = Rotation.random(2, random_state=0).as_matrix()
    points = np.einsum("vij,nj->vni", turns, vertices) + np.array([0.01, 0.02, 2.5])
    corners = points[..., :2] / points[..., 2:] * FOCAL + 30
    return torch.tensor(corners), torch.tensor(points[..., 2])


def _every_pixel(sizes: np.ndarray) -> Pixels:
    grids = [np.mgrid[0:height, 0:width].reshape(2, -1) for width, height in sizes]
    view = np.repeat(np.arange(len(sizes)), [grid.shape[1] for grid in grids])
    y, x = np.concatenate(grids, 1)
    return Pixels(view, x, y, sizes)


def _make(vertices: np.ndarray, faces: np.ndarray, pixels: Pixels) -> OverdrawRasteriser:
    pytest.importorskip("deodr")
    return OverdrawRasteriser(faces, len(vertices), pixels)


@pytest.mark.parametrize("channel", [0, 1], ids=["coverage", "depth"])
def test_gradient_by_finite_differences(channel: int) -> None:
    """Of smoothly weighted sums over the images, along motions of all corners and depths.

    Depth is weighted by coverage: alone it jumps where the first triangle's reach begins.
    """
    vertices, faces = _box()
    corners, depth = _projected(vertices)
    pixels = _every_pixel(SIZES)
    draw = _make(vertices, faces, pixels)
    rng = np.random.default_rng(3)
    noise = [gaussian_filter(rng.normal(size=(height, width)), 3) for width, height in SIZES]
    weights = torch.tensor(np.concatenate([image.ravel() for image in noise]))
    centre = corners.mean(1, keepdim=True)
    shifts = [
        torch.tensor([1.0, 0.5]),
        0.05 * (corners - centre),
        0.05 * (corners - centre).flip(2),
    ]

    def value(c: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
        found = draw(c, z)
        return (weights * (found[0] if channel == 0 else found[0] * found[1])).sum()

    for shift in shifts:
        c, z = corners.clone().requires_grad_(), depth.clone().requires_grad_()
        by_corner, by_depth = torch.autograd.grad(value(c, z) + 0 * z.sum(), (c, z))
        analytic = float((by_corner * shift).sum() + 0.01 * by_depth.sum())
        step = 1e-4
        with torch.no_grad():
            ahead = value(corners + step * shift, depth + 0.01 * step)
            behind = value(corners - step * shift, depth - 0.01 * step)
        assert analytic == pytest.approx(float(ahead - behind) / (2 * step), rel=1e-3, abs=1e-3)


def test_coverage_and_depth_of_a_facing_square() -> None:
    """A box's front 1.9 m away: its area in pixels but for the soft edge, its depth inside."""
    vertices, faces = _box()
    points = vertices + np.array([0, 0, 2.0])
    corners = torch.tensor(points[None, :, :2] / points[None, :, 2:] * FOCAL + 32)
    pixels = _every_pixel(np.array([[64, 64]]))
    draw = _make(vertices, faces, pixels)
    coverage, depth = draw(corners, torch.tensor(points[None, :, 2]))
    width, height = np.array([0.5, 0.3]) / 1.9 * FOCAL
    perimeter = 2 * (width + height)
    assert float(coverage.sum()) == pytest.approx(width * height, abs=0.6 * perimeter)
    inside = (np.abs(pixels.x - 32) < width / 2 - 2) & (np.abs(pixels.y - 32) < height / 2 - 2)
    assert float(coverage[inside].min()) > 0.7  # where soft triangles meet, each covers half
    assert torch.allclose(depth[inside], torch.full_like(depth[inside], 1.9), atol=1e-3)
    outside = (np.abs(pixels.x - 32) > width / 2 + 3) | (np.abs(pixels.y - 32) > height / 2 + 3)
    assert float(coverage[outside].max()) < 1e-3


def test_views_together_equal_each_alone() -> None:
    vertices, faces = _box()
    corners, depth = _projected(vertices)
    pixels = _every_pixel(SIZES)
    together = _make(vertices, faces, pixels)(corners, depth)
    for view in range(2):
        one = _make(vertices, faces, _every_pixel(SIZES[view : view + 1]))
        alone = one(corners[view : view + 1], depth[view : view + 1])
        mine = pixels.view == view
        for a, b in zip(together, alone, strict=True):
            assert torch.allclose(a[mine], b, atol=1e-9)
