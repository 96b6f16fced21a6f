"""Reliability of stated probabilities, worked by hand."""

import numpy as np

from intercap_core.evaluation.contact_figures import calibration_error, reliability


def test_reliability_by_hand():
    probability = np.array([[0.0, 0.01, 0.4, 0.4], [0.4, 0.45, 0.99, 1.0]])
    true = np.array([[0, 0, 1, 0], [0, 0, 1, 1]], bool)
    found = reliability(probability, true)
    np.testing.assert_array_equal(found.count, [2, 4, 2])
    np.testing.assert_allclose(found.stated, [0.005, 0.4125, 0.995])
    np.testing.assert_allclose(found.true, [0.0, 0.25, 1.0])
    np.testing.assert_allclose(calibration_error(probability, true), 0.4125 - 0.25)


def test_nothing_open_has_no_calibration_error():
    assert np.isnan(calibration_error(np.array([0.0, 1.0]), np.array([False, True])))
