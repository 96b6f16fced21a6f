"""Smooth 3D paths of keypoints.

Whittaker's smoother (Eilers, Analytical Chemistry 75, 2003) with third differences. The stiffness
of each path is chosen by restricted maximum likelihood: a path that is too stiff underestimates
speeds, a path that follows the noise overestimates them, and both would bias time offsets.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg.lapack import dpbtrf, dpbtrs

MAX_PATH_GAP_S = 0.35  # a path bridges at most this time without samples; tuned on the studio


@dataclass(frozen=True, eq=False)
class SmoothPaths:
    """K smooth paths through T sets."""

    times: np.ndarray
    """(T,) seconds."""
    points: np.ndarray
    """(T, K, 3) metres; NaN = unknown."""
    velocity: np.ndarray
    """(T, K, 3) m/s; NaN = unknown."""

    def at(self, wanted: np.ndarray) -> np.ndarray:
        """Points (N, K, 3) at times ``wanted`` (N,) seconds, by cubic Hermite interpolation.

        NaN outside the paths and in gaps longer than :data:`MAX_PATH_GAP_S`.
        """
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


def smooth_paths(times: np.ndarray, points: np.ndarray) -> SmoothPaths:
    """Smooth the paths of K points.

    Gaps up to :data:`MAX_PATH_GAP_S` are bridged. A path is NaN in longer gaps, and everywhere with
    fewer than six known points: third differences need four.

    Args:
        times: (T,) seconds, increasing.
        points: (T, K, 3) metres; NaN = unknown.
    """
    sets = len(points)
    known = np.isfinite(points[..., 0])
    smooth = np.full(points.shape, np.nan)
    velocity = np.full(points.shape, np.nan)
    if sets >= 6:
        penalty = _penalty(times)
        usable = np.flatnonzero(known.sum(0) >= 6)
        for k in usable:
            smooth[:, k] = _smoothed(np.nan_to_num(points[:, k]), known[:, k], penalty)
        velocity[:, usable] = CubicSpline(times, smooth[:, usable])(times, 1)
    bridged = _near_known(times, known)[..., None]
    return SmoothPaths(
        times, np.where(bridged, smooth, np.nan), np.where(bridged, velocity, np.nan)
    )


def _penalty(times: np.ndarray) -> np.ndarray:
    """D'D in SciPy's upper banded form (4, T). D (T - 3, T) gives third derivatives by divided
    differences, with time in units of the median interval."""
    gap = float(np.median(np.diff(times)))
    scaled = (times - times[0]) / gap
    rows = len(times) - 3
    weights = np.ones((rows, 4))
    for i in range(4):
        for j in range(4):
            if i != j:
                weights[:, i] /= scaled[i : i + rows] - scaled[j : j + rows]
    weights *= 6.0  # third derivative = 3! times the divided difference
    banded = np.zeros((4, len(times)))
    for i in range(4):
        for j in range(i, 4):
            banded[3 - (j - i), j : j + rows] += weights[:, i] * weights[:, j]
    return banded


def _smoothed(points: np.ndarray, known: np.ndarray, penalty: np.ndarray) -> np.ndarray:
    """Smooth one path (T, 3).

    The stiffness is the weight of the squared third differences, 0.001 to 1000. Detector errors
    that last for several sets look like motion to the likelihood. It therefore selects paths that
    are too flexible, with speeds that are too high, and the selected stiffness is multiplied by
    four; tuned on the studio.
    """
    right = points * known[:, None]
    samples, sets = int(known.sum()), len(points)
    tried, costs = 10.0 ** np.arange(-3, 4), []
    for stiffness in tried:
        factor = _factor(stiffness, known, penalty)
        path = dpbtrs(factor, right)[0]
        energy = max(float((right * (points - path)).sum()), 1e-12)
        # -2 log restricted likelihood of the three coordinates, up to a constant
        cost = 3 * (samples - 3) * np.log(energy)
        cost += 3 * (2 * np.log(factor[-1]).sum() - (sets - 3) * np.log(stiffness))
        costs.append(cost)
    likely = tried[int(np.argmin(costs))]
    path, _ = dpbtrs(_factor(4.0 * likely, known, penalty), right)
    return path


def _factor(stiffness: float, known: np.ndarray, penalty: np.ndarray) -> np.ndarray:
    """Banded Cholesky factor (4, T) of the smoother's matrix: the penalty, plus 1 at each known
    sample."""
    matrix = stiffness * penalty
    matrix[-1] += known + 1e-9
    # LAPACK itself, since SciPy's wrappers take longer than the factorisation of a short path
    factor, failed = dpbtrf(matrix)
    if failed:
        raise np.linalg.LinAlgError("the smoother's matrix is not positive definite")
    return factor


def _near_known(times: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Mask (T, K) of sets at which a path is known, or known shortly before and shortly after."""
    before = np.full(known.shape, -np.inf)
    after = np.full(known.shape, np.inf)
    before[known] = np.broadcast_to(times[:, None], known.shape)[known]
    after[known] = np.broadcast_to(times[:, None], known.shape)[known]
    before = np.maximum.accumulate(before, 0)
    after = np.minimum.accumulate(after[::-1], 0)[::-1]
    return after - before <= MAX_PATH_GAP_S
