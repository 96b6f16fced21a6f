"""Robust penalties: slopes against finite differences, limits."""

from __future__ import annotations

import pytest
import torch

from intercap_core.solve.robust import geman_mcclure, huber


@pytest.mark.parametrize("penalty", [huber, geman_mcclure])
def test_weight_is_the_slope_of_rho(penalty) -> None:
    squared = torch.logspace(-6, 4, 200, dtype=torch.float64)
    step = 1e-6 * squared
    slope = (penalty(squared + step, 0.7).rho - penalty(squared - step, 0.7).rho) / (2 * step)
    torch.testing.assert_close(penalty(squared, 0.7).weight, slope, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("penalty", [huber, geman_mcclure])
def test_small_residuals_count_in_full(penalty) -> None:
    value = penalty(torch.tensor([0.0, 1e-8], dtype=torch.float64), 1.0)
    torch.testing.assert_close(value.weight, torch.ones(2, dtype=torch.float64))
    assert value.rho[0] == 0


def test_closed_forms() -> None:
    squared = torch.tensor([4.0, 100.0], dtype=torch.float64)
    # Huber at r = 2, 10 with scale 3: r^2, then 2 * 3 * 10 - 9
    torch.testing.assert_close(huber(squared, 3.0).rho, torch.tensor([4.0, 51.0]).double())
    # the field's rho^2 r^2 / (r^2 + rho^2) with rho = 3
    expected = torch.tensor([9 * 4 / 13, 9 * 100 / 109], dtype=torch.float64)
    torch.testing.assert_close(geman_mcclure(squared, 3.0).rho, expected)


def test_an_outlier_stops_pulling_only_under_geman_mcclure() -> None:
    far = torch.tensor([1e8], dtype=torch.float64)
    assert (huber(far, 1.0).weight * far.sqrt()).item() == pytest.approx(1.0)
    assert (geman_mcclure(far, 1.0).weight * far.sqrt()).item() < 1e-6
