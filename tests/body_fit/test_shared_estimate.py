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
SIZE = BETAS + 9  # of an estimate
SHARED = BETAS + 75 + 9
SUBJECT = np.r_[:BETAS, BETAS + 75 : SHARED]


def _estimate(seed: int = 0, scale: float = 1.0) -> SharedEstimate:
    """A random Gaussian whose parameters are all correlated."""
    random = np.random.default_rng(seed)
    mean, root = scale * random.normal(size=SIZE), 0.1 * random.normal(size=(SIZE, 2 * SIZE))
    return SharedEstimate("a", mean[:BETAS], mean[BETAS:], scale**2 * root @ root.T)


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
    size = SHARED if fit_shared else BETAS
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
    """Without another sequence, and those of offsets also with one, they are independent."""
    known = _estimate()
    like = torch.zeros(1, dtype=torch.float64)
    for layout in (_layout(known), _layout(None)):
        _, precision, counts = layout.prior(like)
        whole = precision / (counts[:, None] * counts).sqrt()
        sigma = np.r_[np.ones(BETAS), np.full(75, 0.010), [0.1, 0.6, *[0.5] * 2, 0.7, 0.5, 0.6]]
        expected = np.diag(np.r_[sigma, 1.0, 1.0] ** -2.0)
        if layout.earlier is not None:
            expected[np.ix_(SUBJECT, SUBJECT)] = np.linalg.inv(known.covariance)
        np.testing.assert_allclose(whole, expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max())


def test_shapes_of_one_person_agree_and_of_two_do_not() -> None:
    """Distances of the betas in standard deviations of the difference, along one axis."""
    one, other = _estimate(), _estimate(3)
    root = np.linalg.cholesky((one.covariance + other.covariance)[:BETAS, :BETAS])
    for distance, differ in ((5.0, False), (9.0, True)):
        assert one.contradicts(replace(other, betas=one.betas + distance * root[:, 0])) is differ
