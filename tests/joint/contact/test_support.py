"""Whether something must hold the object, and what that says of the regions."""

import numpy as np
import pytest

from intercap_core.joint.contact.detect import (
    STANDARD_GRAVITY,
    UNHELD_PROBABILITY,
    find_held,
    support_evidence,
)

FPS = 30.0
UP = np.array([0.0, -1.0, 0.0])
TIME = np.arange(20)[:, None] / FPS


@pytest.mark.parametrize(
    ("path", "height", "expected"),
    [
        (0.5 * TIME * [1, 0, 0], 0.8, True),  # carried
        (-0.5 * STANDARD_GRAVITY * TIME**2 * UP + 0.5 * TIME * [1, 0, 0], 0.8, False),  # falls
        (0.5 * TIME * [1, 0, 0], 0.0, False),  # rolls on the floor
        (0.0 * TIME * [1, 0, 0], 0.8, False),  # stands on furniture, for all one knows
    ],
)
def test_held_is_what_neither_rests_nor_falls(path, height, expected):
    assert (find_held(path, np.full(20, height), UP, FPS) == expected).all()


def test_two_frames_say_nothing():
    assert not find_held(np.zeros((2, 3)), np.ones(2), UP, FPS).any()


def test_support_is_the_message_of_at_least_one_touching():
    probability = np.array([[0.3, 0.1, 0.0], [0.3, 0.1, 0.0], [1.0, 0.1, 0.0]])
    evidence = support_evidence(probability, np.array([True, False, True]))
    others = np.array([0.9 * 1.0, 0.7 * 1.0, 0.7 * 0.9])
    np.testing.assert_allclose(evidence[0], -np.log(1 - (1 - UNHELD_PROBABILITY) * others))
    assert (evidence[1] == 0).all()
    np.testing.assert_allclose(evidence[2, 1:], 0.0, atol=1e-6)  # one holds it: no more is needed
