"""The estimate of shared parameters: prior of another fit, and the test of its shape."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from intercap_core.body_fit.definition import Definition
from intercap_core.body_fit.problem import ParameterLayout
from intercap_core.body_fit.shared_estimate import SharedEstimate
from intercap_core.geometry.solve.levenberg_marquardt import NormalEquations

BETAS, OWN, FRAMES = 10, 3, 4
SIZE = BETAS + 75 + 9


def _estimate(seed: int = 0, scale: float = 1.0) -> SharedEstimate:
    """A random Gaussian whose parameters are all correlated."""
    random = np.random.default_rng(seed)
    mean, root = scale * random.normal(size=SIZE), 0.1 * random.normal(size=(SIZE, 2 * SIZE))
    return SharedEstimate(
        "a", mean[:BETAS], mean[BETAS:-9].reshape(25, 3), mean[-9:], scale**2 * root @ root.T
    )


def _layout(earlier: SharedEstimate | None, *, fit_shared: bool = True) -> ParameterLayout:
    unknown = Definition.unknown()
    return ParameterLayout(torch.arange(OWN), BETAS, True, fit_shared, unknown, earlier)


def _equations(layout: ParameterLayout, shared: torch.Tensor) -> NormalEquations:
    size, zeros = OWN + len(shared), shared.new_zeros
    equations = NormalEquations(zeros(FRAMES), zeros(FRAMES, size), zeros(FRAMES, size, size))
    layout.add_prior(shared, equations)
    return equations


@pytest.mark.parametrize("fit_shared", [True, False])
def test_gradient_and_hessian_of_the_prior_are_its_differences(fit_shared: bool) -> None:
    layout = _layout(_estimate(), fit_shared=fit_shared)
    size = SIZE if fit_shared else BETAS
    at = torch.as_tensor(np.random.default_rng(1).normal(size=size))
    found, step = _equations(layout, at), 1e-4
    torch.testing.assert_close(found.cost, layout.prior_cost(at).expand(FRAMES))
    ways = step * torch.eye(size, dtype=torch.float64)
    slopes = torch.stack([layout.prior_cost(at + w) - layout.prior_cost(at - w) for w in ways])
    torch.testing.assert_close(found.gradient[1, OWN:], slopes / (2 * step), rtol=1e-6, atol=1e-6)
    bent = torch.stack(
        [_equations(layout, at + w).gradient[0] - _equations(layout, at - w).gradient[0]
         for w in ways]
    )  # fmt: skip
    torch.testing.assert_close(found.hessian[2, OWN:], bent / (2 * step), rtol=1e-6, atol=1e-6)
    assert not found.hessian[:, :OWN].any()


def test_one_over_the_count_frames_add_up_to_the_inverse_covariance() -> None:
    """Also for the priors without another sequence, whose parameters are independent."""
    known = _estimate()
    like = torch.zeros(1, dtype=torch.float64)
    for layout in (_layout(known), _layout(None)):
        _, precision, counts = layout.prior(like)
        whole = precision / (counts[:, None] * counts).sqrt()
        expected = np.linalg.inv(known.covariance)
        if layout.earlier is None:
            sigma = np.r_[np.ones(BETAS), np.full(75, 0.010), [0.1, 0.6, *[0.5] * 2, 0.7, 0.5, 0.6]]
            expected = np.diag(np.r_[sigma, 1.0, 1.0] ** -2.0)
        np.testing.assert_allclose(whole, expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max())


def _posterior(prior: SharedEstimate, data: np.ndarray, truth: np.ndarray) -> SharedEstimate:
    """Estimate from ``prior`` and data of information ``data`` (m, m), drawn about ``truth``."""
    covariance = np.linalg.inv(prior.precision + data)
    return _moved(prior, covariance @ (prior.precision @ prior.mean + data @ truth), covariance)


def _moved(prior: SharedEstimate, mean: np.ndarray, covariance: np.ndarray) -> SharedEstimate:
    offsets = mean[BETAS:-9].reshape(25, 3)
    return replace(prior, betas=mean[:BETAS], offsets=offsets, u=mean[-9:], covariance=covariance)


def test_shapes_of_the_same_person_agree_and_of_another_do_not() -> None:
    """Data of full rank: the step of the fit then tests the difference of two estimates."""
    prior, random = _estimate(), np.random.default_rng(2)
    data = np.linalg.inv(_estimate(3).covariance)
    noise = np.linalg.cholesky(prior.covariance + np.linalg.inv(data))
    for _ in range(100):
        measured = prior.mean + noise @ random.normal(size=SIZE)
        assert not prior.contradicts(_posterior(prior, data, measured))
    # the difference of the betas in standard deviations, along one axis
    apart = noise[:, 0] / np.linalg.norm(np.linalg.solve(noise, noise[:, 0]))
    assert not prior.contradicts(_posterior(prior, data, prior.mean + 4 * apart))
    assert prior.contradicts(_posterior(prior, data, prior.mean + 12 * apart))


def test_data_without_information_on_the_shape_contradict_nothing() -> None:
    prior = _estimate()
    assert not prior.contradicts(prior)
