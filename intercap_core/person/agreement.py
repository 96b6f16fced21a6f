"""Left and right made to agree over the views of a set.

A detector that takes a back for a front exchanges left and right in a whole view, often in several
views at once; points triangulated from views that disagree are wrong. For each limb all assignments
of sides to views are tried (exhaustively, 2^(C-1)), and the one of least cost is taken: truncated
squared gaps between the rays of every pair of views, plus a cost for each view exchanged. Which of
the two mirrored solutions is true stays open: see :mod:`.facing`.
"""

from __future__ import annotations

from itertools import combinations, product

import numpy as np

from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.triangulation import midpoints, rays_of
from intercap_core.person.constants import (
    EXCHANGED_VIEW_COST,
    MAX_AGREEING_VIEWS,
    SIDE_GAPS_M,
    UNKNOWN_SIDE_COST,
)
from intercap_core.person.sides import LIMBS, PARTNER, exchange_limb

_LIKE_ARMS = 2  # first of the limbs that are named as the arms are


def agree(keypoints: np.ndarray, rig: Rig, *, min_confidence: float) -> np.ndarray:
    """Exchange limbs of ``keypoints`` (T, C, 135, 3 or more) in place, set by set.

    Of two mirrored ways the one that exchanges fewer views is taken (of head and hands, where
    it is nearer: the one that exchanges those whose arms are). Returns which limbs were
    exchanged, (T, C, 4) bool in the order of LIMBS.
    """
    sets, views = keypoints.shape[:2]
    exchanged = np.zeros((sets, views, len(LIMBS)), bool)
    weight = np.where(keypoints[..., 2] >= min_confidence, keypoints[..., 2], 0)
    seeing = np.argsort(-(weight > 0).sum((0, 2)), kind="stable")[:MAX_AGREEING_VIEWS]
    order = np.sort(seeing[(weight[:, seeing] > 0).any((0, 2))])
    if len(order) < 2:
        return exchanged
    rays = np.swapaxes(rays_of(keypoints[..., :2], rig), 0, 1)
    centres = rig.master_from_colour[:, :3, 3]
    ways = np.array([(False, *rest) for rest in product((False, True), repeat=len(order) - 1)])
    for number, (limb, gap) in enumerate(zip(LIMBS, SIDE_GAPS_M, strict=True)):
        cost = np.zeros((sets, len(ways)))
        for i, j in combinations(range(len(order)), 2):
            a, b = order[i], order[j]
            same, other = (
                _cost(
                    rays[a][:, limb],
                    rays[b][:, side],
                    weight[:, a, limb],
                    weight[:, b, side],
                    centres[a],
                    centres[b],
                    gap,
                )
                for side in (limb, PARTNER[limb])
            )
            apart = ways[:, i] != ways[:, j]
            cost += np.where(apart, (other - same)[:, None], 0)
        seen = np.asarray((weight[:, order][:, :, limb] > 0).any(2))
        count = seen.sum(1)[:, None]
        plain = seen.astype(int) @ ways.T
        unusual, mirrored = plain, count - plain
        if number >= _LIKE_ARMS:
            # what takes a back for a front names head and hands as it does the arms
            arms = exchanged[:, order, 0]
            unlike = ((ways[None] ^ arms[:, None]) & seen[:, None]).sum(2)
            unusual = np.minimum(unusual, unlike)
            mirrored = np.minimum(mirrored, count - unlike)
        best = (cost + EXCHANGED_VIEW_COST * np.minimum(unusual, mirrored)).argmin(1)
        sets_at = (np.arange(sets), best)
        other = (mirrored[sets_at] < unusual[sets_at])[:, None]
        chosen = (ways[best] ^ other) & seen
        exchanged[:, order, number] = chosen
        t, c = np.nonzero(exchanged[..., number])
        exchange_limb(keypoints, t, c, limb)
    return exchanged


def _cost(
    first: np.ndarray,
    second: np.ndarray,
    first_weight: np.ndarray,
    second_weight: np.ndarray,
    from_first: np.ndarray,
    from_second: np.ndarray,
    limit: float,
) -> np.ndarray:
    """How badly rays (T, n, 3) of two views meet, (T,), summed over points by weights (T, n)."""
    _, gap = midpoints(first, second, from_first, from_second)
    square = np.minimum(np.nan_to_num(gap, nan=limit) / limit, 1.0) ** 2
    weight = first_weight * second_weight
    return (weight * (square - UNKNOWN_SIDE_COST)).sum(1)
