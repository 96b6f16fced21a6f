"""Cameras that started apart: whole recordings that are late by up to seconds.

Nothing that compares the views of a frame set holds for them, so they are sought first, with what
needs no view to be in step: along a moving person, the rays of two cameras meet (epipolar distance)
only where both show the same moment. The body's middles are looked at (nose, neck, hips, half way
between the knees, ...), which stay where they are when a detector exchanges left and right. For
each pair of cameras and each lag the distances are summed robustly, each middle's median taken off,
which is the calibration's error and not the time's; the lags of all pairs together give the
cameras' times. Where the person hardly moves, or a motion repeats itself, nothing is said.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from intercap_core.body.keypoints import NUM_KEYPOINTS
from intercap_core.camera.rig import Rig
from intercap_core.camera.transforms import invert
from intercap_core.camera.triangulation import pixel_scale
from intercap_core.detections.read import PeopleOfImages
from intercap_core.scene.constants import (
    CLEAR_SIGMAS,
    EPIPOLAR_PX_AT_1080P,
    FEWEST_BLOCKS,
    FEWEST_SETS_APART,
    MAX_START_S,
    MAX_START_SHARE,
    MIN_SHARED_S,
    START_BLOCK_S,
    START_BLOCKS_SHARE,
    START_PEAK_S,
    START_ROUNDS,
    START_SIGMAS,
    START_WORSE,
)
from intercap_core.scene.people_in_view import followed

_NO_MOTION_RAD = 1e-6


@dataclass(frozen=True, eq=False)
class Starts:
    """By how much each camera's images are older than their sets say, all along: ``late`` (C,) s,
    the master's 0, and the nearest whole number of ``sets`` (C,). ``apart``: the cameras were not
    started together. ``in_doubt`` (C,): then this camera's time could not be told."""

    late: np.ndarray
    sets: np.ndarray
    in_doubt: np.ndarray
    apart: bool
    step_s: float

    @property
    def offset(self) -> np.ndarray:
        """(C,) s after which cameras expose, once images are moved by whole numbers of sets."""
        return self.sets * self.step_s - self.late

    @property
    def offset_sigma(self) -> np.ndarray | None:
        """(C,) s that these offsets are off by: half a set; None where nothing started apart."""
        return np.full(len(self.late), self.step_s / 2) if self.apart else None

    def in_step(self, values: np.ndarray) -> np.ndarray:
        """Values (T, C, ...) of images, with each camera's moved to the sets of its moments; 0
        where there is no image."""
        return self._moved(values, self.sets)

    def of_images(self, values: np.ndarray) -> np.ndarray:
        """Values (T, C, ...) of moments, as :meth:`in_step` gives them, moved back."""
        return self._moved(values, -self.sets)

    def with_slips(self, slip: np.ndarray) -> np.ndarray:
        """By how many sets (T, C) images are late in all, from slips (T, C) that were found in
        step."""
        last = len(slip) - 1
        place = np.clip(np.arange(len(slip))[:, None] - self.sets, 0, last)
        return np.take_along_axis(slip, place, 0) + self.sets.astype(slip.dtype)

    @staticmethod
    def _moved(values: np.ndarray, by: np.ndarray) -> np.ndarray:
        sets = len(values)
        result = np.zeros_like(values)
        for c, shift in enumerate(by.tolist()):
            there = slice(max(0, -shift), max(0, min(sets, sets - shift)))
            result[there, c] = values[max(0, shift) : max(0, sets + min(0, shift)), c]
        return result


@dataclass(frozen=True)
class InStep:
    """The people of the images that show each set's moment."""

    detections: PeopleOfImages
    starts: Starts

    @property
    def num_sets(self) -> int:
        """How many sets there are."""
        return self.detections.num_sets

    def people(self, t: int, c: int) -> np.ndarray:
        """Keypoints (P, 135, 3) of the people whom camera c sees at set t's moment."""
        image = t + int(self.starts.sets[c])
        if 0 <= image < self.num_sets and not self.starts.in_doubt[c]:
            return self.detections.people(image, c)
        return np.zeros((0, NUM_KEYPOINTS, 3))


def find_starts(
    detections: PeopleOfImages,
    rig: Rig,
    times: np.ndarray,
    available: np.ndarray,
    *,
    master: int = 0,
) -> Starts:
    """When the cameras started, from all people that they show.

    ``times`` (T,) s of the sets; ``available`` (T, C): the set has an image of the camera.
    """
    views, sets = len(rig), len(times)
    step = float(np.median(np.diff(times))) if sets > 1 else 0.0
    together = Starts(np.zeros(views), np.zeros(views, int), np.zeros(views, bool), False, step)
    if sets < 2 or views < 2:
        return together
    reach = min(round(MAX_START_S / step), int(MAX_START_SHARE * sets))
    fewest = max(MIN_SHARED_S / step, 1)
    if reach < 1 or sets - reach < fewest:
        return together
    pairs = _Pairs.of(followed(detections, rig, times, available), rig, reach, fewest)
    late = _descended(pairs, master)
    others = [c for c in range(views) if c != master]
    # that one camera surely started apart says that nobody started them together
    if not any(_is_apart(pairs, late, c, step) for c in others):
        return together
    found = replace(together, apart=True)
    for c in others:
        if _is_clear(pairs, late, c, step):
            found.late[c] = (late[c] + _between(pairs, late, c)) * step
            found.sets[c] = late[c]
        else:
            found.in_doubt[c] = True
    return found


@dataclass(frozen=True, eq=False)
class _Pairs:
    """How badly two cameras a < b agree, 0 to 1, if b's image of set t + lag shows what a's of set
    t does: ``cost[a, b]`` (4 reach + 1, T), lags from - 2 reach, NaN = not known."""

    cost: dict[tuple[int, int], np.ndarray]
    views: int
    reach: int

    @classmethod
    def of(cls, rays: np.ndarray, rig: Rig, reach: int, fewest: float) -> _Pairs:
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
        return _mean(np.array(found))

    def profile(self, camera: int, others: Sequence[int], sets: np.ndarray) -> np.ndarray:
        """Mean cost (2 reach + 1,) by how late a camera is, NaN where no pair tells."""
        tried = range(-self.reach, self.reach + 1)
        return _mean(np.array([self.series(camera, k, others, sets) for k in tried]).T)


def _cost(rays: np.ndarray, rig: Rig, a: int, b: int, lag: int, fewest: float) -> np.ndarray:
    """One lag's costs (T,) of :class:`_Pairs`: of each person whom camera a follows, and the one of
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
    size = _mean(_mean(np.moveaxis(np.abs(distance), -1, 0)))
    size[known.sum(0) < fewest] = np.nan
    cost, weight = np.full((2, first.shape[1], len(first)), np.nan)
    for p in np.flatnonzero(np.isfinite(size).any(1)):
        own = distance[:, p, np.nanargmin(size[p])]
        own = own[:, np.isfinite(own).any(0)]
        change = (own - np.nanmedian(own, axis=0)) / EPIPOLAR_PX_AT_1080P
        cost[p] = _mean((change**2 / (1 + change**2)).T)
        weight[p] = np.where(np.isfinite(cost[p]), _moves(first[:, p]), np.nan)
    found[at] = _mean(weight * cost) / _mean(weight)
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


def _descended(pairs: _Pairs, master: int) -> np.ndarray:
    """How late (C,), in sets, cameras are where all pairs agree best: they join one after another,
    the clearest first, then each is moved until none moves."""
    sets, joined = np.zeros(pairs.views, int), [master]
    waiting = [c for c in range(pairs.views) if c != master]
    while waiting:
        profiles = {c: pairs.profile(c, joined, sets) for c in waiting}
        gains = {c: _gain(profile) for c, profile in profiles.items()}
        c = max(waiting, key=lambda c: gains[c])
        if gains[c] > 0:
            sets[c] = np.nanargmin(profiles[c]) - pairs.reach
            joined.append(c)
        waiting.remove(c)
    for _ in range(START_ROUNDS):
        before = sets.copy()
        for c in joined[1:]:
            profile = pairs.profile(c, [o for o in joined if o != c], sets)
            sets[c] = np.nanargmin(profile) - pairs.reach
        if (before == sets).all():
            break
    return sets


def _gain(profile: np.ndarray) -> float:
    """How much better the best of a profile is than usual; 0 where nothing is known."""
    known = profile[np.isfinite(profile)]
    return float(np.median(known) - known.min()) if len(known) else 0.0


def _is_apart(pairs: _Pairs, sets: np.ndarray, camera: int, step: float) -> bool:
    """Whether a camera is in no doubt out of step: by more than what slips and offsets explain, and
    the views disagree with that it is in step again and again over the recording."""
    if abs(sets[camera]) < FEWEST_SETS_APART:
        return False
    worse = _worse(pairs, sets, camera, 0, step)
    if len(worse) < FEWEST_BLOCKS:
        return False
    usual = np.nanmean(pairs.series(camera, int(sets[camera]), _others(pairs, camera), sets))
    least = max(START_WORSE * usual, START_SIGMAS * worse.std(ddof=1) / np.sqrt(len(worse)))
    return bool((worse > 0).mean() >= START_BLOCKS_SHARE and worse.mean() > least)


def _is_clear(pairs: _Pairs, sets: np.ndarray, camera: int, step: float) -> bool:
    """Whether the views agree better at a camera's time than at any that is not near."""
    profile = pairs.profile(camera, _others(pairs, camera), sets)
    tried = np.arange(-pairs.reach, pairs.reach + 1)
    far = (np.abs(tried - sets[camera]) * step > START_PEAK_S) & np.isfinite(profile)
    if not far.any() or not np.isfinite(profile[sets[camera] + pairs.reach]):
        return False
    next_best = int(tried[far][profile[far].argmin()])
    worse = _worse(pairs, sets, camera, next_best, step)
    if len(worse) < FEWEST_BLOCKS:
        return True  # hardly anything was seen at the same time: a time like any other
    return bool(worse.mean() > CLEAR_SIGMAS * worse.std(ddof=1) / np.sqrt(len(worse)))


def _worse(pairs: _Pairs, sets: np.ndarray, camera: int, late: int, step: float) -> np.ndarray:
    """By how much (N,) a camera's views agree worse if it is ``late`` by so many sets than at its
    own time, mean of each block of time in which both are known."""
    others = _others(pairs, camera)
    own = pairs.series(camera, int(sets[camera]), others, sets)
    change = pairs.series(camera, late, others, sets) - own
    size = max(1, round(START_BLOCK_S / step))
    whole = change[: len(change) // size * size].reshape(-1, size)
    return _mean(whole[np.isfinite(whole).sum(1) * 2 >= size].T)


def _others(pairs: _Pairs, camera: int) -> list[int]:
    return [c for c in range(pairs.views) if c != camera]


def _between(pairs: _Pairs, sets: np.ndarray, camera: int) -> float:
    """How far from its whole number of sets, in sets, a parabola of a camera's cost is lowest."""
    place = sets[camera] + pairs.reach
    profile = pairs.profile(camera, _others(pairs, camera), sets)[max(place - 1, 0) : place + 2]
    if len(profile) < 3 or not np.isfinite(profile).all():
        return 0.0
    bend = profile[0] - 2 * profile[1] + profile[2]
    return float(np.clip((profile[0] - profile[2]) / (2 * bend), -0.5, 0.5)) if bend > 0 else 0.0


def _mean(values: np.ndarray) -> np.ndarray:
    """Mean over the first axis of what is known; NaN where nothing is."""
    known = np.isfinite(values)
    count = known.sum(0)
    total = np.where(known, values, 0.0).sum(0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
