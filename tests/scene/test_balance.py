"""Weights by the direction of normals: a plane does not drown what stands on it."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.scene.balance import balanced
from intercap_core.scene.constants import MAX_DIRECTION_GAIN, MAX_DIRECTION_SHARE

UP, ACROSS, AHEAD = np.eye(3)[[2, 0, 1]]


def _normals(counts: dict[tuple[float, ...], int]) -> np.ndarray:
    normals = np.repeat([np.array(n) for n in counts], list(counts.values()), axis=0)
    normals = normals + np.random.default_rng(1).normal(0, 0.03, normals.shape)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def test_a_floor_has_at_most_its_share_and_the_sum_stays() -> None:
    normals = _normals({tuple(UP): 900, tuple(ACROSS): 60, tuple(AHEAD): 40})
    weight = np.random.default_rng(2).uniform(0.5, 1, 1000)
    found = balanced(weight, normals)
    assert found.sum() == pytest.approx(weight.sum())
    assert found[:900].sum() / found.sum() == pytest.approx(MAX_DIRECTION_SHARE)
    # what lies one way keeps its own proportions
    assert np.ptp(found[:900] / weight[:900]) < 1e-12 and np.ptp(found[900:] / weight[900:]) < 1e-12


def test_specks_gain_no_more_than_the_limit() -> None:
    normals = _normals({tuple(UP): 995, tuple(ACROSS): 5})
    found = balanced(np.ones(1000), normals)
    np.testing.assert_allclose(found[995:], MAX_DIRECTION_GAIN)
    assert found.sum() == pytest.approx(1000)


def test_what_is_balanced_or_of_one_direction_stays_to_the_byte() -> None:
    weight = np.random.default_rng(3).uniform(0, 1, 300)
    mixed = _normals({tuple(UP): 100, tuple(ACROSS): 100, tuple(AHEAD): 100})
    np.testing.assert_array_equal(balanced(weight, mixed), weight)
    np.testing.assert_array_equal(balanced(weight, _normals({tuple(UP): 300})), weight)
    np.testing.assert_array_equal(balanced(np.zeros(300), mixed), np.zeros(300))
