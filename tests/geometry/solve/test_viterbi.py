"""The cheapest sequence of states against all sequences, and against a case worked by hand."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from intercap_core.geometry.solve.time_series import cheapest_sequence


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


def test_a_detour_is_not_worth_its_way_back():
    stay_or_go = np.array([[0.0, 2.0], [2.0, 0.0]])
    own = np.array([0.0, 3.0]), np.array([3.0, 0.0]), np.array([0.0, 3.0])
    steps = np.stack([stay_or_go + cost for cost in own[1:]])
    np.testing.assert_array_equal(cheapest_sequence(own[0], steps), [0, 0, 0])
    np.testing.assert_array_equal(cheapest_sequence(own[0], steps - stay_or_go), [0, 1, 0])
