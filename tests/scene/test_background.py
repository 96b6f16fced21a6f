"""The background behind people who stand still, noise and holes."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.geometry.solve.time_series import sample_evenly
from intercap_core.scene.background import Background, steady_background


def background_of(images: np.ndarray) -> Background:
    return steady_background(images, np.zeros(images.shape, bool))


def test_person_who_mostly_stands_still_is_not_background():
    rng = np.random.default_rng(0)
    images = rng.normal(3000, 3, (20, 4, 6)).astype(np.uint16)
    images[:14, 1:3, 1:3] = rng.normal(1800, 3, (14, 2, 2))  # 70 % of the time in front
    images[rng.random(images.shape) < 0.1] = 0
    background = background_of(images)
    assert np.abs(background.depth.astype(int) - 3000).max() <= 8
    assert not background.static[1:3, 1:3].any() and background.static[3].all()


def test_single_values_behind_the_wall_are_not_background():
    images = np.full((20, 3, 3), 2500, np.uint16)
    images[4] = 3900
    images[9] = 3300
    assert (background_of(images).depth == 2500).all()
    np.testing.assert_array_equal(background_of(images[:1]).depth, images[0])


def test_unseen_and_unsteady_pixels_are_unknown():
    images = np.zeros((10, 1, 3), np.uint16)
    images[:, 0, 1] = np.arange(10) * 200 + 500
    images[::5, 0, 2] = 1000
    background = background_of(images)
    np.testing.assert_array_equal(background.depth, [[0, 0, 1000]])
    np.testing.assert_array_equal(background.static, [[False, False, False]])


def test_samples_are_few_and_evenly_spaced():
    available = np.arange(3000) % 2 == 1
    frames = sample_evenly(available, 25)
    assert len(frames) == 25 and available[frames].all() and frames[-1] > 2900
    np.testing.assert_array_equal(sample_evenly(np.array([True, False, True]), 25), [0, 2])


@pytest.mark.parametrize("samples", [1, 2, 7, 25])
def test_background_is_the_median_of_the_farthest_cluster(samples: int):
    rng = np.random.default_rng(samples)
    images = (1000 + 40 * rng.integers(0, 5, (samples, 20, 30))).astype(np.uint16)
    images += rng.integers(0, 8, images.shape).astype(np.uint16)
    images[rng.random(images.shape) < 0.2] = 0
    background = background_of(images)
    for seen, depth, static in zip(
        images.reshape(samples, -1).T, background.depth.flat, background.static.flat, strict=True
    ):
        valid = np.sort(seen[seen > 0]).astype(float)
        share = 0.2 if len(valid) >= 0.75 * samples else 0.8
        count = max(int(np.ceil(share * len(valid))), min(2, samples))
        cluster = np.zeros(0)
        for first in range(len(valid) - count, -1, -1):
            low, high = valid[first], valid[first + count - 1]
            tolerance = 8 + 0.004 * (low + high) / 2
            if high - low <= tolerance:
                cluster = valid[np.abs(valid - (low + high) / 2) <= tolerance]
                break
        assert depth == (cluster[len(cluster) // 2] if len(cluster) else 0)
        assert static == (len(cluster) > 0.5 * max(len(valid), samples / 2))
