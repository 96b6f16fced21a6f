"""Stated error of a part, in metres, from the held-out evaluation.

    error^2 = rest^2 + (a shift)^2 + (b keypoint)^2 + (c sigma)^2 + (d moved)^2

The four features are in metres:

- ``shift``: jackknife over the V cameras (Efron 1982), sqrt((V - 1) / V sum_v d_v^2), where d_v is
  the displacement of the part without camera v. It measures independent errors of calibration,
  masks and keypoints.
- ``keypoint``: keypoint error in the held-out camera, at the person's distance.
- ``sigma``: standard deviation that the sequential fits state.
- ``moved``: displacement from the sequential fits to the joint fit.

``rest`` stands for errors that all cameras share, so that no held-out camera shows them: clothing,
the detector's definition of a joint, the object's mesh.

``python -m bench.verdict`` fits the factors to the studio's truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from intercap_core.evaluation.figures import finite_median
from intercap_core.evaluation.verdict.hold_out import HeldOut, JudgedPart


class Factors(NamedTuple):
    """Parameters of the stated error of one part."""

    rest: float
    """Error that no held-out camera shows, metres."""
    of: tuple[float, float, float, float]
    """Factors a, b, c, d of the FEATURES."""
    spread: float
    """80 % of the true errors are within this factor of the stated error."""


# Fitted to 41 recordings of the virtual studio by `python -m bench.verdict`: two to six cameras,
# with and without depth, noise scales 1 and 2, other body builds, people without an object, and a
# balance beam. The spreads are cross-validated: each kind of recording was left out once.
FACTORS = {
    JudgedPart.BODY: Factors(0.0041, (1.55, 0.07, 0.69, 1.08), 1.28),
    JudgedPart.HANDS: Factors(0.0, (0.97, 0.15, 0.81, 1.40), 1.25),
    JudgedPart.OBJECT: Factors(0.0013, (1.37, 0.08, 0.0, 0.0), 1.88),
}


FEATURES = ("shift", "keypoint", "sigma", "moved")


@dataclass(frozen=True, eq=False)
class ErrorEstimate:
    """The stated error of one part."""

    error: float
    """Mean over the frames, metres; NaN if no error is stated."""
    factor: float
    """80 % of the true errors are within this factor of ``error``."""
    by_frame: np.ndarray
    """(T,) metres; NaN in frames without a statement."""
    features: dict[str, float]
    """Mean of each of FEATURES, metres."""
    silent: str = ""
    """Reason why no error is stated; "" if one is stated."""


def estimate_error(
    held_out: HeldOut | None,
    part: JudgedPart,
    sigma: np.ndarray,
    moved: np.ndarray,
    known: np.ndarray,
) -> ErrorEstimate:
    """Estimate the error of ``part``.

    Args:
        held_out: held-out evaluation; None if there is none.
        sigma: (T,) standard deviation that the sequential fits state, metres.
        moved: (T,) displacement from the sequential fits to the joint fit, metres.
        known: (T,) mask of the frames in which the part was measured, not filled in.
    """
    nothing = np.full(len(known), np.nan)
    empty = dict.fromkeys(FEATURES, float("nan"))
    factors = FACTORS[part]
    if held_out is None:
        reason = "fewer than two cameras show the person, so none can be held out"
        return ErrorEstimate(float("nan"), factors.spread, nothing, empty, reason)
    count = len(held_out.cameras)
    shift = np.sqrt((count - 1) / count * (held_out.shift[part] ** 2).sum(axis=0))
    keypoint = np.full(len(shift), finite_median(held_out.keypoint_m))
    by_frame = np.stack([shift, keypoint, sigma, moved], axis=1)
    usable = known & np.isfinite(by_frame).all(axis=1)
    if usable.sum() < max(1, 0.5 * len(known)):
        reason = f"only {int(usable.sum())} of {len(known)} frames were measured"
        return ErrorEstimate(float("nan"), factors.spread, nothing, empty, reason)
    by_frame[~usable] = np.nan
    features = np.nanmean(by_frame, axis=0)
    return ErrorEstimate(
        float(_error(features, factors.rest, factors.of)),
        factors.spread,
        _error(by_frame, factors.rest, factors.of),
        dict(zip(FEATURES, features.tolist(), strict=True)),
    )


def _error(features: np.ndarray, rest: float, factors: tuple[float, ...]) -> np.ndarray:
    """Errors (...,) of features (..., F) by the formula of this module, metres."""
    return np.sqrt(rest**2 + ((features * np.array(factors)) ** 2).sum(axis=-1))
