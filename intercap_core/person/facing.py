"""Which of two mirrored bodies is the true one, where the views agree up to left and right.

Decided for arms, legs and head of all sets together, by the Viterbi algorithm over the eight ways
of exchanging them. Unary costs: knees and ankles bend one way, the nose is in front of the ears and
of the chest, shoulders and hips face the same way, detectors are mostly right. Pairwise costs:
motion from set to set, and a change of sides. A hand belongs to the arm whose wrist is its own.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.geometry.solve.viterbi import cheapest_sequence
from intercap_core.person.constants import (
    CHANGE_COST,
    CROSSED_HANDS_RATIO,
    DETECTED_COST,
    HAND_ROOT_APART_M,
    HEAD_COST,
    HINGE_COST,
    LARGEST_STEP_M,
    MOTION_MEMORY_S,
    NOSE_COST,
    SHORT_BONE_M,
    STEP_M,
    TWIST_COST,
)
from intercap_core.person.sides import ARMS, HEAD, LEGS, LIMBS, PARTNER, exchange_points

_AT = {name: index for index, name in enumerate(KEYPOINT_NAMES)}
_LIMBS = (ARMS, LEGS, HEAD)
_STATES = np.array(list(product((False, True), repeat=len(_LIMBS))))


def mirrored(points: np.ndarray, share: np.ndarray, times: np.ndarray | None) -> np.ndarray:
    """Which limbs of triangulated points (T, 135, 3), NaN = not known, have left for right.

    ``share`` (T, 3): of the views that see arms, legs and head, how many had them exchanged so far;
    ``times`` (T,) seconds, None = each set stands alone. Returns (T, 4) bool, by LIMBS.
    """
    result = np.zeros((len(points), len(LIMBS)), bool)
    if not len(points):
        return result
    cost = _build(points) + _detected(points, share)
    if times is None:
        states = cost.argmin(1)
    else:
        states = cheapest_sequence(cost[0], _steps(points, times) + cost[1:, None])
    result[:, :3] = _STATES[states]
    result[:, 3] = _other_hands(exchange_points(points, result))
    return result


def against_build(points: np.ndarray) -> np.ndarray:
    """By how much (T,) another way of exchanging arms, legs and head suits the body's build better
    than triangulated points (T, 135, 3) as they are; negative log likelihood, 0 = none does.
    """
    cost = _build(points)
    return np.asarray(cost[:, 0] - cost.min(1))


def _detected(points: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Cost (T, 8) of contradicting the detector, by the share of views."""
    known = np.stack([np.isfinite(points[:, limb, 0]).any(1) for limb in _LIMBS], 1)
    wrong = np.where(_STATES, 1 - share[:, None], share[:, None])
    return DETECTED_COST * np.where(known[:, None], wrong, 0).sum(2)


def _build(points: np.ndarray) -> np.ndarray:
    """Cost (T, 8) of anatomically impossible bodies, for each way of exchanging limbs."""

    def between(start: str, end: str) -> np.ndarray:
        return points[:, _AT[end]] - points[:, _AT[start]]

    hips, shoulders = between("right_hip", "left_hip"), between("right_shoulder", "left_shoulder")
    ears = between("right_ear", "left_ear")
    up = between("mid_hip", "neck")
    nose = points[:, _AT["nose"]] - points[:, [_AT["left_ear"], _AT["right_ear"]]].mean(1)
    # whichever way a leg is stretched, its knee and its ankle turn about the line of the hips
    hinges = np.zeros(len(points))
    for side in ("left", "right"):
        thigh, shin = (
            between(f"{side}_hip", f"{side}_knee"),
            between(f"{side}_knee", f"{side}_ankle"),
        )
        foot = between(f"{side}_heel", f"{side}_big_toe")
        hinges += 0.5 * (_cosine(_hinge(thigh, shin), hips) + _cosine(_hinge(foot, shin), hips))
    twist = _cosine(_unit(_perpendicular(shoulders, up)), _perpendicular(hips, up))
    chest = np.cross(_unit(shoulders), _unit(up))
    looks = _cosine(chest, nose)
    head = _cosine(np.cross(_unit(up), _unit(nose)), ears)
    arms, legs, turned = np.where(_STATES, -1.0, 1.0).T
    return (
        HINGE_COST * np.maximum(0, -legs * hinges[:, None])
        + TWIST_COST * np.maximum(0, -arms * legs * twist[:, None])
        + NOSE_COST * np.maximum(0, -arms * looks[:, None])
        + HEAD_COST * np.maximum(0, -turned * head[:, None])
    )


def _steps(points: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Cost (T - 1, 8, 8) of going from one state of the sides to the next: change and motion."""
    steps = np.empty((len(points) - 1, len(_STATES), len(_STATES)))
    steps[:] = CHANGE_COST * (_STATES[:, None] != _STATES[None]).sum(2)
    last, when = points[0].copy(), np.full(points.shape[1], times[0])
    for t, step in enumerate(steps, start=1):
        last[times[t] - when > MOTION_MEMORY_S] = np.nan
        for number, limb in enumerate(_LIMBS):
            straight = _motion(last[limb], points[t, limb])
            crossed = _motion(last[PARTNER[limb]], points[t, limb])
            differ = _STATES[:, None, number] != _STATES[None, :, number]
            step += np.where(differ, crossed, straight)
        known = np.isfinite(points[t, :, 0])
        last[known], when[known] = points[t, known], times[t]
    return steps


def _motion(before: np.ndarray, now: np.ndarray) -> float:
    """Cost of moving points (n, 3) so far; 0 where fewer than two are known."""
    step = np.linalg.norm(now - before, axis=1)
    step = step[np.isfinite(step)]
    return float(np.minimum(step, LARGEST_STEP_M).mean() / STEP_M) if len(step) > 1 else 0.0


def _other_hands(points: np.ndarray) -> np.ndarray:
    """Whether the hands (T,) begin where the other side's arm ends."""
    wrists = points[:, [_AT["left_wrist"], _AT["right_wrist"]]]
    roots = points[:, [_AT["left_hand_wrist"], _AT["right_hand_wrist"]]]
    own = np.linalg.norm(wrists - roots, axis=2)
    other = np.linalg.norm(wrists - roots[:, ::-1], axis=2)
    both = np.isfinite(own) & np.isfinite(other)
    count = np.maximum(both.sum(1), 1)
    own, other = (np.where(both, d, 0).sum(1) / count for d in (own, other))
    return both.any(1) & (own > HAND_ROOT_APART_M) & (other < CROSSED_HANDS_RATIO * own)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Directions (..., 3), NaN for what is too short to have one."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > SHORT_BONE_M, vectors / np.maximum(length, SHORT_BONE_M), np.nan)


def _hinge(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The axis (T, 3) about which one bone (T, 3) turns into another, by the sine of the turn."""
    return np.cross(_unit(first), _unit(second))


def _perpendicular(vectors: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """The part of vectors (T, 3) across an axis (T, 3)."""
    axis = _unit(axis)
    return vectors - (vectors * axis).sum(-1, keepdims=True) * axis


def _cosine(weighted: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Scalar product (T,) of vectors, shortened to length one, and unit directions; 0 = unknown.

    ``weighted`` keeps its length where that is less than one.
    """
    length = np.linalg.norm(weighted, axis=-1, keepdims=True)
    return np.nan_to_num((weighted / np.maximum(length, 1.0) * _unit(direction)).sum(-1))
