"""Gap filling against values worked out by hand."""

from __future__ import annotations

import numpy as np

from intercap_core.geometry.solve.time_series import filled_linearly


def test_gaps_are_straight_and_ends_are_held():
    values = np.array([[np.nan, 0], [1, 10], [np.nan, 0], [np.nan, 0], [4, 40], [np.nan, 0]])
    at = np.array([0.0, 1.0, 1.5, 3.0, 4.0, 9.0])
    known = np.array([False, True, False, False, True, False])
    found = filled_linearly(values, at, known)
    assert np.allclose(found, [[1, 10], [1, 10], [1.5, 15], [3, 30], [4, 40], [4, 40]])
    assert np.isnan(values[0, 0])  # the argument is untouched


def test_nothing_known_or_nothing_missing_changes_nothing():
    values = np.arange(6.0).reshape(3, 2)
    for known in (np.zeros(3, bool), np.ones(3, bool)):
        assert np.array_equal(filled_linearly(values, np.arange(3), known), values)
