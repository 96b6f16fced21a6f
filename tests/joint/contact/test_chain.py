"""The chain of contact and of standing."""

from itertools import pairwise, product

import numpy as np
import pytest

from intercap_core.joint.contact.chain import DwellChain

FPS = 15.0
TOUCH = DwellChain(0.6, (0.3, 3.0), (0.8, 0.2))


@pytest.mark.parametrize("chain", [DwellChain(0.2, (1.0,), (1.0,)), TOUCH])
def test_posterior_equals_enumeration_of_all_paths(chain):
    evidence = np.array([[1.0], [-2.0], [0.5], [3.0]])
    states = 1 + len(chain.durations)
    start, transition = chain.start(), chain.transition(FPS)
    total, touching = 0.0, np.zeros(4)
    for path in product(range(states), repeat=4):
        on = np.array(path) > 0
        weight = start[path[0]] * np.exp(evidence[on, 0].sum())
        for before, after in pairwise(path):
            weight *= transition[before, after]
        total += weight
        touching += weight * on
    got = chain.posterior(evidence, FPS)
    np.testing.assert_allclose(got[:, 0], touching / total, rtol=1e-9)


@pytest.mark.parametrize("fps", [1.0, 15.0, 30.0])
def test_rows_of_the_transition_are_probabilities(fps):
    transition = TOUCH.transition(fps)
    np.testing.assert_allclose(transition.sum(axis=1), 1.0)
    assert (transition >= 0).all()


def test_what_is_not_seen_keeps_the_state_before_anything_is_seen():
    got = TOUCH.posterior(np.zeros((40, 1)), FPS)
    np.testing.assert_allclose(got, 1 - TOUCH.start()[0], rtol=1e-9)


def test_short_stays_pay_and_long_ones_are_not_forgotten():
    evidence = np.full((60, 1), -3.0)
    evidence[20:24] = 2.5
    assert (TOUCH.posterior(evidence, FPS)[20:24] > 0.5).all()
    held = np.full((60, 1), 3.0)
    held[15:45] = 0.0
    assert (TOUCH.posterior(held, FPS) > 0.5).all()
