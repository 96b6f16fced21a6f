"""Robust penalties: slopes against finite differences, limits."""

from __future__ import annotations

import numba
import numpy as np
import pytest
import torch

from intercap_core.geometry.solve.robust import geman_mcclure, geman_mcclure_weight


def test_weight_is_the_slope_of_rho() -> None:
    penalty = geman_mcclure
    squared = torch.logspace(-6, 4, 200, dtype=torch.float64)
    step = 1e-6 * squared
    slope = (penalty(squared + step, 0.7).rho - penalty(squared - step, 0.7).rho) / (2 * step)
    torch.testing.assert_close(penalty(squared, 0.7).weight, slope, rtol=1e-6, atol=1e-9)


def test_closed_form() -> None:
    squared = torch.tensor([4.0, 100.0], dtype=torch.float64)
    # the field's rho^2 r^2 / (r^2 + rho^2) with rho = 3
    expected = torch.tensor([9 * 4 / 13, 9 * 100 / 109], dtype=torch.float64)
    torch.testing.assert_close(geman_mcclure(squared, 3.0).rho, expected)


def test_small_residuals_count_in_full_and_an_outlier_stops_pulling() -> None:
    none, small, far = geman_mcclure(torch.tensor([0.0, 1e-8, 1e8]).double(), 1.0).weight.tolist()
    assert none == 1 and small == pytest.approx(1) and far * 1e4 < 1e-6


def test_weights_of_tensors_arrays_and_kernels_are_equal() -> None:
    squared = np.array([0.0, 0.5, 4.0, 1e6])
    expected = geman_mcclure(torch.from_numpy(squared), 3.0).weight.numpy()
    np.testing.assert_allclose(geman_mcclure_weight(squared, 3.0), expected, rtol=1e-15)
    kernel = numba.njit(lambda value, scale: geman_mcclure_weight(value, scale))
    np.testing.assert_allclose([kernel(s, 3.0) for s in squared], expected, rtol=1e-15)
