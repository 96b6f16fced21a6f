"""Priors of the body, weighed and summed."""

from __future__ import annotations

import pytest
import torch

from intercap_core.body.model import BodyModel
from intercap_core.body_fit import body_priors


@pytest.mark.parametrize("shape", [True, False])
def test_gradient_matches_differences(model: BodyModel, shape: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    x = 0.4 * torch.randn(3, model.num_parameters, dtype=torch.float64, generator=generator)
    direction = torch.randn(*x.shape, dtype=torch.float64, generator=generator)
    cost, gradient, hessian = body_priors.assemble(model, x, shape=shape)
    torch.testing.assert_close(cost, body_priors.cost(model, x, shape=shape))
    step = 1e-6
    slope = (
        body_priors.cost(model, x + step * direction, shape=shape)
        - body_priors.cost(model, x - step * direction, shape=shape)
    ) / (2 * step)
    torch.testing.assert_close((gradient * direction).sum(1), slope, rtol=1e-6, atol=1e-6)
    assert bool((torch.linalg.eigvalsh(hessian) > -1e-8).all())


def test_betas_are_left_to_the_caller(model: BodyModel) -> None:
    x = torch.zeros(1, model.num_parameters, dtype=torch.float64)
    x[:, 168:178] = 2.0
    at_zero = torch.zeros_like(x)
    alone = body_priors.cost(model, x, shape=False) - body_priors.cost(model, at_zero, shape=False)
    both = body_priors.cost(model, x, shape=True) - body_priors.cost(model, at_zero, shape=True)
    assert alone.item() == pytest.approx(0.0)
    assert both.item() == pytest.approx(0.5 * 10 * 4.0)


def test_a_hand_s_pose_that_lasts_counts_once(model: BodyModel) -> None:
    """Five frames with a fifth of the hands' prior each cost what one frame costs, and the rest of
    the priors stays as it is."""
    generator = torch.Generator().manual_seed(1)
    x = torch.zeros(1, model.num_parameters, dtype=torch.float64)
    x[:, 75:165] = torch.cat([model.hand_mean[0], model.hand_mean[1]])
    at_mean = body_priors.cost(model, x, shape=True, hand_share=0.2)
    torch.testing.assert_close(at_mean, body_priors.cost(model, x, shape=True))
    y = x.clone()
    y[:, 75:165] += 0.1 * torch.randn(90, dtype=torch.float64, generator=generator)
    limits = sum(rows.energy(weight) for rows, weight in body_priors.terms(model, y)[:3]) - sum(
        rows.energy(weight) for rows, weight in body_priors.terms(model, x)[:3]
    )
    once = body_priors.cost(model, y, shape=True) - at_mean - limits
    fifth = body_priors.cost(model, y, shape=True, hand_share=0.2) - at_mean - limits
    assert once.item() > 1
    torch.testing.assert_close(5 * fifth, once)
