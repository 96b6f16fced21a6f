"""Smooth paths of points from noisy positions, the smoothness chosen by likelihood.

Whittaker's smoother (Eilers, Analytical Chemistry 75, 2003) with third differences; each point's
stiffness follows from the one of greatest restricted likelihood. A path that is too stiff
underestimates speeds, one that follows the noise overestimates them: both would bias estimates from
speeds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import cho_solve_banded, cholesky_banded

from intercap_core.scene.constants import MAX_PATH_GAP_S, MIN_PATH_SAMPLES, STIFFER, STIFFNESS

ORDER = 3


@dataclass(frozen=True, eq=False)
class Paths:
    """K smooth paths through T sets at ``times`` (T,) s: ``points`` (T, K, 3) m and ``velocity``
    (T, K, 3) m/s, NaN = not known."""

    times: np.ndarray
    points: np.ndarray
    velocity: np.ndarray

    def at(self, wanted: np.ndarray) -> np.ndarray:
        """Points (N, K, 3) at times ``wanted`` (N,): cubic between neighbours, NaN outside the
        paths and over long gaps."""
        times, last = self.times, len(self.times) - 1
        left = np.clip(np.searchsorted(times, wanted, side="right") - 1, 0, max(last - 1, 0))
        right = np.minimum(left + 1, last)
        length = np.maximum(times[right] - times[left], 1e-9)[:, None, None]
        u = (wanted - times[left])[:, None, None] / length
        from_left = (1 + u * u * (2 * u - 3)) * self.points[left]
        from_left += u * (1 - u) ** 2 * length * self.velocity[left]
        from_right = u * u * (3 - 2 * u) * self.points[right]
        from_right -= u * u * (1 - u) * length * self.velocity[right]
        inside = (u >= -1e-6) & (u <= 1 + 1e-6) & (length <= MAX_PATH_GAP_S)
        return np.where(inside, from_left + from_right, np.nan)


def smooth_paths(times: np.ndarray, points: np.ndarray) -> Paths:
    """Smooth ``points`` (T, K, 3), NaN = not known, at increasing ``times`` (T,) s."""
    sets = len(points)
    known = np.isfinite(points[..., 0])
    smooth = np.full(points.shape, np.nan)
    velocity = np.full(points.shape, np.nan)
    if sets >= MIN_PATH_SAMPLES:
        penalty = _penalty(times)
        usable = np.flatnonzero(known.sum(0) >= MIN_PATH_SAMPLES)
        for k in usable:
            smooth[:, k] = _smoothed(np.nan_to_num(points[:, k]), known[:, k], penalty)
        velocity[:, usable] = CubicSpline(times, smooth[:, usable])(times, 1)
    bridged = _near_known(times, known)[..., None]
    return Paths(times, np.where(bridged, smooth, np.nan), np.where(bridged, velocity, np.nan))


def _penalty(times: np.ndarray) -> np.ndarray:
    """D'D in upper banded form (4, T), D third divided differences in units of the usual gap."""
    gap = float(np.median(np.diff(times)))
    scaled = (times - times[0]) / gap
    rows = len(times) - ORDER
    weights = np.ones((rows, ORDER + 1))
    for i in range(ORDER + 1):
        for j in range(ORDER + 1):
            if i != j:
                weights[:, i] /= scaled[i : i + rows] - scaled[j : j + rows]
    weights *= 6.0  # third derivative = 3! times the divided difference
    banded = np.zeros((ORDER + 1, len(times)))
    for i in range(ORDER + 1):
        for j in range(i, ORDER + 1):
            banded[ORDER - (j - i), j : j + rows] += weights[:, i] * weights[:, j]
    return banded


def _smoothed(points: np.ndarray, known: np.ndarray, penalty: np.ndarray) -> np.ndarray:
    """One path (T, 3), :data:`STIFFER` than the one of greatest restricted likelihood."""
    right = points * known[:, None]
    samples, sets = int(known.sum()), len(points)
    costs = []
    for stiffness in STIFFNESS:
        factor = _factor(stiffness, known, penalty)
        path = cho_solve_banded((factor, False), right)
        energy = max(float((right * (points - path)).sum()), 1e-12)
        cost = 3 * (samples - ORDER) * np.log(energy)
        cost += 3 * (2 * np.log(factor[-1]).sum() - (sets - ORDER) * np.log(stiffness))
        costs.append(cost)
    likely = STIFFNESS[int(np.argmin(costs))]
    return cho_solve_banded((_factor(STIFFER * likely, known, penalty), False), right)


def _factor(stiffness: float, known: np.ndarray, penalty: np.ndarray) -> np.ndarray:
    matrix = stiffness * penalty
    matrix[-1] += known + 1e-9
    return cholesky_banded(matrix)


def _near_known(times: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Whether (T, K) a path is known at a set, or was shortly before and is shortly after."""
    before = np.full(known.shape, -np.inf)
    after = np.full(known.shape, np.inf)
    before[known] = np.broadcast_to(times[:, None], known.shape)[known]
    after[known] = np.broadcast_to(times[:, None], known.shape)[known]
    before = np.maximum.accumulate(before, 0)
    after = np.minimum.accumulate(after[::-1], 0)[::-1]
    return after - before <= MAX_PATH_GAP_S
