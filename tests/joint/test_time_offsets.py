"""Time offsets from synthetic residuals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from intercap_core.joint.time_offsets import (
    OffsetEstimate,
    OffsetPrior,
    PointObservations,
    estimate_offsets,
)
from intercap_core.scene.starts import PRIOR_OFFSET_S

FPS = 15.0
T, C, K = 60, 5, 30
TRUE = np.array([0.0, 6.0, -7.0, 2.5, -4.0]) * 1e-3
ZERO = np.zeros(C)
NO_PRIOR = OffsetPrior(ZERO, np.full(C, np.nan), 0)
TIMES = np.arange(T) / FPS
PX_PER_M = 350.0


def _smooth(rng, shape, seconds: float) -> np.ndarray:
    """Unit noise (T, ...) that lasts ``seconds``."""
    keep = np.exp(-1 / (FPS * seconds))
    values = rng.normal(size=shape)
    for t in range(1, shape[0]):
        values[t] = keep * values[t - 1] + np.sqrt(1 - keep**2) * values[t]
    return values


def _observe(seed: int = 0, late: np.ndarray = TRUE) -> PointObservations:
    """Points of a person who moves at about 0.6 m/s, in C orthographic views all around."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0, 2 * np.pi, (K, 3))
    rate = rng.uniform(2, 5, (K, 3))
    speed = 0.8 * np.cos(rate * TIMES[:, None, None] + phase)
    views = np.linalg.qr(rng.normal(size=(C, 3, 3)))[0][:, :2] * PX_PER_M  # (C, 2, 3)
    velocity = np.einsum("cdp,tkp->tckd", views, speed)
    error = 0.01 * _smooth(rng, (T, K, 3), 0.3)  # of the fit, which all views share
    residual = -velocity * late[:, None, None] + np.einsum("cdp,tkp->tckd", views, error)
    residual += 6 * rng.normal(size=(1, C, K, 2))
    residual += 4.0 * _smooth(rng, (T, C, K, 2), 0.5)
    residual += rng.normal(size=(T, C, K, 2))
    by_point = np.broadcast_to(views[None, :, None], (T, C, K, 2, 3))
    weight = (rng.uniform(size=(T, C, K)) < 0.8).astype(float)
    return PointObservations(residual, velocity, by_point, weight, np.arange(K))


def _estimate(observations: PointObservations, current: np.ndarray = ZERO) -> OffsetEstimate:
    return estimate_offsets([observations], TIMES, current, NO_PRIOR)


def _is_within(estimate: OffsetEstimate, limit: float) -> bool:
    """Whether all errors are below ``limit`` seconds and three stated standard deviations."""
    error = np.abs(estimate.offset - TRUE)[1:]
    return bool((error < limit).all() and (error < 3 * estimate.sigma[1:]).all())


def test_residuals_of_zero_are_no_proof():
    """A part whose residuals vanish, as of copied frames, neither decides nor narrows."""
    usual = _observe()
    residual = usual.residual.copy()
    residual[:, :, 3] = 0
    copied, without = (
        _estimate(replace(usual, residual=residual)),
        _estimate(replace(usual, weight=usual.weight * (np.arange(K) != 3))),
    )
    assert (copied.sigma[1:] > 0.3 * without.sigma[1:]).all()
    assert _is_within(copied, 0.004)
    assert _estimate(replace(usual, residual=0 * residual)).sigma[1:] == pytest.approx(
        PRIOR_OFFSET_S
    )


def test_errors_are_as_large_as_stated_under_lasting_noise():
    errors, stated = [], []
    for seed in range(6):
        estimate = _estimate(_observe(seed))
        assert estimate.offset[0] == 0 and estimate.sigma[0] == 0
        errors.append((estimate.offset - TRUE)[1:])
        stated.append(estimate.sigma[1:])
    errors, stated = np.array(errors), np.array(stated)
    assert np.abs(errors).mean() < 1.2e-3
    assert 0.5 < np.sqrt(np.mean((errors / stated) ** 2)) < 2.0


def test_current_offsets_and_a_shift_of_all_cameras():
    """Only differences to the master count: a fit that follows all cameras is itself late."""
    assert _is_within(_estimate(_observe(late=0.3 * TRUE), 0.7 * TRUE), 1.5e-3)
    assert _is_within(_estimate(_observe(late=TRUE - 0.003)), 1.5e-3)


def test_outliers_and_swaps_have_no_effect():
    observations = _observe()
    rng = np.random.default_rng(1)
    wrong = rng.uniform(size=observations.weight.shape) < 0.05
    observations.residual[wrong] += 80 * rng.normal(size=(wrong.sum(), 2))
    assert _is_within(_estimate(observations), 2e-3)


def test_prior_is_kept_without_motion():
    observations = _observe(late=ZERO)
    still = replace(observations, velocity=0 * observations.velocity)
    prior = OffsetPrior(TRUE, np.array([0, 1, 1, np.nan, 2]) * 1e-3, 0)
    estimate = estimate_offsets([still], TIMES, ZERO, prior)
    assert estimate.offset == pytest.approx([0, TRUE[1], TRUE[2], 0, TRUE[4]])
    assert estimate.sigma == pytest.approx([0, 1e-3, 1e-3, PRIOR_OFFSET_S, 2e-3], rel=1e-3)
    without = estimate_offsets([], TIMES, ZERO, prior)
    assert without.offset == pytest.approx(estimate.offset)


def test_camera_without_observations_keeps_its_prior():
    observations = _observe()
    observations.weight[:, 3] = 0
    estimate = _estimate(observations)
    assert estimate.offset[3] == pytest.approx(0)
    assert estimate.sigma[3] == pytest.approx(PRIOR_OFFSET_S)
    assert np.abs(estimate.offset - TRUE)[[1, 2, 4]].max() < 1.5e-3


def test_distances_along_a_normal_are_informative():
    """A view measures a number, and all views share a coordinate of the point."""
    rng = np.random.default_rng(3)
    speed = 0.6 * np.cos(4 * TIMES[:, None] + rng.uniform(0, 6, 200))
    velocity = np.repeat(speed[:, None, :, None], C, 1)
    error = 0.01 * _smooth(rng, (T, 200), 0.3)
    residual = -velocity * TRUE[:, None, None] + error[:, None, :, None]
    residual += 0.005 * rng.normal(size=(1, C, 200, 1)) + 0.004 * rng.normal(size=residual.shape)
    weight = (rng.uniform(size=(T, C, 200)) < 0.4).astype(float)
    by_point, part = np.ones((*residual.shape, 1)), np.arange(200) // 8
    observations = PointObservations(residual, velocity, by_point, weight, part)
    assert _is_within(_estimate(observations), 1.5e-3)
