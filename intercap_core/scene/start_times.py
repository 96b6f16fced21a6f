"""Cameras that started apart: whole recordings that are late by up to seconds.

Nothing that compares the views of a frame set holds for them, so they are sought first, with what
needs no view to be in step: along a moving person, the rays of two cameras meet (epipolar distance)
only where both show the same moment. The body's middles are looked at (nose, neck, hips, half way
between the knees, ...), which stay where they are when a detector exchanges left and right. For
each pair of cameras and each lag the distances are summed robustly, each middle's median taken off,
which is the calibration's error and not the time's; the lags of all pairs together give the
cameras' times. Where the person hardly moves, or a motion repeats itself, nothing is said.

What is stated of a start is where the search begins, as the images' own times are where nothing is:
a camera leaves it where the views surely agree better elsewhere, and denies it if that is far away.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from intercap_core.body.keypoints import NUM_KEYPOINTS
from intercap_core.formats.detections.read import PeopleOfImages
from intercap_core.geometry.camera.rig import Rig
from intercap_core.scene.constants import (
    CLEAR_SIGMAS,
    FEWEST_BLOCKS,
    FEWEST_SETS_APART,
    MAX_START_S,
    MAX_START_SHARE,
    MIN_SHARED_S,
    PRIOR_OFFSET_S,
    START_BLOCK_S,
    START_BLOCKS_SHARE,
    START_PEAK_S,
    START_ROUNDS,
    START_SIGMAS,
    START_WORSE,
)
from intercap_core.scene.people_in_view import followed
from intercap_core.scene.start_costs import Pairs, mean
from intercap_core.scene.stated_starts import StatedStarts, combined


@dataclass(frozen=True, eq=False)
class Starts:
    """By how much each camera's images are older than their sets say, all along: ``late`` (C,) s,
    the master's 0, and the nearest whole number of ``sets`` (C,). ``apart``: the cameras were not
    started together. ``in_doubt`` (C,): then this camera's time could not be told. ``sigma`` (C,) s
    that ``late`` is off by where it rests on what was stated, else NaN; ``denied`` (C,): something
    was stated, and the keypoints say otherwise."""

    late: np.ndarray
    sets: np.ndarray
    in_doubt: np.ndarray
    apart: bool
    step_s: float
    sigma: np.ndarray
    denied: np.ndarray

    @classmethod
    def as_stated(cls, stated: StatedStarts, step_s: float) -> Starts:
        """What is stated, and of other cameras what their images' times say."""
        none = np.zeros(len(stated.late), bool)
        late = np.nan_to_num(stated.late)
        return cls(late, stated.sets(step_s), none, False, step_s, stated.sigma.copy(), none.copy())

    @property
    def offset(self) -> np.ndarray:
        """(C,) s after which cameras expose, once images are moved by whole numbers of sets."""
        return self.sets * self.step_s - self.late

    @property
    def offset_sigma(self) -> np.ndarray | None:
        """(C,) s that these offsets are off by: what was stated, else half a set of cameras that
        started apart; None where nothing is stated and nothing started apart."""
        stated = np.isfinite(self.sigma)
        if not self.apart and not stated.any():
            return None
        return np.where(stated, self.sigma, self.step_s / 2 if self.apart else PRIOR_OFFSET_S)

    def in_step(self, values: np.ndarray) -> np.ndarray:
        """Values (T, C, ...) of images, with each camera's moved to the sets of its moments; 0
        where there is no image."""
        return moved(values, self.sets)

    def of_images(self, values: np.ndarray) -> np.ndarray:
        """Values (T, C, ...) of moments, as :meth:`in_step` gives them, moved back."""
        return moved(values, -self.sets)

    def with_slips(self, slip: np.ndarray) -> np.ndarray:
        """By how many sets (T, C) images are late in all, from slips (T, C) that were found in
        step."""
        last = len(slip) - 1
        place = np.clip(np.arange(len(slip))[:, None] - self.sets, 0, last)
        return np.take_along_axis(slip, place, 0) + self.sets.astype(slip.dtype)


def moved(values: np.ndarray, by: np.ndarray, fill: float = 0) -> np.ndarray:
    """Values (T, C, ...) of images with each camera's ``by`` (C,) sets earlier; ``fill`` where
    there are none."""
    sets = len(values)
    result = np.full_like(values, fill)
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
    stated: StatedStarts | None = None,
) -> Starts:
    """When the cameras started, from all people that they show, and from what is ``stated``.

    ``times`` (T,) s of the sets; ``available`` (T, C): the set has an image of the camera.
    """
    views, sets = len(rig), len(times)
    step = float(np.median(np.diff(times))) if sets > 1 else 0.0
    told = stated or StatedStarts.nothing(views)
    as_stated = Starts.as_stated(told, step)
    if sets < 2 or views < 2:
        return as_stated
    reach = min(round(MAX_START_S / step), int(MAX_START_SHARE * sets))
    fewest = max(MIN_SHARED_S / step, 1)
    if reach < 1 or sets - reach < fewest:
        return as_stated
    rays = moved(followed(detections, rig, times, available), as_stated.sets, np.nan)
    search = _Search(
        Pairs.of(rays, rig, reach, fewest), master, step, told.bounds(step, reach), told.known
    )
    late, denied = search.agreed()
    others = [c for c in range(views) if c != master]
    sure = {c: bool(denied[c]) or search.is_apart(late, c) for c in others}
    # that one camera surely started apart says that nobody started them together
    found = replace(as_stated, apart=any(sure.values()) or told.says_apart(step), denied=denied)
    shown = search.shown(late)
    for c in others:
        if told.known[c] and not denied[c] and not shown[c]:
            continue
        if not told.known[c] and not found.apart:
            continue
        if not told.known[c]:
            # that somebody moves at all is not known where only what is stated says "apart"
            moves = any(sure.values()) or abs(late[c]) < FEWEST_SETS_APART
            if not moves or not search.is_clear(late, c):
                found.in_doubt[c] = True
                continue
        found.late[c] = (found.sets[c] + late[c] + search.between(late, c)) * step
        found.sets[c] += late[c]
        if denied[c]:
            found.sigma[c] = np.nan
        elif told.known[c] and told.sigma[c] > step / 2:
            found.sigma[c] = step / 2  # the views tell more; slips are sought from the best place
        elif told.known[c]:
            found.late[c], found.sigma[c] = combined(
                (found.late[c], step / 2), (told.late[c], told.sigma[c])
            )
            found.sets[c] = round(found.late[c] / step)
    return found


@dataclass(frozen=True, eq=False)
class _Search:
    """How late cameras are beside what is stated, whole sets: ``bounds`` (C,) within which they do
    not deny it, of cameras of which something is ``stated`` (C,)."""

    pairs: Pairs
    master: int
    step: float
    bounds: np.ndarray
    stated: np.ndarray

    def agreed(self) -> tuple[np.ndarray, np.ndarray]:
        """Sets (C,) where the views agree best, and which cameras (C,) deny what is stated: they do
        one after another, the surest first, since a wrong one disturbs the rest."""
        denied = np.zeros(len(self.bounds), bool)
        bounds = self.bounds.copy()
        while True:
            late = self._descended(bounds)
            doubtful = self.stated & ~denied & (late != 0)
            doubtful &= ~self.shown(late)
            if doubtful.any():  # nothing sure leads away from what is stated
                bounds[doubtful] = 0
                continue
            denials = {
                c: denial
                for c in np.flatnonzero(self.stated & ~denied).tolist()
                if (denial := self._denial(late, c)) > 0
            }
            if not denials:
                return late, denied
            denied[max(denials, key=lambda c: denials[c])] = True
            bounds = np.where(denied, self.pairs.reach, self.bounds)

    def _denial(self, late: np.ndarray, camera: int) -> float:
        """By how much the views agree better with a camera out of its bounds, 0 = not surely."""
        profile = self.pairs.profile(camera, self._others(camera), late)
        tried = np.arange(-self.pairs.reach, self.pairs.reach + 1)
        if not np.isfinite(profile).any():
            return 0.0
        best = int(tried[np.nanargmin(profile)])
        if abs(best) <= self.bounds[camera]:
            return 0.0
        there = late.copy()
        there[camera] = best
        if not self.is_apart(there, camera, int(late[camera])) or not self.is_clear(there, camera):
            return 0.0
        return float(self._worse(there, camera, int(late[camera])).mean())

    def _descended(self, bounds: np.ndarray) -> np.ndarray:
        """How late (C,), in sets, cameras are where all pairs agree best, within ``bounds`` (C,):
        they join one after another, the clearest first, then each is moved until none moves."""
        pairs, master = self.pairs, self.master
        sets, joined = np.zeros(pairs.views, int), [master]
        waiting = [c for c in range(pairs.views) if c != master]
        while waiting:
            profiles = {c: pairs.profile(c, joined, sets, int(bounds[c])) for c in waiting}
            # what is stated needs no motion to be told
            least = np.where(self.stated, np.finfo(float).tiny, 0.0)
            gains = {
                c: max(_gain(profile), least[c]) if np.isfinite(profile).any() else 0.0
                for c, profile in profiles.items()
            }
            c = max(waiting, key=lambda c: gains[c])
            if gains[c] > 0:
                sets[c] = np.nanargmin(profiles[c]) - pairs.reach
                joined.append(c)
            waiting.remove(c)
        for _ in range(START_ROUNDS):
            before = sets.copy()
            for c in joined[1:]:
                profile = pairs.profile(c, [o for o in joined if o != c], sets, int(bounds[c]))
                if np.isfinite(profile).any():
                    sets[c] = np.nanargmin(profile) - pairs.reach
            if (before == sets).all():
                break
        return sets

    def is_apart(self, sets: np.ndarray, camera: int, instead: int = 0) -> bool:
        """Whether a camera is in no doubt not at ``instead``: by more than what slips and offsets
        explain, and the views disagree with it again and again over the recording."""
        if abs(sets[camera] - instead) < FEWEST_SETS_APART:
            return False
        worse = self._worse(sets, camera, instead)
        return self._surely(worse, sets, camera)

    def _surely(self, worse: np.ndarray, sets: np.ndarray, camera: int) -> bool:
        """Whether views agree ``worse`` (N,) than at a camera's time in no doubt."""
        if len(worse) < FEWEST_BLOCKS:
            return False
        series = self.pairs.series(camera, int(sets[camera]), self._others(camera), sets)
        usual = np.nanmean(series)
        least = max(START_WORSE * usual, START_SIGMAS * worse.std(ddof=1) / np.sqrt(len(worse)))
        return bool((worse > 0).mean() >= START_BLOCKS_SHARE and worse.mean() > least)

    def shown(self, sets: np.ndarray) -> np.ndarray:
        """Of which cameras (C,) the motion shows that they are near these times: where it does of
        one in no doubt, somebody moves, and of others it has to be clear."""
        views = range(len(sets))
        surely = np.array([c != self.master and self._is_shown(sets, c) for c in views])
        if not surely.any():
            return surely
        return surely | [c != self.master and self.is_clear(sets, c, if_few=False) for c in views]

    def _is_shown(self, sets: np.ndarray, camera: int) -> bool:
        """Whether a camera's time is in no doubt near this one, or at least not what is stated."""
        if self.is_apart(sets, camera):
            return True
        next_best = self._next_best(sets, camera)
        return next_best is not None and self._surely(
            self._worse(sets, camera, next_best), sets, camera
        )

    def _next_best(self, sets: np.ndarray, camera: int) -> int | None:
        """The best time of a camera that is not near its own; None where either is not known."""
        pairs = self.pairs
        profile = pairs.profile(camera, self._others(camera), sets)
        tried = np.arange(-pairs.reach, pairs.reach + 1)
        far = (np.abs(tried - sets[camera]) * self.step > START_PEAK_S) & np.isfinite(profile)
        if not far.any() or not np.isfinite(profile[sets[camera] + pairs.reach]):
            return None
        return int(tried[far][profile[far].argmin()])

    def is_clear(self, sets: np.ndarray, camera: int, *, if_few: bool = True) -> bool:
        """Whether the views agree better at a camera's time than at any that is not near;
        ``if_few`` where hardly anything was seen at the same time."""
        next_best = self._next_best(sets, camera)
        if next_best is None:
            return False
        worse = self._worse(sets, camera, next_best)
        if len(worse) < FEWEST_BLOCKS:
            return if_few
        return bool(worse.mean() > CLEAR_SIGMAS * worse.std(ddof=1) / np.sqrt(len(worse)))

    def _worse(self, sets: np.ndarray, camera: int, late: int) -> np.ndarray:
        """By how much (N,) a camera's views agree worse if it is ``late`` by so many sets than at
        its own time, mean of each block of time in which both are known."""
        others = self._others(camera)
        own = self.pairs.series(camera, int(sets[camera]), others, sets)
        change = self.pairs.series(camera, late, others, sets) - own
        size = max(1, round(START_BLOCK_S / self.step))
        whole = change[: len(change) // size * size].reshape(-1, size)
        return mean(whole[np.isfinite(whole).sum(1) * 2 >= size].T)

    def between(self, sets: np.ndarray, camera: int) -> float:
        """How far from its whole number of sets, in sets, a parabola of a camera's cost is
        lowest."""
        place = sets[camera] + self.pairs.reach
        profile = self.pairs.profile(camera, self._others(camera), sets)
        profile = profile[max(place - 1, 0) : place + 2]
        if len(profile) < 3 or not np.isfinite(profile).all():
            return 0.0
        bend = profile[0] - 2 * profile[1] + profile[2]
        return (
            float(np.clip((profile[0] - profile[2]) / (2 * bend), -0.5, 0.5)) if bend > 0 else 0.0
        )

    def _others(self, camera: int) -> list[int]:
        return [c for c in range(self.pairs.views) if c != camera]


def _gain(profile: np.ndarray) -> float:
    """How much better the best of a profile is than usual; 0 where nothing is known."""
    known = profile[np.isfinite(profile)]
    return float(np.median(known) - known.min()) if len(known) else 0.0
