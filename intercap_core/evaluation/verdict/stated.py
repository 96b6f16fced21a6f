"""From what was held out to an error that is stated, in metres, with how far it may be off.

    error^2 = rest^2 + (a shift)^2 + (b keypoint)^2 + (c sigma)^2 + (d moved)^2

``shift`` is the jackknife over cameras (Efron 1982): sqrt((V - 1) / V sum_v d_v^2) of what a part
moves by without each of V cameras, which is what their calibration, masks and keypoints err by
independently. ``keypoint`` is by how much the keypoints of the camera that was held out are off at
the person's distance, ``sigma`` what the sequential fits state, ``moved`` by how much the joint fit
is elsewhere than those: two fits of one thing on different evidence. ``rest`` is what all cameras
have in common and no held-out one can show: clothes, the detector's idea of a joint, the object's
mesh.
The factors are fitted to the studio's truth by ``python -m bench.verdict``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.evaluation.verdict.constants import FACTORS, MIN_JUDGED_SHARE
from intercap_core.evaluation.verdict.hold_out import HeldOut, Part

FEATURES = ("shift", "keypoint", "sigma", "moved")


@dataclass(frozen=True, eq=False)
class Stated:
    """What is said of one part: its mean ``error``, metres; four of five are within ``factor`` of
    it, either way. ``by_frame`` (T,), NaN where nothing is said. ``features``: what it was made of,
    metres. ``silent``: why nothing is said, "" = it is said."""

    error: float
    factor: float
    by_frame: np.ndarray
    features: dict[str, float]
    silent: str = ""


def state(
    held: HeldOut | None, part: Part, sigma: np.ndarray, moved: np.ndarray, known: np.ndarray
) -> Stated:
    """The error of ``part``, from what the fits state (``sigma`` (T,), metres) and how far the
    joint one ``moved`` it (T,), metres, over the frames that are ``known`` (T,) bool: elsewhere a
    pose is filled in, which no camera speaks of."""
    nothing = np.full(len(known), np.nan)
    empty = dict.fromkeys(FEATURES, float("nan"))
    factors = FACTORS[part]
    if held is None:
        reason = "fewer than two cameras show the person: without one of them nothing is left"
        return Stated(float("nan"), factors.spread, nothing, empty, reason)
    count = len(held.cameras)
    shift = np.sqrt((count - 1) / count * (held.shift[part] ** 2).sum(axis=0))
    keypoint = np.full(len(shift), _median(held.keypoint_m))
    by_frame = np.stack([shift, keypoint, sigma, moved], axis=1)
    usable = known & np.isfinite(by_frame).all(axis=1)
    if usable.sum() < max(1, MIN_JUDGED_SHARE * len(known)):
        reason = f"only {int(usable.sum())} of {len(known)} frames were measured"
        return Stated(float("nan"), factors.spread, nothing, empty, reason)
    by_frame[~usable] = np.nan
    features = np.nanmean(by_frame, axis=0)
    return Stated(
        float(_error(features, factors.rest, factors.of)),
        factors.spread,
        _error(by_frame, factors.rest, factors.of),
        dict(zip(FEATURES, features.tolist(), strict=True)),
    )


def _error(features: np.ndarray, rest: float, factors: tuple[float, ...]) -> np.ndarray:
    """Errors (...,) of features (..., F)."""
    return np.sqrt(rest**2 + ((features * np.array(factors)) ** 2).sum(axis=-1))


def _median(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")
