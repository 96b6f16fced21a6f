"""Time offsets from residuals that are made by the equation and by projection."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.joint.time_offsets import (
    LOOSE_OFFSET_SIGMA_S,
    OffsetPrior,
    PointObservations,
    estimate_offsets,
)

FPS = 15.0
T, C, K = 60, 5, 30
TRUE = np.array([0.0, 6.0, -7.0, 2.5, -4.0]) * 1e-3
NOTHING = OffsetPrior(np.zeros(C), np.full(C, np.nan), 0)
TIMES = np.arange(T) / FPS
PX_PER_M = 350.0


def _smooth(rng, shape, seconds: float) -> np.ndarray:
    """Unit noise (T, ...) that lasts ``seconds``."""
    keep = np.exp(-1 / (FPS * seconds))
    values = rng.normal(size=shape)
    for t in range(1, shape[0]):
        values[t] = keep * values[t - 1] + np.sqrt(1 - keep**2) * values[t]
    return values


def _sightings(seed: int = 0, *, late: np.ndarray = TRUE, lasting_px=4.0, noise_px=1.0):
    """Points of a person who moves at about 0.6 m/s, seen by C orthographic views all around."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0, 2 * np.pi, (K, 3))
    rate = rng.uniform(2, 5, (K, 3))
    angle = rate * TIMES[:, None, None] + phase
    speed = 0.8 * np.cos(angle)
    views = np.linalg.qr(rng.normal(size=(C, 3, 3)))[0][:, :2] * PX_PER_M  # (C, 2, 3)
    velocity = np.einsum("cdp,tkp->tckd", views, speed)
    error = 0.01 * _smooth(rng, (T, K, 3), 0.3)  # of the fit, which all views share
    residual = -velocity * late[:, None, None] + np.einsum("cdp,tkp->tckd", views, error)
    residual += 6 * rng.normal(size=(1, C, K, 2))
    residual += lasting_px * _smooth(rng, (T, C, K, 2), 0.5)
    residual += noise_px * rng.normal(size=(T, C, K, 2))
    by_point = np.broadcast_to(views[None, :, None], (T, C, K, 2, 3))
    weight = (rng.uniform(size=(T, C, K)) < 0.8).astype(float)
    return PointObservations(residual, velocity, by_point, weight, np.arange(K))


def _within(found, most: float) -> bool:
    """Every camera to ``most`` seconds and to three of its stated deviations."""
    away = np.abs(found.offset - TRUE)[1:]
    return bool((away < most).all() and (away < 3 * found.sigma[1:]).all())


def test_offsets_are_found_under_lasting_errors_and_the_sigma_is_honest():
    errors, stated = [], []
    for seed in range(6):
        found = estimate_offsets([_sightings(seed)], TIMES, np.zeros(C), NOTHING)
        assert found.offset[0] == 0 and found.sigma[0] == 0
        errors.append((found.offset - TRUE)[1:])
        stated.append(found.sigma[1:])
    errors, stated = np.array(errors), np.array(stated)
    assert np.abs(errors).mean() < 1.2e-3
    assert 0.5 < np.sqrt(np.mean((errors / stated) ** 2)) < 2.0


def test_what_the_fit_allows_for_already_is_added():
    current = 0.7 * TRUE
    found = estimate_offsets([_sightings(late=TRUE - current)], TIMES, current, NOTHING)
    assert _within(found, 1.5e-3)


def test_a_shared_shift_of_the_fit_along_the_motion_is_no_offset():
    """A fit that follows the mean of all cameras is itself late; only the views' difference to the
    master counts."""
    found = estimate_offsets([_sightings(late=TRUE - 0.003)], TIMES, np.zeros(C), NOTHING)
    assert _within(found, 1.5e-3)


def test_outliers_and_swaps_are_left_out():
    seen = _sightings()
    rng = np.random.default_rng(1)
    wrong = rng.uniform(size=seen.weight.shape) < 0.05
    seen.residual[wrong] += 80 * rng.normal(size=(wrong.sum(), 2))
    found = estimate_offsets([seen], TIMES, np.zeros(C), NOTHING)
    assert _within(found, 2e-3)


def test_without_motion_the_prior_stays():
    seen = _sightings(late=np.zeros(C))
    still = PointObservations(
        seen.residual, 0 * seen.velocity, seen.by_point, seen.weight, seen.part
    )
    given = OffsetPrior(TRUE, np.array([0, 1, 1, np.nan, 2]) * 1e-3, 0)
    found = estimate_offsets([still], TIMES, np.zeros(C), given)
    assert found.offset == pytest.approx([0, TRUE[1], TRUE[2], 0, TRUE[4]])
    assert found.sigma == pytest.approx([0, 1e-3, 1e-3, LOOSE_OFFSET_SIGMA_S, 2e-3], rel=1e-3)
    assert estimate_offsets([], TIMES, np.zeros(C), given).offset == pytest.approx(found.offset)


def test_a_camera_that_sees_nothing_keeps_its_prior():
    seen = _sightings()
    seen.weight[:, 3] = 0
    found = estimate_offsets([seen], TIMES, np.zeros(C), NOTHING)
    assert found.offset[3] == pytest.approx(0) and found.sigma[3] == pytest.approx(
        LOOSE_OFFSET_SIGMA_S
    )
    assert np.abs(found.offset - TRUE)[[1, 2, 4]].max() < 1.5e-3


def test_distances_along_a_normal_tell_too():
    """One number a view, one coordinate of the point that all views share."""
    rng = np.random.default_rng(3)
    speed = 0.6 * np.cos(4 * TIMES[:, None] + rng.uniform(0, 6, 200))
    velocity = np.repeat(speed[:, None, :, None], C, 1)
    error = 0.01 * _smooth(rng, (T, 200), 0.3)
    residual = -velocity * TRUE[:, None, None] + error[:, None, :, None]
    residual += 0.005 * rng.normal(size=(1, C, 200, 1)) + 0.004 * rng.normal(size=residual.shape)
    weight = (rng.uniform(size=(T, C, 200)) < 0.4).astype(float)
    seen = PointObservations(
        residual, velocity, np.ones((*residual.shape, 1)), weight, np.arange(200) // 8
    )
    found = estimate_offsets([seen], TIMES, np.zeros(C), NOTHING)
    assert _within(found, 1.5e-3)
