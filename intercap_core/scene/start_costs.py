"""How badly two cameras agree if one is so many sets late: epipolar distances along moving people.

What is used of the body's middles, and why, :mod:`intercap_core.scene.start_times` says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import invert
from intercap_core.geometry.camera.triangulation import pixel_scale
from intercap_core.scene.constants import EPIPOLAR_PX_AT_1080P

_NO_MOTION_RAD = 1e-6


@dataclass(frozen=True, eq=False)
class Pairs:
    """How badly two cameras a < b agree, 0 to 1, if b's image of set t + lag shows what a's of set
    t does: ``cost[a, b]`` (4 reach + 1, T), lags from - 2 reach, NaN = not known."""

    cost: dict[tuple[int, int], np.ndarray]
    views: int
    reach: int

    @classmethod
    def of(cls, rays: np.ndarray, rig: Rig, reach: int, fewest: float) -> Pairs:
        """From ``rays`` (T, C, P, K, 2); lags at which fewer than ``fewest`` sets tell stay NaN."""
        lags = range(-2 * reach, 2 * reach + 1)
        cost = {
            (a, b): np.stack([_cost(rays, rig, a, b, lag, fewest) for lag in lags])
            for a, b in combinations(range(len(rig)), 2)
        }
        return cls(cost, len(rig), reach)

    def series(self, camera: int, late: int, others: Sequence[int], sets: np.ndarray) -> np.ndarray:
        """The cost (T + 2 reach,) of a camera's pairs with ``others`` by moment, if it is late by
        ``late`` sets and they by ``sets`` (C,)."""
        found = []
        for other in others:
            a, b = sorted((camera, other))
            own, theirs = (late, int(sets[other]))
            lag = own - theirs if a == other else theirs - own
            row = self.cost[a, b][lag + 2 * self.reach]
            series = np.full(len(row) + 2 * self.reach, np.nan)
            start = self.reach - (theirs if a == other else own)  # a's set t shows moment t - late
            series[start : start + len(row)] = row
            found.append(series)
        return mean(np.array(found))

    def profile(
        self, camera: int, others: Sequence[int], sets: np.ndarray, bound: int | None = None
    ) -> np.ndarray:
        """Mean cost (2 reach + 1,) by how late a camera is, NaN where no pair tells, and beyond
        ``bound`` sets."""
        tried = range(-self.reach, self.reach + 1)
        cost = mean(np.array([self.series(camera, k, others, sets) for k in tried]).T)
        if bound is not None:
            cost[np.abs(np.array(tried)) > bound] = np.nan
        return cost


def _cost(rays: np.ndarray, rig: Rig, a: int, b: int, lag: int, fewest: float) -> np.ndarray:
    """One lag's costs (T,) of :class:`Pairs`: of each person whom camera a follows, and the one of
    camera b who agrees best all along, how far the distances to each other's epipolar lines are
    from their medians over time; the mean over people by how much they move."""
    sets = len(rays)
    found = np.full(sets, np.nan)
    at = slice(max(0, -lag), min(sets, sets - lag))
    if at.stop - at.start < fewest:
        return found
    first = rays[at, a]
    distance = _epipolar(first, rays[at.start + lag : at.stop + lag, b], rig, a, b)
    seen = np.isfinite(distance).sum(0, keepdims=True)
    distance = np.where(seen >= fewest, distance, np.nan)  # of people who are seen for long enough
    known = np.isfinite(distance).any(-1)  # (T, P, Q)
    size = mean(mean(np.moveaxis(np.abs(distance), -1, 0)))
    size[known.sum(0) < fewest] = np.nan
    cost, weight = np.full((2, first.shape[1], len(first)), np.nan)
    for p in np.flatnonzero(np.isfinite(size).any(1)):
        own = distance[:, p, np.nanargmin(size[p])]
        own = own[:, np.isfinite(own).any(0)]
        change = (own - np.nanmedian(own, axis=0)) / EPIPOLAR_PX_AT_1080P
        cost[p] = mean((change**2 / (1 + change**2)).T)
        weight[p] = np.where(np.isfinite(cost[p]), _moves(first[:, p]), np.nan)
    found[at] = mean(weight * cost) / mean(weight)
    return found


def _moves(rays: np.ndarray) -> float:
    """How far, rad, somebody's rays (T, K, 2) are from their mean: who stands still is in step with
    anything, and says nothing. Never 0."""
    return _NO_MOTION_RAD + float(np.nanmean(np.sqrt(np.nanvar(rays, axis=0).sum(-1))))


def _epipolar(first: np.ndarray, second: np.ndarray, rig: Rig, a: int, b: int) -> np.ndarray:
    """Signed distances (T, P, Q, K) of people (T, P, K, 2) of camera a and (T, Q, K, 2) of b from
    each other's epipolar lines, pixels at 1080p (Sampson)."""
    b_from_a = invert(rig[b].master_from_colour) @ rig[a].master_from_colour
    x, y, z = b_from_a[:3, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ b_from_a[:3, :3]
    scale = pixel_scale(rig)
    focal = np.mean([rig[c].colour.fx / scale[c] for c in (a, b)])
    one, two = (np.concatenate([p, np.ones_like(p[..., :1])], -1) for p in (first, second))
    line, back = (one @ essential.T)[:, :, None], (two @ essential)[:, None]
    size = np.sqrt((line[..., :2] ** 2).sum(-1) + (back[..., :2] ** 2).sum(-1))
    return focal * (line * two[:, None]).sum(-1) / np.maximum(size, 1e-12)


def mean(values: np.ndarray) -> np.ndarray:
    """Mean over the first axis of what is known; NaN where nothing is."""
    known = np.isfinite(values)
    count = known.sum(0)
    total = np.where(known, values, 0.0).sum(0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
