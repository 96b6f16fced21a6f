"""Start times of cameras that were not started together: recordings late by up to seconds.

The method needs no synchronised views. The rays of two cameras to a moving person meet only where
both show the same moment, so the epipolar distance is low at the right lag. For each pair of
cameras and each lag the truncated distances are summed (:mod:`.start_costs`); the median of each
body point is subtracted, since it stems from the calibration. The lags of all pairs together give
the start times. If the person hardly moves, or the motion repeats itself, no start is returned.

The search begins at a stated start if there is one, else at the device times. A camera leaves this
point only if the views clearly agree better elsewhere; if that is far away, the stated start is
rejected.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from intercap_core.formats.detections.read import PeopleOfImages
from intercap_core.geometry.camera.rig import Rig
from intercap_core.scene.start_costs import PairCosts, follow_rays, known_mean
from intercap_core.scene.starts import (
    FEWEST_SETS_APART,
    MIN_SHARED_S,
    StartTimes,
    StatedStarts,
    combine_estimates,
    shift_images,
)

MAX_START_S = 1.5  # cameras are started by hand or by one command that reaches them in turn
MAX_START_SHARE = 0.4  # of the recording: less in common tells little; tuned on the studio
# A camera started apart if views agree better so than as they are, and than at any time that is not
# near: in most blocks of time, by so many standard errors of their mean, and by a share of how much
# they disagree anyway. Tuned on the studio.
START_BLOCK_S, START_BLOCKS_SHARE, START_SIGMAS, START_WORSE = 0.3, 0.7, 3.0, 0.2
CLEAR_SIGMAS, START_PEAK_S, FEWEST_BLOCKS = 1.0, 0.15, 4
START_ROUNDS = 5


def find_starts(
    detections: PeopleOfImages,
    rig: Rig,
    times: np.ndarray,
    available: np.ndarray,
    *,
    master: int = 0,
    stated: StatedStarts | None = None,
) -> StartTimes:
    """When the cameras started, from all people that they show, and from what is ``stated``.

    ``times`` (T,) s of the sets; ``available`` (T, C): the set has an image of the camera.
    """
    views, sets = len(rig), len(times)
    step = float(np.median(np.diff(times))) if sets > 1 else 0.0
    told = stated or StatedStarts.nothing(views)
    as_stated = StartTimes.as_stated(told, step)
    if sets < 2 or views < 2:
        return as_stated
    reach = min(round(MAX_START_S / step), int(MAX_START_SHARE * sets))
    fewest = max(MIN_SHARED_S / step, 1)
    if reach < 1 or sets - reach < fewest:
        return as_stated
    rays = shift_images(follow_rays(detections, rig, times, available), as_stated.sets, np.nan)
    search = _Search(
        PairCosts.of(rays, rig, reach, fewest), master, step, told.bounds(step, reach), told.known
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
            found.late[c], found.sigma[c] = combine_estimates(
                (found.late[c], step / 2), (told.late[c], told.sigma[c])
            )
            found.sets[c] = round(found.late[c] / step)
    return found


@dataclass(frozen=True, eq=False)
class _Search:
    """How late cameras are beside what is stated, whole sets: ``bounds`` (C,) within which they do
    not deny it, of cameras of which something is ``stated`` (C,)."""

    pairs: PairCosts
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
        return known_mean(whole[np.isfinite(whole).sum(1) * 2 >= size].T)

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
