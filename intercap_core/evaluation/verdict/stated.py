"""Stated error of a part, in metres, from the held-out evaluation.

    error^2 = scale^2 (cameras^2 + surface^2 + common^2 + sigma^2)

The features are root mean square errors in space, in metres:

- ``cameras``: jackknife over the V cameras (Efron 1982), sqrt((V - 1) / V sum_v d_v^2), where d_v
  is the displacement of the part without camera v. It measures errors that are independent between
  cameras: calibration, masks and keypoints.
- ``surface``: displacement of the part if no depth and no rim of a mask is used. It measures errors
  that the detector makes in all views, since depth does not share them.
- ``common``: standard deviation due to the covariance of cameras and depth biases that the joint
  fit states. These errors are the same in all frames.
- ``sigma``: standard deviation of the poses at which the joint fit starts. It is large for limbs
  and hands that no or one view supports.

The object's error uses ``cameras`` and ``common`` alone: its tracked deviation and the displacement
without depth did not improve the prediction of kinds of recordings that were left out.

``python -m bench.verdict`` fits the scales to truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from intercap_core.evaluation.verdict.hold_out import HeldOut, JudgedPart


class Calibration(NamedTuple):
    """Parameters of the stated error of one part."""

    scale: float
    """Mean error over the root of the summed squares of the features."""
    spread: float
    """Four of five true errors are within this factor of the stated error."""


# Fitted to 93 recordings of the virtual studio by `python -m bench.verdict`: two to six cameras,
# with and without depth, noise scale 1, other body builds, people without an object, a balance
# beam, and keypoints of a real detector with large errors of depth, which count as much as
# simulated ones. The spreads are cross-validated: each kind was left out once. Objects: 2.82
# contained 84 % of these recordings; 3.10 would contain 80 % of new ones with 80 % confidence.
CALIBRATION = {
    JudgedPart.BODY: Calibration(0.66, 1.62),
    JudgedPart.HANDS: Calibration(0.69, 1.78),
    JudgedPart.OBJECT: Calibration(1.22, 2.82),
}

FEATURES = ("cameras", "surface", "common", "sigma")
_OF_OBJECT = np.array([True, False, True, False])  # features of the object's error


@dataclass(frozen=True, eq=False)
class ErrorEstimate:
    """The stated error of one part."""

    error: float
    """Mean over the frames, metres; NaN if no error is stated."""
    factor: float
    """Four of five true errors are within this factor of ``error``."""
    by_frame: np.ndarray
    """(T,) metres; NaN in frames without a statement."""
    features: np.ndarray
    """(F,) mean of each of FEATURES, metres."""
    silent: str = ""
    """Reason why no error is stated; "" if one is stated."""


def estimate_error(
    held_out: HeldOut | None, part: JudgedPart, sigma: np.ndarray, known: np.ndarray
) -> ErrorEstimate:
    """Estimate the error of ``part``.

    Args:
        held_out: held-out evaluation; None if there is none.
        sigma: (T,) standard deviation in space that the sequential fits state, metres.
        known: (T,) mask of the frames in which the part was measured, not filled in.
    """
    spread = CALIBRATION[part].spread

    def silent(reason: str) -> ErrorEstimate:
        nothing = np.full(len(known), np.nan)
        return ErrorEstimate(np.nan, spread, nothing, np.full(len(FEATURES), np.nan), reason)

    if held_out is None:
        return silent("fewer than two cameras show the person, so none can be held out")
    count = len(held_out.cameras)
    cameras = np.sqrt((count - 1) / count * (held_out.shift[part] ** 2).sum(axis=0))
    by_frame = np.stack([cameras, held_out.surface[part], held_out.common[part], sigma], axis=1)
    if np.isnan(held_out.common[part]).all() and np.isfinite(cameras).any():
        return silent("the joint fit does not compare its images, so cameras' errors are unknown")
    usable = known & np.isfinite(by_frame).all(axis=1)
    if usable.sum() < max(1, 0.5 * len(known)):
        return silent(
            f"only {int(usable.sum())} of {len(known)} frames were measured and not contradicted"
        )
    by_frame[~usable] = np.nan
    features = np.nanmean(by_frame, axis=0)
    return ErrorEstimate(float(predict(part, features)), spread, predict(part, by_frame), features)


def predict(part: JudgedPart, features: np.ndarray) -> np.ndarray:
    """Errors (...,) of features (..., F) by the formula of this module, metres."""
    return CALIBRATION[part].scale * size(part, features)


def size(part: JudgedPart, features: np.ndarray) -> np.ndarray:
    """Root (...,) of the summed squares of those features (..., F) that ``part`` uses, metres."""
    counted = features[..., _OF_OBJECT] if part == JudgedPart.OBJECT else features
    return np.sqrt((counted**2).sum(axis=-1))
