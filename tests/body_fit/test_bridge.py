"""Interpolated frames and their standard deviation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.body.parameters import NUM_POSE
from intercap_core.body_fit.bridge import bridge, bridged_sigma

TIMES = np.arange(60) / 15


def _unknown(*frames: int) -> np.ndarray:
    return ~np.isin(np.arange(len(TIMES)), frames)


def test_a_steady_turn_and_walk_are_bridged_exactly():
    vectors = np.zeros((len(TIMES), NUM_POSE + 3))
    vectors[:, :3] = np.outer(TIMES, [0.1, 0.4, 0.0])
    vectors[:, NUM_POSE] = 1.2 * TIMES
    known = _unknown(7, 8, 9, 30)
    damaged = np.where(known[:, None], vectors, 9.0)
    found = bridge(damaged, known, TIMES)
    between = Rotation.from_rotvec(found[:, :3]).inv() * Rotation.from_rotvec(vectors[:, :3])
    assert between.magnitude().max() < 1e-9
    np.testing.assert_allclose(found[:, NUM_POSE], vectors[:, NUM_POSE], atol=1e-12)


def _as_vectors(points: np.ndarray) -> np.ndarray:
    """Parameter vectors whose columns past the pose are points (T,J,3)."""
    return np.hstack([np.zeros((len(points), NUM_POSE)), points.reshape(len(points), -1)])


def test_a_swing_is_bridged_with_the_velocity_at_both_ends():
    """The error is a third of that of a straight bridge."""
    vectors = np.zeros((len(TIMES), NUM_POSE + 3))
    vectors[:, 3:6] = np.outer(np.sin(3 * TIMES), [0.2, 0.9, 0.1])
    vectors[:, NUM_POSE] = 0.5 * np.sin(3 * TIMES)
    known = _unknown(*range(16, 22))
    found = bridge(np.where(known[:, None], vectors, 9.0), known, TIMES)
    straight = np.interp(TIMES, TIMES[known], vectors[known, NUM_POSE])
    off, usual = found - vectors, straight - vectors[:, NUM_POSE]
    assert np.abs(off[:, NUM_POSE]).max() < np.abs(usual).max() / 3
    assert np.abs(off[:, 4]).max() < 0.9 * np.abs(usual).max() / 0.5 / 3
    np.testing.assert_array_equal(found[known], vectors[known])


def test_one_frame_between_two_gaps_has_no_velocity():
    vectors = np.zeros((len(TIMES), NUM_POSE + 3))
    vectors[:, NUM_POSE] = TIMES
    vectors[30, NUM_POSE] += 0.2
    found = bridge(vectors, _unknown(*range(20, 30), *range(31, 40)), TIMES)[:, NUM_POSE]
    assert (np.diff(found[19:31]) > 0).all() and found[19:31].max() <= vectors[30, NUM_POSE]


@pytest.mark.parametrize("gap", [(20,), tuple(range(20, 30)), (0, 1, 2), (57, 58, 59)])
def test_stated_error_of_a_bridge_is_the_true_one(gap):
    """Error over deviation is about one for joints that swing at random phases."""
    random = np.random.default_rng(len(gap))
    phase, speed = random.uniform(0, 2 * np.pi, (40, 3)), random.uniform(2, 4, (40, 3))
    truth = 0.2 * np.sin(TIMES[:, None, None] * speed + phase)
    known = _unknown(*gap)
    filled = bridge(_as_vectors(truth), known, TIMES)[:, NUM_POSE:].reshape(truth.shape)
    sigma = bridged_sigma(filled, known, np.full((len(TIMES), 40), 1e-3), TIMES)
    error = np.linalg.norm(filled - truth, axis=2)[list(gap)]
    assert 0.5 < np.median(error / (1.538 * sigma[list(gap)])) < 1.6
    np.testing.assert_allclose(sigma[known], 1e-3)


def test_a_gap_longer_than_all_stretches_uses_the_speed():
    known = _unknown(*range(10, 50))
    walking = np.zeros((len(TIMES), 2, 3))
    walking[:, 0] = TIMES[:, None] * 0.5
    sigma = bridged_sigma(walking, known, np.full((len(TIMES), 2), 0.005), TIMES)
    assert sigma[30, 0] > sigma[11, 0] > 0.02
    assert sigma[30, 1] < sigma[30, 0] <= 0.51


def test_one_known_frame_determines_all():
    known = np.arange(len(TIMES)) == 5
    sigma = bridged_sigma(np.zeros((len(TIMES), 1, 3)), known, np.full((60, 1), 0.01), TIMES)
    assert sigma[5] == 0.01 and sigma[6] > 0.05 and sigma[59] == pytest.approx(0.5, abs=0.001)
