"""Temporal covariance of a detector's errors, estimated from the residuals themselves.

A series' covariance is the sum of three: a constant of any size, a process correlated over time,
and white noise of each image. The kind and length of the correlated part are chosen by likelihood
from a short list, for all keypoints and views together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.geometry.solve.gaps import filled_linearly
from intercap_core.scene.constants import (
    CONSTANT_VARIANCE,
    ERROR_LENGTHS_S,
    FAST_SHARES,
    MIN_VALID_SHARE,
)


@dataclass(frozen=True)
class TimeNoise:
    """``kind`` "rough" exp(-|d| / length) or "smooth" exp(-d^2 / (2 length^2)); ``length`` s;
    ``fast`` share of the variance that is new in each image; ``scale``: standard deviation;
    ``constant``: variance of what never changes, of the rest's."""

    kind: str
    length: float
    fast: float
    scale: float
    constant: float = CONSTANT_VARIANCE

    def covariance(self, times: np.ndarray) -> np.ndarray:
        """(T, T), of unit ``scale``, with the constant part."""
        return _covariance(times, self.kind, self.length, self.fast) + self.constant

    def precision(self, times: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """Inverse covariances (N, T, T) of N series, in units of ``scale``; ``variance`` (N, T) is
        added to each sample: :data:`MISSING_VARIANCE` where there is none."""
        whole = np.broadcast_to(self.covariance(times), (*variance.shape, len(times))).copy()
        rows = np.arange(len(times))
        whole[:, rows, rows] += variance
        return np.linalg.inv(whole) / self.scale**2


def fit_noise(times: np.ndarray, series: np.ndarray, valid: np.ndarray) -> TimeNoise:
    """Choose the noise model for ``series`` (N, T) of unit variance, from those with few gaps."""
    whole = np.flatnonzero(valid.mean(1) >= MIN_VALID_SHARE)
    if len(whole) < 10 or len(times) < 8:
        return TimeNoise("rough", 0.5, 0.25, 1.0)
    rows = np.where(valid[whole], series[whole], np.nan)
    steps = np.arange(rows.shape[1])
    rows = np.stack([filled_linearly(row[:, None], steps, np.isfinite(row))[:, 0] for row in rows])
    best, chosen = -np.inf, TimeNoise("rough", 0.5, 0.25, 1.0)
    for kind, lengths in ERROR_LENGTHS_S.items():
        for length in lengths:
            for fast in FAST_SHARES:
                covariance = _covariance(times, kind, length, fast) + CONSTANT_VARIANCE
                low = np.linalg.cholesky(covariance)
                energy = (np.linalg.solve(low, rows.T) ** 2).sum(0)
                # Median over series: some are of occluded joints, some of an unsynchronised camera.
                scale = max(float(np.median(energy)) / max(len(times) - 1.7, 1), 1e-6)
                found = -np.log(np.diag(low)).sum() - len(times) / 2 * np.log(scale)
                if found > best:
                    best, chosen = found, TimeNoise(kind, length, fast, float(np.sqrt(scale)))
    return chosen


def _covariance(times: np.ndarray, kind: str, length: float, fast: float) -> np.ndarray:
    apart = np.abs(times[:, None] - times) / length
    lasting = np.exp(-apart) if kind == "rough" else np.exp(-(apart**2) / 2)
    return (1 - fast) * lasting + fast * np.eye(len(times))
