"""Left and right of the body: made consistent over views, and chosen by build and motion.

A detector that mistakes a back for a front exchanges left and right in a whole view, often in
several views at once. Points triangulated from inconsistent views are wrong. "Limbs" are here the
four groups arms, legs, head and hands (``LIMBS``), each with left and right points.

:func:`make_views_agree` works on single sets. For each limb it tries all 2^(C-1) assignments of
sides to views (the ten with most keypoints). Their cost is the sum of truncated squared gaps
between the rays of all pairs of views, plus a constant for each exchanged view. The result may
still be mirrored in all views.

:func:`find_mirrored` then decides, for all sets together, which limbs are mirrored. It runs the
Viterbi algorithm over the eight ways of exchanging arms, legs and head:

- Unary costs: knees and ankles bend one way only; the nose is in front of the ears and of the
  chest; shoulders and hips face the same way; detectors are mostly right.
- Pairwise costs: motion from set to set, and a change of sides.

The two hands are exchanged if they are at the wrists of the other side (:func:`_other_hands`).
"""

from __future__ import annotations

from itertools import combinations, product

import numpy as np

from intercap_core.body.keypoints import KEYPOINT_INDEX, PARTNER
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.triangulation import midpoints, rays_of
from intercap_core.geometry.solve.time_series import cheapest_sequence
from intercap_core.person.sides import ARMS, HEAD, LEGS, LIMBS, exchange_limb, exchange_points

# Gap between two rays at which the cost is truncated, metres, for arms, legs, head and hands. Rays
# to one point miss each other by a few centimetres (detector bias, calibration). Rays to a left and
# a right point miss by up to the breadth of the body or face. Tuned on the studio: half of them
# exchanges consistent views, double leaves contradicting views (tests/person/test_facing.py).
SIDE_GAPS_M = (0.12, 0.12, 0.05, 0.12)
# Cost of each exchanged view; exceeds what noise alone gains by an exchange. Tuned on the studio:
# with two views of 17 recordings, half of it puts 3 % more points on the wrong side; with double,
# an exchanged view stays (tests/person/test_facing.py).
EXCHANGED_VIEW_COST = 0.5


def make_views_agree(keypoints: np.ndarray, rig: Rig, *, min_confidence: float) -> np.ndarray:
    """Exchange limbs of ``keypoints`` (T, C, 135, 3 or more) in place, set by set.

    Two assignments that differ in every view (the body and its mirror image) have equal gaps. Of
    these, the one with fewer exchanged views is chosen. For head and hands it may instead be the
    one closer to the assignment of the arms.

    Returns the exchanged limbs, (T, C, 4) bool in the order of LIMBS.
    """
    sets, views = keypoints.shape[:2]
    exchanged = np.zeros((sets, views, len(LIMBS)), bool)
    weight = np.where(keypoints[..., 2] >= min_confidence, keypoints[..., 2], 0)
    # the ten views with most keypoints: at most 2^9 assignments
    seeing = np.argsort(-(weight > 0).sum((0, 2)), kind="stable")[:10]
    order = np.sort(seeing[(weight[:, seeing] > 0).any((0, 2))])
    if len(order) < 2:
        return exchanged
    rays = np.swapaxes(rays_of(keypoints[..., :2], rig), 0, 1)
    centres = rig.master_from_colour[:, :3, 3]
    # (W, V) the assignments of V views, True = exchanged; the first view keeps its sides
    ways = np.array([(False, *rest) for rest in product((False, True), repeat=len(order) - 1)])
    for number, (limb, gap) in enumerate(zip(LIMBS, SIDE_GAPS_M, strict=True)):
        cost = np.zeros((sets, len(ways)))
        for i, j in combinations(range(len(order)), 2):
            a, b = order[i], order[j]
            same, other = (
                _cost(
                    rays[a][:, limb],
                    rays[b][:, side],
                    centres[[a, b]],
                    weight[:, a, limb] * weight[:, b, side],
                    gap,
                )
                for side in (limb, PARTNER[limb])
            )
            apart = ways[:, i] != ways[:, j]
            cost += np.where(apart, (other - same)[:, None], 0)
        # numbers (T, W) of visible views that each assignment, and its mirror image, exchange
        seen = np.asarray((weight[:, order][:, :, limb] > 0).any(2))
        count = seen.sum(1)[:, None]
        plain = seen.astype(int) @ ways.T
        unusual, opposite = plain, count - plain
        if number >= 2:  # head and hands
            # a detector that mistakes a back for a front exchanges them together with the arms
            arms = exchanged[:, order, 0]
            unlike = ((ways[None] ^ arms[:, None]) & seen[:, None]).sum(2)
            unusual = np.minimum(unusual, unlike)
            opposite = np.minimum(opposite, count - unlike)
        best = (cost + EXCHANGED_VIEW_COST * np.minimum(unusual, opposite)).argmin(1)
        sets_at = (np.arange(sets), best)
        # whether the mirror image of the best assignment exchanges fewer views
        other = (opposite[sets_at] < unusual[sets_at])[:, None]
        chosen = (ways[best] ^ other) & seen
        exchanged[:, order, number] = chosen
        t, c = np.nonzero(exchanged[..., number])
        exchange_limb(keypoints, t, c, limb)
    return exchanged


def _cost(
    first: np.ndarray, second: np.ndarray, centres: np.ndarray, weight: np.ndarray, limit: float
) -> np.ndarray:
    """Weighted sum (T,) of truncated squared gaps between the rays of two views.

    Args:
        first, second: (T, n, 3) directions of the rays.
        centres: (2, 3) camera centres, metres.
        weight: (T, n).
        limit: gap of the truncation, metres.
    """
    _, gap = midpoints(first, second, *centres)
    square = np.minimum(np.nan_to_num(gap, nan=limit) / limit, 1.0) ** 2
    # 0.25 is the neutral value: a smaller squared gap is evidence for this assignment, a larger one
    # against it; tuned on the studio
    return (weight * (square - 0.25)).sum(1)


_LIMBS = (ARMS, LEGS, HEAD)
# (8, 3) the states: exchange of arms, legs and head
_STATES = np.array(list(product((False, True), repeat=len(_LIMBS))))


def find_mirrored(points: np.ndarray, share: np.ndarray, times: np.ndarray | None) -> np.ndarray:
    """Limbs of triangulated points with exchanged sides, (T, 4) bool in the order of LIMBS.

    Args:
        points: (T, 135, 3), NaN = unknown.
        share: (T, 3) share of the views in which arms, legs and head were exchanged already.
        times: (T,) seconds; None = decide each set by itself.
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


def excess_build_cost(points: np.ndarray) -> np.ndarray:
    """Anatomical cost (T,) of triangulated points (T, 135, 3) minus the least cost of any exchange
    of arms, legs and head. The costs are negative log likelihoods; 0 = no exchange is better."""
    cost = _build(points)
    return np.asarray(cost[:, 0] - cost.min(1))


def _detected(points: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Cost (T, 8) of each state by the share of views in which it contradicts the detector.

    Three for each limb that is exchanged in all views: 3 = -log(1/20), tuned on the studio.
    """
    known = np.stack([np.isfinite(points[:, limb, 0]).any(1) for limb in _LIMBS], 1)
    wrong = np.where(_STATES, 1 - share[:, None], share[:, None])
    return 3.0 * np.where(known[:, None], wrong, 0).sum(2)


def _build(points: np.ndarray) -> np.ndarray:
    """Cost (T, 8) of anatomically impossible bodies, for each state.

    Each test gives a cosine, positive for a possible body. The cost is minus the cosine where it is
    negative, times a factor tuned on the studio (a negative log likelihood). The factors are 8 for
    knees and ankles, 6 for back and head, 3 for a nose in front of the chest. The last is lowest:
    the head can turn and the back can twist by up to some 80 degrees.
    """

    def between(start: str, end: str) -> np.ndarray:
        return points[:, KEYPOINT_INDEX[end]] - points[:, KEYPOINT_INDEX[start]]

    hips, shoulders = between("right_hip", "left_hip"), between("right_shoulder", "left_shoulder")
    ears = between("right_ear", "left_ear")
    up = between("mid_hip", "neck")
    nose = points[:, KEYPOINT_INDEX["nose"]] - points[
        :, [KEYPOINT_INDEX["left_ear"], KEYPOINT_INDEX["right_ear"]]
    ].mean(1)
    # knees and ankles bend about an axis parallel to the line from right to left hip
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
        8.0 * np.maximum(0, -legs * hinges[:, None])
        + 6.0 * np.maximum(0, -arms * legs * twist[:, None])
        + 3.0 * np.maximum(0, -arms * looks[:, None])
        + 6.0 * np.maximum(0, -turned * head[:, None])
    )


def _steps(points: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Cost (T - 1, 8, 8) of the transitions from state to state: change of sides, and motion.

    A limb that changes sides costs 1. For the motion, each point is compared with its last known
    position, at most half a second old.
    """
    steps = np.empty((len(points) - 1, len(_STATES), len(_STATES)))
    steps[:] = (_STATES[:, None] != _STATES[None]).sum(2)
    last, when = points[0].copy(), np.full(points.shape[1], times[0])
    for t, step in enumerate(steps, start=1):
        # motion over more than half a second is not evaluated; tuned on the studio
        last[times[t] - when > 0.5] = np.nan
        for number, limb in enumerate(_LIMBS):
            straight = _motion(last[limb], points[t, limb])
            crossed = _motion(last[PARTNER[limb]], points[t, limb])
            differ = _STATES[:, None, number] != _STATES[None, :, number]
            step += np.where(differ, crossed, straight)
        known = np.isfinite(points[t, :, 0])
        last[known], when[known] = points[t, known], times[t]
    return steps


def _motion(before: np.ndarray, now: np.ndarray) -> float:
    """Cost of the motion of points (n, 3), metres; 0 if fewer than two are known."""
    step = np.linalg.norm(now - before, axis=1)
    step = step[np.isfinite(step)]
    # a step of 4 cm costs 1, truncated at 30 cm; tuned on the studio
    return float(np.minimum(step, 0.3).mean() / 0.04) if len(step) > 1 else 0.0


def _other_hands(points: np.ndarray) -> np.ndarray:
    """Mask (T,) of sets whose hands are at the wrists of the other side."""
    wrists = points[:, [KEYPOINT_INDEX["left_wrist"], KEYPOINT_INDEX["right_wrist"]]]
    roots = points[:, [KEYPOINT_INDEX["left_hand_wrist"], KEYPOINT_INDEX["right_hand_wrist"]]]
    own = np.linalg.norm(wrists - roots, axis=2)
    other = np.linalg.norm(wrists - roots[:, ::-1], axis=2)
    both = np.isfinite(own) & np.isfinite(other)
    count = np.maximum(both.sum(1), 1)
    own, other = (np.where(both, d, 0).sum(1) / count for d in (own, other))
    # the wrist keypoints of body and hand of one arm are less than 8 cm apart; untuned
    return both.any(1) & (own > 0.08) & (other < 0.5 * own)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Unit vectors (..., 3); NaN for vectors shorter than 3 cm, whose direction is unreliable."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 0.03, vectors / np.maximum(length, 0.03), np.nan)


def _hinge(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Rotation axis (T, 3) from one bone (T, 3) to another; its length is the sine of the angle."""
    return np.cross(_unit(first), _unit(second))


def _perpendicular(vectors: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """The part of vectors (T, 3) across an axis (T, 3)."""
    axis = _unit(axis)
    return vectors - (vectors * axis).sum(-1, keepdims=True) * axis


def _cosine(weighted: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Scalar product (T,) of ``weighted`` (T, 3) and the unit vector of ``direction``; 0 = unknown.

    ``weighted`` is scaled to length one if it is longer; a shorter vector lowers the result.
    """
    length = np.linalg.norm(weighted, axis=-1, keepdims=True)
    return np.nan_to_num((weighted / np.maximum(length, 1.0) * _unit(direction)).sum(-1))
