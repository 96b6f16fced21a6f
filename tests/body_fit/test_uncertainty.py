"""The stated deviation of joints against the covariance of the whole problem."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from intercap_core.body.model import BodyModel
from intercap_core.body_fit.problem import columns_of
from intercap_core.body_fit.quality import PartEvidence
from intercap_core.body_fit.schedule import BodyFit, Settled
from intercap_core.body_fit.uncertainty import deviation, fit_covariances, widen
from intercap_core.schemas import BODY_PARTS

SHARED = 10 + 75 + 8
MODEL_M = 0.001


def _fit(model: BodyModel, frames: int, counts: float, excess: float = 1.0) -> BodyFit:
    """Equal frames of a random energy."""
    columns = columns_of(model, hands=True, face=True, betas=False)
    size = len(columns) + SHARED
    rows = torch.randn(1, 2 * size, size, generator=torch.Generator().manual_seed(0))
    hessian = 50 * (rows.transpose(1, 2) @ rows).double().expand(frames, -1, -1)
    vectors = model.zeros(frames).vector()
    nothing = torch.zeros(frames)
    parts = PartEvidence(*[nothing] * 5, torch.full((frames, len(BODY_PARTS)), excess))
    return BodyFit(
        np.arange(frames), vectors, columns, hessian, True, torch.full((SHARED,), counts),
        nothing, nothing, Settled(*[nothing] * 5), parts, np.zeros(frames, bool),
    )  # fmt: skip


def _sigma(model: BodyModel, fit: BodyFit) -> np.ndarray:
    return deviation(fit_covariances(model, fit).joints.numpy())


def _whole(model: BodyModel, fit: BodyFit) -> np.ndarray:
    """(55,) deviations from the inverse of one frame's whole Hessian."""
    lin = model.linearise(
        model.parameters(fit.vectors[:1]), vertex_ids=np.array([0]), joints=True
    )  # fmt: skip
    full = lin.full()[0, 1:].double().reshape(165, -1)
    by = torch.zeros(165, fit.hessian.shape[1], dtype=torch.float64)
    by[:, : len(fit.columns)] = full[:, fit.columns]
    by[:, len(fit.columns) : len(fit.columns) + 10] = full[:, 168:178]
    variance = (by @ torch.linalg.inv(fit.hessian[0]) * by).sum(1)
    return np.asarray((variance.reshape(55, 3).mean(1) + MODEL_M**2).sqrt())


@pytest.mark.parametrize("frames", [1, 20])
def test_frames_whose_priors_count_fully_are_worth_one_frame(model, frames):
    fit = _fit(model, frames, 1.0)
    stated = _sigma(model, fit)
    assert stated.shape == (frames, 55) and stated.min() > 2 * MODEL_M
    np.testing.assert_allclose(stated, _whole(model, fit)[None].repeat(frames, 0), rtol=1e-4)


def test_priors_that_count_less_make_frames_independent(model):
    once, seldom, never = (_sigma(model, _fit(model, 3, counts)) for counts in (1.0, 0.25, 1e-9))
    np.testing.assert_allclose(
        seldom**2 - never**2, (once**2 - never**2) / 4, rtol=1e-3, atol=1e-10
    )


def test_residuals_above_their_noise_widen_a_frame(model):
    one, four = (_sigma(model, _fit(model, 2, 1e-9, e)) for e in (1.0, 4.0))
    np.testing.assert_allclose(four**2 - MODEL_M**2, 4 * (one**2 - MODEL_M**2), rtol=1e-4)


def test_covariances_are_widened_in_all_directions():
    covariance = np.diag([1e-4, 4e-4, 9e-4])[None].repeat(2, 0)
    sigma = deviation(covariance)
    np.testing.assert_allclose(sigma, np.sqrt(14e-4 / 3))
    wider = widen(covariance, np.array([sigma[0], 0.05]))
    np.testing.assert_allclose(wider[0], covariance[0], atol=1e-12)
    np.testing.assert_allclose(deviation(wider)[1], 0.05)
    np.testing.assert_allclose(wider[1] - covariance[1], np.eye(3) * (0.05**2 - sigma[0] ** 2))
