"""Keypoints that are left and right of each other, and limbs a detector confuses as a whole."""

from __future__ import annotations

import numpy as np

from intercap_core.body.keypoints import BODY, KEYPOINT_NAMES, LEFT_HAND, RIGHT_HAND

_INDEX = {name: index for index, name in enumerate(KEYPOINT_NAMES)}


def _partner(name: str) -> str:
    for side, other in (("left_", "right_"), ("right_", "left_")):
        if name.startswith(side):
            return other + name.removeprefix(side)
    return name


# (135,) the keypoint of the other side; itself where it has none (also all of the face, which
# detectors find as a whole).
PARTNER = np.array([_INDEX[_partner(name)] for name in KEYPOINT_NAMES])


def _both_sides(*names: str) -> np.ndarray:
    return np.array([_INDEX[f"{side}_{name}"] for side in ("left", "right") for name in names])


ARMS = _both_sides("shoulder", "elbow", "wrist")
LEGS = _both_sides("hip", "knee", "ankle", "big_toe", "small_toe", "heel")
HEAD = _both_sides("eye", "ear")
HANDS = np.r_[LEFT_HAND, RIGHT_HAND]
LIMBS: tuple[np.ndarray, ...] = (ARMS, LEGS, HEAD, HANDS)
BODY_POINTS = np.arange(BODY.start, BODY.stop)


def swapped(keypoints: np.ndarray, limb: np.ndarray | None = None) -> np.ndarray:
    """Keypoints (..., 135, n) with left and right of ``limb`` (or of everything) exchanged."""
    order = np.arange(len(PARTNER))
    chosen = order if limb is None else limb
    order[chosen] = PARTNER[chosen]
    return keypoints[..., order, :]


def exchange_points(values: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Values (T, 135, ...) with the limbs that ``which`` (T, 4) names exchanged."""
    result = values.copy()
    for limb, at in zip(LIMBS, which.T, strict=True):
        rows = np.flatnonzero(at)[:, None]
        result[rows, limb] = values[rows, PARTNER[limb]]
    return result


def exchange_limb(keypoints: np.ndarray, t: np.ndarray, c: np.ndarray, limb: np.ndarray) -> None:
    """Exchange in place left and right of ``limb`` in images (t, c) (N,) of ``keypoints``
    (T, C, 135, n)."""
    keypoints[t[:, None], c[:, None], limb] = keypoints[t[:, None], c[:, None], PARTNER[limb]]
