"""Start times of cameras that were not started together: recordings late by up to seconds.

The rays of two cameras to a moving person meet only if both images show the same moment. The
epipolar distance is therefore low at the right lag. For each pair of cameras and each lag, robust
costs of these distances are averaged (:mod:`.start_costs`). The median distance of each body point
is subtracted first, since it stems from the calibration. The delay of each camera minimises the
costs of all its pairs. If the person hardly moves, or the motion is periodic, no start is returned.

The search begins at a stated start if there is one, else at the device times. The result differs
from this initial value only if the cost is clearly lower elsewhere. If the difference exceeds the
accuracy of a stated start, the statement is rejected.

Significance is tested on blocks of 0.3 s, whose cost differences count as independent.
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

FEWEST_BLOCKS = 4  # least number of blocks for a significance test; tuned on the studio


def find_starts(
    detections: PeopleOfImages,
    rig: Rig,
    times: np.ndarray,
    available: np.ndarray,
    *,
    master: int = 0,
    stated: StatedStarts | None = None,
) -> StartTimes:
    """Estimate when the cameras started, from all visible people and ``stated`` starts.

    Args:
        times: (T,) seconds of the sets.
        available: (T, C) bool, the set has an image of the camera.
        master: camera whose delay is 0.
        stated: starts from sound or the user; None = no statements.
    """
    views, sets = len(rig), len(times)
    step = float(np.median(np.diff(times))) if sets > 1 else 0.0
    known = stated or StatedStarts.nothing(views)
    as_stated = StartTimes.as_stated(known, step)
    if sets < 2 or views < 2:
        return as_stated
    # Largest delay: cameras are started by hand, or by one command that reaches them in turn.
    # 1.5 s, at most 40 % of the recording; tuned on the studio.
    fewest = max(MIN_SHARED_S / step, 1)
    reach = min(round(1.5 / step), int(0.4 * sets), int(sets - fewest))
    if reach < 1:
        return replace(as_stated, too_short=True)
    rays = shift_images(follow_rays(detections, rig, times, available), as_stated.sets, np.nan)
    search = _Search(
        PairCosts.of(rays, rig, reach, fewest), master, step, known.bounds(step, reach), known.known
    )
    late, rejected = search.agreed()
    others = [c for c in range(views) if c != master]
    certain = {c: bool(rejected[c]) or search.is_apart(late, c) for c in others}
    # if one camera certainly started apart, the cameras were not started together
    result = replace(
        as_stated,
        apart=any(certain.values()) or known.states_apart(step),
        rejected=rejected,
        beyond=tuple(c for c in others if search.is_beyond(late, c)),
    )
    shown = search.shown(late)
    for c in others:
        if known.known[c] and not rejected[c] and not shown[c]:
            continue
        if not known.known[c] and not result.apart:
            continue
        if not known.known[c]:
            # If only a statement says that cameras started apart, nobody may move in the recording.
            # A delay of FEWEST_SETS_APART or more is then not believed.
            moves = any(certain.values()) or abs(late[c]) < FEWEST_SETS_APART
            if not moves or not search.is_clear(late, c):
                result.in_doubt[c] = True
                continue
        result.late[c] = (result.sets[c] + late[c] + search.between(late, c)) * step
        result.sets[c] += late[c]
        if rejected[c]:
            result.sigma[c] = np.nan
        elif known.known[c] and known.sigma[c] > step / 2:
            result.sigma[c] = step / 2  # the estimate replaces the less accurate statement
        elif known.known[c]:
            result.late[c], result.sigma[c] = combine_estimates(
                (result.late[c], step / 2), (known.late[c], known.sigma[c])
            )
            result.sets[c] = round(result.late[c] / step)
    return result


@dataclass(frozen=True, eq=False)
class _Search:
    """Search for the delays of cameras relative to stated starts, in whole sets."""

    pairs: PairCosts
    """Costs by lag."""
    master: int
    """Camera whose delay is 0."""
    step: float
    """Seconds per set."""
    bounds: np.ndarray
    """(C,) largest delays, sets, that do not contradict a stated start; ``reach`` without one."""
    stated: np.ndarray
    """(C,) bool: the start is stated."""

    def agreed(self) -> tuple[np.ndarray, np.ndarray]:
        """Delays (C,), sets, of least cost, and a mask (C,) of rejected statements.

        Statements are rejected one after another, the clearest first, because a wrong one disturbs
        the others.
        """
        rejected = np.zeros(len(self.bounds), bool)
        bounds = self.bounds.copy()
        while True:
            late = self._descended(bounds)
            doubtful = self.stated & ~rejected & (late != 0)
            doubtful &= ~self.shown(late)
            if doubtful.any():  # the motion does not confirm the deviation: keep the stated start
                bounds[doubtful] = 0
                continue
            gains = {
                c: gain
                for c in np.flatnonzero(self.stated & ~rejected).tolist()
                if (gain := self._rejection_gain(late, c)) > 0
            }
            if not gains:
                return late, rejected
            rejected[max(gains, key=lambda c: gains[c])] = True
            bounds = np.where(rejected, self.pairs.reach, self.bounds)

    def _rejection_gain(self, late: np.ndarray, camera: int) -> float:
        """Decrease of the cost if a camera leaves its bounds; 0 = not significant."""
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
        """Delays (C,), in sets, that minimise the cost of all pairs within ``bounds`` (C,).

        Cameras are added one after another, the deepest minimum first. Then each camera's delay is
        improved in turn, at most five times (coordinate descent).
        """
        pairs, master = self.pairs, self.master
        sets, joined = np.zeros(pairs.views, int), [master]
        waiting = [c for c in range(pairs.views) if c != master]
        while waiting:
            profiles = {c: pairs.profile(c, joined, sets, int(bounds[c])) for c in waiting}
            # a camera with a stated start is added even if its profile is flat
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
        for _ in range(5):
            before = sets.copy()
            for c in joined[1:]:
                profile = pairs.profile(c, [o for o in joined if o != c], sets, int(bounds[c]))
                if np.isfinite(profile).any():
                    sets[c] = np.nanargmin(profile) - pairs.reach
            if (before == sets).all():
                break
        return sets

    def is_apart(self, sets: np.ndarray, camera: int, instead: int = 0) -> bool:
        """Whether a camera's delay significantly differs from ``instead``, by at least
        :data:`FEWEST_SETS_APART` sets. Smaller differences are slips or time offsets."""
        if abs(sets[camera] - instead) < FEWEST_SETS_APART or self._at_end(sets, camera):
            return False
        return self._significant(self._worse(sets, camera, instead), sets, camera)

    def is_beyond(self, sets: np.ndarray, camera: int) -> bool:
        """Whether a camera's delay is at an end of the searched range, and significant."""
        return (
            abs(sets[camera]) >= FEWEST_SETS_APART
            and self._at_end(sets, camera)
            and self._significant(self._worse(sets, camera, 0), sets, camera)
        )

    def _at_end(self, sets: np.ndarray, camera: int) -> bool:
        """Whether a camera's delay is the first or the last with a known cost: no minimum."""
        profile = self.pairs.profile(camera, self._others(camera), sets)
        known = np.flatnonzero(np.isfinite(profile)) - self.pairs.reach
        return len(known) > 0 and sets[camera] in (known[0], known[-1])

    def _significant(self, worse: np.ndarray, sets: np.ndarray, camera: int) -> bool:
        """Whether the cost increases ``worse`` (N,), by block, are significant.

        They must be positive in 70 % of the blocks, and their mean above three standard errors and
        20 % of the usual cost; tuned on the studio.
        """
        if len(worse) < FEWEST_BLOCKS:
            return False
        series = self.pairs.series(camera, int(sets[camera]), self._others(camera), sets)
        usual = np.nanmean(series)
        least = max(0.2 * usual, 3.0 * worse.std(ddof=1) / np.sqrt(len(worse)))
        return bool((worse > 0).mean() >= 0.7 and worse.mean() > least)

    def shown(self, sets: np.ndarray) -> np.ndarray:
        """Mask (C,) of the cameras whose delays the motion confirms.

        If the delay of one camera is significant, somebody moves. For the others a clear minimum of
        the cost then suffices.
        """
        views = range(len(sets))
        certain = np.array([c != self.master and self._is_shown(sets, c) for c in views])
        if not certain.any():
            return certain
        return certain | [c != self.master and self.is_clear(sets, c, if_few=False) for c in views]

    def _is_shown(self, sets: np.ndarray, camera: int) -> bool:
        """Whether a camera's delay significantly differs from 0, or from the next best delay."""
        if self._at_end(sets, camera):
            return False
        if self.is_apart(sets, camera):
            return True
        next_best = self._next_best(sets, camera)
        return next_best is not None and self._significant(
            self._worse(sets, camera, next_best), sets, camera
        )

    def _next_best(self, sets: np.ndarray, camera: int) -> int | None:
        """Best other delay, sets, more than 0.15 s from a camera's own; None if either cost is
        unknown."""
        pairs = self.pairs
        profile = pairs.profile(camera, self._others(camera), sets)
        tried = np.arange(-pairs.reach, pairs.reach + 1)
        far = np.abs(tried - sets[camera]) * self.step > 0.15  # seconds; tuned on the studio
        far &= np.isfinite(profile)
        if not far.any() or not np.isfinite(profile[sets[camera] + pairs.reach]):
            return None
        return int(tried[far][profile[far].argmin()])

    def is_clear(self, sets: np.ndarray, camera: int, *, if_few: bool = True) -> bool:
        """Whether the cost at a camera's delay is one standard error below that at the next best.

        ``if_few``: the answer if there are too few blocks.
        """
        next_best = self._next_best(sets, camera)
        if next_best is None or self._at_end(sets, camera):
            return False
        worse = self._worse(sets, camera, next_best)
        if len(worse) < FEWEST_BLOCKS:
            return if_few
        return bool(worse.mean() > worse.std(ddof=1) / np.sqrt(len(worse)))

    def _worse(self, sets: np.ndarray, camera: int, late: int) -> np.ndarray:
        """Cost at a delay of ``late`` sets minus that at the camera's own delay, by block (N,).

        Blocks with fewer than half of their sets known are left out.
        """
        others = self._others(camera)
        own = self.pairs.series(camera, int(sets[camera]), others, sets)
        change = self.pairs.series(camera, late, others, sets) - own
        size = max(1, round(0.3 / self.step))  # blocks of 0.3 s; tuned on the studio
        whole = change[: len(change) // size * size].reshape(-1, size)
        return known_mean(whole[np.isfinite(whole).sum(1) * 2 >= size].T)

    def between(self, sets: np.ndarray, camera: int) -> float:
        """Sub-set part of a camera's delay, in sets, by a parabola through the cost."""
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
    """Median minus minimum of a profile's known costs; 0 if none is known."""
    known = profile[np.isfinite(profile)]
    return float(np.median(known) - known.min()) if len(known) else 0.0
