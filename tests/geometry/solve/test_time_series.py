"""Gaps, velocities and cheapest sequences against values worked out by hand."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from intercap_core.geometry.solve.time_series import (
    cheapest_sequence,
    filled_linearly,
    limited_velocity,
    nearest,
)


def test_the_nearest_known_frames():
    assert nearest([2, 6, 7], [0, 2, 3, 4, 5, 6, 9]).tolist() == [2, 2, 2, 2, 6, 6, 7]
    assert nearest([3], [1, 3, 8]).tolist() == [3, 3, 3]


def test_gaps_are_linear_and_ends_constant():
    values = np.array([[np.nan, 0], [1, 10], [np.nan, 0], [np.nan, 0], [4, 40], [np.nan, 0]])
    at = np.array([0.0, 1.0, 1.5, 3.0, 4.0, 9.0])
    known = np.array([False, True, False, False, True, False])
    found = filled_linearly(values, at, known)
    assert np.allclose(found, [[1, 10], [1, 10], [1.5, 15], [3, 30], [4, 40], [4, 40]])
    assert np.isnan(values[0, 0])  # the argument is untouched


def test_complete_or_unknown_values_are_unchanged():
    values = np.arange(6.0).reshape(3, 2)
    for known in (np.zeros(3, bool), np.ones(3, bool)):
        assert np.array_equal(filled_linearly(values, np.arange(3), known), values)


TIMES = np.array([0.0, 0.066, 0.134, 0.2, 0.266, 0.333, 0.4])


def test_a_parabola_has_its_exact_slope_inside():
    """To what the steps are uneven."""
    v, a = np.array([1.0, -0.5, 0.2]), np.array([0.5, 1.0, -0.3])
    positions = v * TIMES[:, None] + 0.5 * a * TIMES[:, None] ** 2
    found = limited_velocity(positions, TIMES, max_speed=10)
    assert np.allclose(found[1:-1], (v + a * TIMES[:, None])[1:-1], atol=1e-3)
    assert np.abs(found - (v + a * TIMES[:, None])).max() < 0.05


def test_fast_oscillation_keeps_its_speed():
    times = np.arange(60) / 15
    rate = 2 * np.pi * 2
    found = limited_velocity(np.sin(rate * times)[:, None], times, max_speed=100)
    true = rate * np.cos(rate * times)[:, None]
    fast = np.abs(true) > 0.9 * rate
    assert (found / true)[2:-2][fast[2:-2]].mean() > 0.97


def test_one_outlier_hardly_affects_its_neighbours():
    positions = np.outer(TIMES, [1.0, 0.0])
    positions[3] += [0.0, 5.0]
    found = limited_velocity(positions, TIMES, max_speed=100)
    assert np.allclose(found[[1, 5]], [1.0, 0.0])
    assert np.linalg.norm(found[[2, 4]], axis=1).max() < 2.01
    assert np.allclose(found[3], [1.0, 0.0], atol=1.5), "the jump there and back cancels"


def test_speed_is_limited_and_unknown_positions_ignored():
    positions = np.outer(TIMES, [50.0, 0.0])[:, None].repeat(2, 1)
    known = np.ones((len(TIMES), 2), bool)
    known[3, 1] = False
    positions[3, 1] = np.nan
    found = limited_velocity(positions, TIMES, max_speed=8, known=known)
    assert np.allclose(found[:, 0], [8, 0])
    assert np.allclose(found[[2, 4], 1], [8, 0]) and not found[3, 1].any()


def test_single_samples_have_no_velocity():
    assert not limited_velocity(np.ones((1, 3)), np.zeros(1), max_speed=1).any()
    apart = limited_velocity(np.array([[0.0], [1.0]]), np.array([0.0, 5.0]), max_speed=1)
    assert not apart.any()


@pytest.mark.parametrize("ends", [True, False])
@pytest.mark.parametrize(("length", "states"), [(1, 3), (2, 2), (5, 3), (6, 2)])
def test_no_other_sequence_costs_less(length, states, ends):
    rng = np.random.default_rng(10 * length + states)
    first, last = rng.random((2, states))
    steps = rng.random((length - 1, states, states))

    def cost(sequence) -> float:
        moves = sum(step[a, b] for step, a, b in zip(steps, sequence, sequence[1:], strict=False))
        return first[sequence[0]] + moves + (last[sequence[-1]] if ends else 0)

    best = min(product(range(states), repeat=length), key=cost)
    found = cheapest_sequence(first, steps, last if ends else None)
    assert tuple(found) == best
