"""Frames that were filled in, and how far off they say they are."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.body.parameters import NUM_POSE
from intercap_core.fitting.bridge import bridge, bridged_sigma

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


@pytest.mark.parametrize("gap", [(20,), tuple(range(20, 30)), (0, 1, 2), (57, 58, 59)])
def test_the_stated_error_of_a_bridge_is_that_of_such_bridges(gap):
    """Of joints that swing at random phases, error over deviation is about one."""
    random = np.random.default_rng(len(gap))
    phase, speed = random.uniform(0, 2 * np.pi, (40, 3)), random.uniform(2, 4, (40, 3))
    truth = 0.2 * np.sin(TIMES[:, None, None] * speed + phase)
    known = _unknown(*gap)
    at = np.flatnonzero(known)
    filled = np.stack(
        [[np.interp(TIMES, TIMES[at], truth[at, j, k]) for k in range(3)] for j in range(40)]
    ).transpose(2, 0, 1)
    sigma = bridged_sigma(filled, known, np.full((len(TIMES), 40), 1e-3), TIMES)
    error = np.linalg.norm(filled - truth, axis=2)[list(gap)]
    assert 0.5 < np.median(error / (1.538 * sigma[list(gap)])) < 1.6
    np.testing.assert_allclose(sigma[known], 1e-3)


def test_a_gap_longer_than_anything_known_goes_by_the_speed():
    known = _unknown(*range(10, 50))
    walking = np.zeros((len(TIMES), 2, 3))
    walking[:, 0] = TIMES[:, None] * 0.5
    sigma = bridged_sigma(walking, known, np.full((len(TIMES), 2), 0.005), TIMES)
    assert sigma[30, 0] > sigma[11, 0] > 0.02
    assert sigma[30, 1] < sigma[30, 0] <= 0.51


def test_one_known_frame_stands_for_all():
    known = np.arange(len(TIMES)) == 5
    sigma = bridged_sigma(np.zeros((len(TIMES), 1, 3)), known, np.full((60, 1), 0.01), TIMES)
    assert sigma[5] == 0.01 and sigma[6] > 0.05 and sigma[59] == pytest.approx(0.5, abs=0.001)
