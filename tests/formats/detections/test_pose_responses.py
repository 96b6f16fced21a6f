"""Places read from responses, against closed forms and against the published procedure."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from intercap_core.formats.detections.onnx_pose import (
    decode_heatmaps,
    decode_simcc,
    find_peaks,
)


def _gaussians(places: np.ndarray, size: tuple[int, int], sigma: float = 2.0) -> np.ndarray:
    x = np.arange(size[0])[None, None] - places[:, 0, None, None]
    y = np.arange(size[1])[None, :, None] - places[:, 1, None, None]
    return np.exp(-(x**2 + y**2) / (2 * sigma**2))


def _as_published(heatmap: np.ndarray, kernel: int) -> np.ndarray:
    """DARK as its authors have it: blur, logarithm, one Newton step from the highest cell."""
    y, x = np.unravel_index(heatmap.argmax(), heatmap.shape)
    border = (kernel - 1) // 2
    padded = cv2.copyMakeBorder(heatmap, *[border] * 4, cv2.BORDER_CONSTANT, value=0.0)
    padded = cv2.GaussianBlur(padded, (kernel, kernel), 0)
    blurred = padded[border : border + heatmap.shape[0], border : border + heatmap.shape[1]]
    log = np.log(np.maximum(blurred, 1e-10))
    dx = 0.5 * (log[y, x + 1] - log[y, x - 1])
    dy = 0.5 * (log[y + 1, x] - log[y - 1, x])
    dxx = 0.25 * (log[y, x + 2] - 2 * log[y, x] + log[y, x - 2])
    dyy = 0.25 * (log[y + 2, x] - 2 * log[y, x] + log[y - 2, x])
    dxy = 0.25 * (log[y + 1, x + 1] - log[y - 1, x + 1] - log[y + 1, x - 1] + log[y - 1, x - 1])
    step = np.linalg.solve([[dxx, dxy], [dxy, dyy]], [dx, dy])
    return np.array([x, y]) - step


@pytest.mark.parametrize("size, sigma", [((48, 64), 2.0), ((72, 96), 3.0), ((40, 40), 2.0)])
def test_a_gaussians_middle_is_found_between_the_cells(size, sigma):
    rng = np.random.default_rng(0)
    places = rng.uniform((10, 10), np.array(size) - 11, (200, 2))
    assert np.abs(find_peaks(_gaussians(places, size, sigma)) - places).max() < 2e-3


@pytest.mark.parametrize("size, kernel", [((48, 64), 11), ((72, 96), 17)])
def test_noisy_maps_are_read_as_published(size, kernel):
    rng = np.random.default_rng(1)
    places = rng.uniform((9, 9), np.array(size) - 10, (100, 2))
    maps = np.maximum(
        _gaussians(places, size, kernel / 5) + rng.normal(0, 0.01, (100, *size[::-1])), 0
    )
    found = find_peaks(maps)
    expected = np.array([_as_published(m, kernel) for m in maps])
    np.testing.assert_allclose(found, expected, atol=1e-9)
    finer = np.linalg.norm(found - places, axis=1).mean()
    assert finer < 0.35 * np.linalg.norm(_cells(maps) - places, axis=1).mean()


def _cells(maps: np.ndarray) -> np.ndarray:
    row, column = np.divmod(maps.reshape(len(maps), -1).argmax(1), maps.shape[2])
    return np.column_stack([column, row])


def test_borders_flats_and_nothing_are_the_highest_cell():
    maps = np.zeros((5, 64, 48))
    maps[0, 0, 0] = maps[1, 63, 20] = maps[2, 30, 46] = 1
    maps[3] = 0.5
    maps[4, 30, 30] = -1
    assert np.array_equal(find_peaks(maps), _cells(maps))


def test_no_step_is_longer_than_a_cell():
    rng = np.random.default_rng(2)
    maps = rng.uniform(0, 1, (300, 64, 48))
    assert np.abs(find_peaks(maps) - _cells(maps)).max() <= 1


@pytest.mark.parametrize("grid, last", [("msra", 188.0), ("udp", 191.0)])
def test_cells_stand_for_pixels_of_the_input(grid, last):
    maps = np.zeros((1, 2, 64, 48), np.float32)
    maps[0, 0, 63, 47], maps[0, 1, 0, 0] = 0.8, -0.2
    maps[0, 1, 0, 1:] = maps[0, 1, 1:] = -0.5
    far, near = decode_heatmaps(maps, (192, 256), grid)[0]
    np.testing.assert_allclose(far, [last, last + 64, 0.8], rtol=1e-6)
    np.testing.assert_allclose(near, [0, 0, 0])


def test_bins_are_pixels_of_the_input():
    columns, rows = np.zeros((1, 2, 384)), np.full((1, 2, 512), -1.0)
    columns[0, 0, 101], rows[0, 0, 40] = 0.9, 0.7
    points = decode_simcc(columns, rows, (192, 256))
    np.testing.assert_allclose(points[0], [[50.5, 20, 0.7], [0, 0, 0]])
