"""Start times of cameras that were not started together: recordings late by up to seconds.

The rays of two cameras to a moving person meet only if both images show the same moment. The
epipolar distance is therefore low at the right lag. For each pair of cameras and each lag, robust
costs of these distances are averaged (:mod:`.start_costs`). The median distance of each body point
is subtracted first, since it stems from the calibration. The delay of each camera minimises the
costs of all its pairs.

The search begins at a stated start if there is one, else at the device times. Each other camera
alone has its own minimum: its vote. A delay is confirmed if

- a majority of the other cameras votes for it;
- the minimum of all cameras stays if any camera or any group of joints is left out;
- face, hands and feet, which the search does not use, have their minimum there;
- it is not at an end of the search range.

A camera is moved only if its delay is confirmed. If no camera's delay is longer than a slip, the
cameras were started together, and :mod:`.slips` decides whether a short delay is constant. A stated
start is overruled only if all other cameras and all groups of joints vote for one delay beyond its
bounds. A camera whose device time is not confirmed either is reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from intercap_core.formats.detections.read import PeopleOfImages
from intercap_core.formats.recordings.synchronise import frame_interval
from intercap_core.geometry.camera.rig import Rig
from intercap_core.scene.slips import longest_slip
from intercap_core.scene.start_costs import SEARCHED, WITNESS, PairCosts, follow_rays
from intercap_core.scene.starts import (
    MIN_SHARED_S,
    StartTimes,
    StatedStarts,
    combine_estimates,
    shift_images,
)

# Largest delay that is searched, seconds: cameras are started by hand, or by one command that
# reaches them in turn; tuned on the studio. If a larger one fits better, the start is undetermined.
MAX_DELAY_S = 1.5
# Half width of a minimum, seconds: votes for the same delay differ by at most this or one set. A
# time between images at 15 per second.
VOTE_WIDTH_S = 1 / 15
ALL_POINTS = tuple(k for points in SEARCHED.values() for k in points)


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
    step = frame_interval(times)
    known = stated or StatedStarts.nothing(views)
    as_stated = StartTimes.as_stated(known, step)
    if sets < 2 or views < 2:
        return as_stated
    fewest = max(MIN_SHARED_S / step, 1)
    # At most 40 % of the recording: the fewer images two cameras have in common, the more often
    # they agree by chance.
    limit = min(round(MAX_DELAY_S / step), int(0.4 * sets), int(sets - fewest))
    if limit < 1:
        return replace(as_stated, too_short=True)
    reach = min(2 * limit, int(sets - fewest))
    rays = shift_images(follow_rays(detections, rig, times, available), as_stated.sets, np.nan)
    search = _Search(
        PairCosts.of(rays, rig, reach, fewest),
        rig.names,
        master,
        max(1, round(VOTE_WIDTH_S / step)),
        known.bounds(step, limit),
        limit,
        longest_slip(1 / step),
        known.known,
    )
    late, rejected, doubts = search.agreed()
    # if one camera certainly started apart, the cameras were not started together
    moved = ~known.known & (np.abs(late) > search.slip)
    apart = bool((moved | rejected).any()) or known.states_apart(step)
    whole = late if apart else np.where(np.abs(late) > search.slip, late, 0)
    result = replace(
        as_stated, apart=apart, rejected=rejected, undetermined=tuple(doubts), short=late - whole
    )
    for c in np.flatnonzero(np.arange(views) != master).tolist():
        if not known.known[c] and not result.apart:
            continue
        if doubts[c]:
            result.in_doubt[c] = not known.known[c]
            continue
        result.sets[c] += whole[c]
        result.late[c] = (result.sets[c] + search.between(late, c)) * step
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
    names: Sequence[str]
    """(C,) camera names, for messages."""
    master: int
    """Camera whose delay is 0."""
    width: int
    """Largest difference of two votes for the same delay, sets."""
    bounds: np.ndarray
    """(C,) largest delays, sets, that do not contradict a stated start; ``limit`` without one."""
    limit: int
    """Largest delay, sets, of the search."""
    slip: int
    """Longest slip, sets. Shorter delays are not tested here."""
    stated: np.ndarray
    """(C,) bool: the start is stated."""

    def agreed(self) -> tuple[np.ndarray, np.ndarray, list[str]]:
        """Delays that the evidence confirms.

        Delays are tested relative to the majority of the cameras, because the master may be the
        camera that started apart. Cameras whose delay is not confirmed are left out one after
        another, the one with the fewest votes first, because a wrong delay disturbs the others.
        Statements are rejected one after another for the same reason.

        Returns:
            Delays (C,), sets, relative to the master; 0 = not confirmed.
            Mask (C,) of rejected statements.
            By camera, the reason why its start is not confirmed; "" = it is.
        """
        cameras = range(len(self.names))
        rejected, bounds = np.zeros(len(cameras), bool), self.bounds.copy()
        used, doubts = np.ones(len(cameras), bool), [""] * len(cameras)
        while True:
            late = self._descended(bounds, used)
            doubtful = {c: doubt for c in cameras if late[c] and (doubt := self._doubt(late, c))}
            if doubtful:
                c = min(doubtful, key=lambda c: self._support(late, c))
                doubts[c], used[c] = doubtful[c], False
                continue
            overruled = [c for c in cameras if not rejected[c] and self._is_overruled(late, c)]
            if not overruled:
                break
            c = overruled[0]
            rejected[c], doubts[c], bounds[c], used[c] = True, "", self.limit, True
        for c in cameras:
            if abs(late[c]) <= self.slip:
                unconfirmed = self._doubt(late, c)
                doubts[c] = unconfirmed and (doubts[c] or unconfirmed)
        return np.where(used, late - late[self.master], 0), rejected, doubts

    def _is_overruled(self, late: np.ndarray, camera: int) -> bool:
        """Whether all cameras and all groups of joints vote for one delay beyond the bounds."""
        there = late.copy()
        vote = self._vote(late, camera, self._others(camera))
        if not self.stated[camera] or not abs(vote) > self.bounds[camera]:
            return False
        there[camera] = int(vote)
        by_camera, by_group = self._votes(there, camera)
        unanimous = (np.abs(np.r_[by_camera, by_group] - vote) <= self.width).all()
        return bool(unanimous) and not self._doubt(there, camera)

    def _vote(
        self,
        late: np.ndarray,
        camera: int,
        others: Sequence[int],
        points: Sequence[int] = ALL_POINTS,
        bound: int | None = None,
    ) -> float:
        """Delay of least cost within the search range, sets; NaN = unknown.

        For the arguments see :meth:`PairCosts.profile`.
        """
        bound = self.limit if bound is None else bound
        profile = self.pairs.profile(camera, others, late, points, bound)
        known = np.isfinite(profile).any()
        return float(np.nanargmin(profile) - self.pairs.reach) if known else np.nan

    def _votes(self, late: np.ndarray, camera: int) -> tuple[np.ndarray, np.ndarray]:
        """Known votes of each other camera alone, and of each group of joints alone."""
        others = self._others(camera)
        by_camera = np.array([self._vote(late, camera, [other]) for other in others])
        by_group = np.array([self._vote(late, camera, others, p) for p in SEARCHED.values()])
        return by_camera[np.isfinite(by_camera)], by_group[np.isfinite(by_group)]

    def _support(self, late: np.ndarray, camera: int) -> float:
        """Share of the votes for a camera's delay: those of the other cameras, or with two cameras
        those of the groups of joints. 0 if there are none."""
        by_camera, by_group = self._votes(late, camera)
        votes = by_camera if len(self.names) > 2 else by_group
        return float((np.abs(votes - late[camera]) <= self.width).mean()) if len(votes) else 0.0

    def _doubt(self, late: np.ndarray, camera: int) -> str:
        """Why a camera's delay is not confirmed; "" if it is.

        Delays that a slip may explain need a majority of the votes only, because most cameras start
        together.
        """
        others, delay = self._others(camera), late[camera]
        profile = self.pairs.profile(camera, others, late, ALL_POINTS)
        known = np.flatnonzero(np.isfinite(profile)) - self.pairs.reach
        if delay not in known:
            return "too few of its images show a person whom others see"
        # A larger delay than is searched must be known to all pairs and have the witness's support.
        by_other = [self.pairs.profile(camera, [other], late, ALL_POINTS) for other in others]
        whole = np.isfinite(by_other).sum(0) == np.isfinite(by_other).sum(0).max()
        best = np.nanargmin(np.where(whole, profile, np.nan)) - self.pairs.reach
        witness = self._vote(late, camera, others, WITNESS, self.pairs.reach)
        is_beyond = abs(best) > self.limit and abs(best - delay) > self.width
        is_moved = abs(delay) > self.slip
        at_end = is_moved and (abs(delay) == self.limit or delay in (known[0], known[-1]))
        if at_end or (is_beyond and abs(witness - best) <= self.width):
            return "its images agree best with the others at or beyond an end of the searched range"
        if not is_moved:
            is_kept = self._support(late, camera) > 0.5
            return "" if is_kept else "the other cameras do not agree on one start"
        for other in others if len(others) > 1 else []:
            vote = self._vote(late, camera, [o for o in others if o != other])
            if not abs(vote - delay) <= self.width:
                return f"only camera {self.names[other]} shows it"
        for group, points in SEARCHED.items():
            rest = [k for k in ALL_POINTS if k not in points]
            if not abs(self._vote(late, camera, others, rest) - delay) <= self.width:
                return f"only {group} show it"
        if abs(self._vote(late, camera, others, WITNESS) - delay) > self.width:
            return "face, hands and feet do not confirm it"
        return ""

    def _descended(self, bounds: np.ndarray, used: np.ndarray) -> np.ndarray:
        """Delays (C,), in sets, that minimise the cost of all pairs of the ``used`` (C,) cameras
        within ``bounds`` (C,).

        They are relative to the majority of the cameras if these agree, else to the master. Cameras
        are added one after another, the deepest minimum first. Then each camera's delay is improved
        in turn, at most five times (coordinate descent).
        """
        waiting = np.flatnonzero(used).tolist()
        sets = np.zeros(len(used), int)
        if not waiting:
            return sets
        first = self.master if used[self.master] else waiting[0]
        waiting.remove(first)
        joined = [first]
        is_first = np.arange(len(used)) == first
        bounds = np.where(is_first, self.limit, bounds)
        while waiting:
            profiles = {
                c: self.pairs.profile(c, joined, sets, ALL_POINTS, int(bounds[c])) for c in waiting
            }
            # a camera with a stated start is added even if its profile is flat
            least = np.where(self.stated, np.finfo(float).tiny, 0.0)
            gains = {
                c: max(_gain(profile), least[c]) if np.isfinite(profile).any() else 0.0
                for c, profile in profiles.items()
            }
            c = max(waiting, key=lambda c: gains[c])
            if gains[c] > 0:
                sets[c] = np.nanargmin(profiles[c]) - self.pairs.reach
                joined.append(c)
            waiting.remove(c)
        for _ in range(5):
            before = sets.copy()
            for c in joined:
                vote = self._vote(sets, c, [o for o in joined if o != c], bound=int(bounds[c]))
                sets[c] = sets[c] if np.isnan(vote) else vote
            # If the first camera moved, all others moved against it.
            moved = np.where(np.isin(np.arange(len(sets)), joined), sets - sets[first], 0)
            sets = moved if (np.abs(moved) <= bounds).all() else np.where(is_first, 0, sets)
            if (before == sets).all():
                break
        values, counts = np.unique(sets[joined], return_counts=True)
        common = values[counts.argmax()] if counts.max() > len(used) / 2 else 0
        sets[joined] -= common
        return sets

    def between(self, sets: np.ndarray, camera: int) -> float:
        """Sub-set part of a camera's delay, in sets, by a parabola through the cost."""
        place = sets[camera] + self.pairs.reach
        profile = self.pairs.profile(camera, self._others(camera), sets, ALL_POINTS)
        profile = profile[max(place - 1, 0) : place + 2]
        if len(profile) < 3 or not np.isfinite(profile).all():
            return 0.0
        bend = profile[0] - 2 * profile[1] + profile[2]
        return (
            float(np.clip((profile[0] - profile[2]) / (2 * bend), -0.5, 0.5)) if bend > 0 else 0.0
        )

    def _others(self, camera: int) -> list[int]:
        return [c for c in range(len(self.names)) if c != camera]


def _gain(profile: np.ndarray) -> float:
    """Median minus minimum of a profile's known costs; 0 if none is known."""
    known = profile[np.isfinite(profile)]
    return float(np.median(known) - known.min()) if len(known) else 0.0
