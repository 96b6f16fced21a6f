"""Where hypotheses come from: an annotation, a search, the frames around, near symmetries."""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import replace

import numpy as np

from intercap_core.geometry.camera.transforms import apply_step, rotation_exp, step_between
from intercap_core.object_track.constants import (
    ANNOTATION_FRAMES,
    BASIN,
    DENIED_LOG_RATIO,
    DOUBTFUL_PROBABILITY,
    DOUBTFUL_SHARE,
    FIT_ROUNDS,
    HIDDEN_SHARE,
    KEY_FRAME_S,
    LOOK_NEAR_S,
    NEAR_FITTED,
    NEAR_TURN_SEARCH_RAD,
    RIVAL_LOG_RATIO,
    RUN_SEARCHED_S,
    SEARCH_EVERY_S,
    SEARCH_GOOD_LOG_RATIO,
    SEARCHES_MIN,
    SEED_SEARCHES,
    SEED_SEARCHES_MAX,
    SEED_SURE_LOG_RATIO,
    SEEN_LOG_RATIO,
    TURNS_FOLLOWED,
)
from intercap_core.object_track.decoder import NOT_SEEN, Decoded
from intercap_core.object_track.fit import Fit, MotionPrior
from intercap_core.object_track.given_poses import GivenPose
from intercap_core.object_track.hypotheses import Hypotheses
from intercap_core.object_track.motion import about
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.prior import Prior
from intercap_core.object_track.search import same_pose
from intercap_core.object_track.turns import near_turns

log = logging.getLogger(__name__)


class NotFound(Exception):
    """No frame shows anything that could be the object."""


class Proposals:
    """Adds hypotheses; ``times`` (T,) seconds, ``step_s`` between frames."""

    def __init__(
        self,
        observer: Observer,
        hypotheses: Hypotheses,
        prior: Prior,
        times: np.ndarray,
        step_s: float,
    ) -> None:
        self._observer = observer
        self._hypotheses = hypotheses
        self._prior = prior
        self._times = times
        self._step_s = step_s
        self._reach = max(1, round(LOOK_NEAR_S / step_s))
        self._searched: set[int] = set()
        self._searched_near_given: set[int] = set()
        self._looked: set[int] = set()

    # --- where to start ------------------------------------------------------------------------

    def start(self) -> int:
        """Search the most promising frames and follow what is found; the best one's number.

        Raises NotFound where nothing is.
        """
        seen: list[tuple[float, int, list[Fit]]] = []
        for tried, t in enumerate(self._observer.frames_to_search()):
            if tried >= SEED_SEARCHES_MAX or (tried >= SEED_SEARCHES and seen):
                break
            self._searched.add(t)
            found = self._observer.search(t)
            if found:
                best = float(self._prior.weigh(t, found).max())
                seen.append((best, t, found))
                if best > SEED_SURE_LOG_RATIO:
                    break
        if not seen:
            raise NotFound
        seen.sort(key=lambda one: -one[0])
        best, first, found = seen[0]
        if best < SEEN_LOG_RATIO:
            # no match near the person: take the best match, wherever it is
            likeliest = max(found, key=lambda fit: fit.log_ratio)
            self._observer.places.claim(self._observer.mesh.centre_at(likeliest.pose))
        for _, t, found in seen:
            self._follow(t, found)
        log.info("first frame %d, %.0f nats", first, best)
        return first

    def annotated(self, given: GivenPose) -> GivenPose | None:
        """Follow a pose that a person gave, and take it for its frame's where the images do not
        contradict it clearly.

        Returns it where they show it there or hide what is there; where they contradict it and show
        it in a frame beside, as of that frame; None where they show it in none.
        """
        t, pose = given.frame, given.pose
        wide = self._observer.fit(t, pose, MotionPrior(pose), FIT_ROUNDS, 1.0)
        found = [wide] if wide.log_ratio > SEEN_LOG_RATIO else []
        if not found or not given.holds(self._observer.mesh, wide.pose):
            own = self._observer.fit(t, pose, given.prior, FIT_ROUNDS)
            if own.log_ratio > DENIED_LOG_RATIO:
                found.append(own)
        if not found:
            return self._annotated_beside(given)
        self._take(given, found)
        return given

    def _annotated_beside(self, given: GivenPose) -> GivenPose | None:
        """The given pose as of the frame beside its own that shows it, after following it."""
        t, pose = given.frame, given.pose
        near = range(
            max(t - ANNOTATION_FRAMES, 0), min(t + ANNOTATION_FRAMES + 1, self._observer.count)
        )
        found: tuple[int, Fit] | None = None
        for u in sorted(near, key=lambda u: abs(u - t)):
            fit = self._observer.fit(u, pose, MotionPrior(pose), rounds=FIT_ROUNDS, scale=1.0)
            if found is None or fit.log_ratio > found[1].log_ratio + RIVAL_LOG_RATIO:
                found = u, fit
            if found[1].log_ratio > SEED_SURE_LOG_RATIO:
                break
        if found is None or found[1].log_ratio < SEEN_LOG_RATIO or found[0] in self._prior.given:
            return None
        seen = replace(given, frame=found[0], pose=found[1].pose)
        self._take(seen, [found[1]])
        return seen

    def _take(self, given: GivenPose, fits: list[Fit]) -> None:
        """Follow fits of a given pose's frame; the first says where the object is handled."""
        t = given.frame
        self._prior.given[t] = given
        if fits[0].log_ratio > SEEN_LOG_RATIO:
            self._searched.add(t)
            self._observer.places.claim(self._observer.mesh.centre_at(fits[0].pose))
        for fit in fits:
            if self._hypotheses.known(t, fit.pose) is None:
                self._hypotheses.follow(t, fit)

    # --- where it is not sure ------------------------------------------------------------------

    def look(self, decoded: Decoded) -> bool:
        """Look for the object in the frames in doubt; whether something new was found.

        First with the rotations that the frames around lead to, outwards from where it is sure, and
        with all once in each time that the object is seen, and near poses that somebody gave; then,
        in some frames, with all.
        """
        fits = self._hypotheses.fits
        ratio, sure = np.zeros(len(fits)), np.zeros(len(fits))
        for t, k in enumerate(decoded.path):
            ratio[t] = 0.0 if k == NOT_SEEN else self._prior.weigh(t, fits[t])[k]
            sure[t] = decoded.probability[t][k]
        usual = float(np.median(ratio[ratio > 0])) if (ratio > 0).any() else 0.0
        poor = DOUBTFUL_SHARE * usual
        doubt = (ratio < poor) | (sure < DOUBTFUL_PROBABILITY) | (decoded.path == NOT_SEEN)
        known = {int(t): fits[t][decoded.path[t]].pose for t in np.flatnonzero(~doubt)}
        new = False
        waiting = [int(t) for t in np.flatnonzero(doubt)]
        for t in sorted(waiting, key=lambda t: min((abs(t - u) for u in known), default=0)):
            if self._hypotheses.best(t) < poor and t not in self._looked:
                new |= self._look_near(t, known)
        near = self._prior.near_given(self._times, decoded.path == NOT_SEEN)
        new |= self._look_near_given([t for t in waiting if near[t]], known)
        most = SEARCHES_MIN + int((self._times[-1] - self._times[0]) / SEARCH_EVERY_S)
        for t in self._unsearched(decoded.path, ratio)[: max(most - len(self._searched), 0)]:
            self._searched.add(t)
            new |= self._follow(t, self._observer.search(t))
        if new:
            return True
        apart = max(1, round(SEARCH_EVERY_S / self._step_s)) // 2
        # a pose that motion is sure of is hidden, rather than elsewhere
        open_ = (sure < DOUBTFUL_PROBABILITY) | (ratio < HIDDEN_SHARE * usual)
        waiting = [t for t in waiting if open_[t]]
        while len(self._searched) < most and not new:
            waiting = [
                t
                for t in waiting
                if self._hypotheses.best(t) < poor
                and min((abs(t - u) for u in self._searched), default=apart) >= apart
            ]
            if not waiting:
                break
            t = max(waiting, key=self._observer.promise)
            self._searched.add(t)
            new = self._follow(t, self._observer.search(t))
        return new

    def _look_near_given(self, frames: list[int], known: dict[int, np.ndarray]) -> bool:
        """Search the ``frames``, which are near given poses, with all rotations, once, around where
        the object is in the nearest of the frames ``known``; whether something new was found.
        Somebody says that it is there: it is worth as many searches as frames."""
        new = False
        for t in frames:
            if t not in self._searched | self._searched_near_given:
                self._searched_near_given.add(t)
                poses = [known[u] for u in _beside(t, known)]
                places = np.array([self._observer.mesh.centre_at(pose) for pose in poses])
                new |= self._follow(t, self._observer.search(t, places=places if poses else None))
        return new

    def look_again(self, changed: set[int]) -> None:
        """Let :meth:`look` look once more where what is known around has ``changed``."""
        near = range(-self._reach, self._reach + 1)
        self._looked -= {t + step for t in changed for step in near}

    def _unsearched(self, path: np.ndarray, ratio: np.ndarray) -> list[int]:
        """The likeliest frame of every time that the object is seen for longer, in no frame of
        which it was searched: what reappears may have turned out of sight."""
        seen = np.flatnonzero(path != NOT_SEEN)
        runs = np.split(seen, np.flatnonzero(np.diff(seen) > 1) + 1)
        return [
            int(run[ratio[run].argmax()])
            for run in runs
            if len(run) * self._step_s >= RUN_SEARCHED_S and not self._searched & set(run.tolist())
        ]

    def _look_near(self, t: int, known: dict[int, np.ndarray]) -> bool:
        """Search frame t with the rotations that the frames around lead to, ``known`` poses (4, 4)
        by frame; whether something new was found."""
        starts, rates = self._expected(t, known)
        if not len(starts):
            return False
        self._looked.add(t)
        seen = self._observer.assess_all(t, starts, twists=rates)
        found: list[Fit] = []
        tried: list[np.ndarray] = []
        for start in sorted(seen, key=lambda one: -one.log_ratio):
            if len(tried) == NEAR_FITTED or any(
                same_pose(self._observer.mesh, start.pose, other, BASIN) for other in tried
            ):
                continue
            tried.append(start.pose)
            prior = MotionPrior(start.pose)
            found.append(
                self._observer.fit(t, start.pose, prior, FIT_ROUNDS, 1.0, twist=start.twist)
            )
            if found[-1].log_ratio > SEARCH_GOOD_LOG_RATIO:
                break
        best = max(found, key=lambda one: one.log_ratio)
        if best.log_ratio < SEARCH_GOOD_LOG_RATIO:
            turns = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]) * NEAR_TURN_SEARCH_RAD
            around = rotation_exp(turns)[:, None] @ starts[None, :, :3, :3]
            places = [self._observer.mesh.centre_at(start) for start in starts]
            motion = best.twist, best.pose[:3, 3]
            found += self._observer.search(t, around.reshape(-1, 3, 3), np.array(places), motion)
        return self._follow(t, found)

    def _expected(self, t: int, known: dict[int, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Poses (N, 4, 4) of frame t by those of the frames around, and their twists (N, 6): as
        they are, at constant velocity or in a hand from either side, and between."""
        fits, reach = self._hypotheses.fits, self._reach
        same = self._observer.mesh.symmetry.nearest_equivalent_pose
        poses = {}
        for u in range(max(t - reach, 0), min(t + reach + 1, len(fits))):
            if u in known:
                poses[u] = known[u]
            elif u != t and self._hypotheses.best(u) > SEARCH_GOOD_LOG_RATIO:
                poses[u] = fits[u][int(self._prior.weigh(u, fits[u]).argmax())].pose
        before = [u for u in poses if u < t][:-3:-1]
        after = [u for u in poses if u > t][:2]
        found, rates = [], []
        for near in (before, after):
            if not near:
                continue
            here = poses[near[0]]
            ahead = self._times[t] - self._times[near[0]]
            found.append(here)
            rates.append(np.zeros(6))
            if len(near) > 1:
                rate = step_between(same(poses[near[1]], here), here) / (
                    self._times[near[0]] - self._times[near[1]]
                )
                found.append(apply_step(here, rate * ahead))
                rates.append(rate)
            for pose in self._observer.carried(near[0], t, here):
                found.append(pose)
                rates.append(step_between(here, pose) / ahead)
        if before and after:
            a, b = before[0], after[0]
            gap = self._times[b] - self._times[a]
            rate = step_between(poses[a], same(poses[b], poses[a])) / gap
            found.append(apply_step(poses[a], rate * (self._times[t] - self._times[a])))
            rates.append(rate)
        return np.array(found).reshape(-1, 4, 4), np.array(rates).reshape(-1, 6)

    # --- near symmetries -----------------------------------------------------------------------

    def turn(self, decoded: Decoded) -> bool:
        """Follow turns of a nearly symmetric object from where they look as likely; whether one is
        new."""
        turns = near_turns(self._observer.mesh, self._observer.field)
        every = max(1, round(KEY_FRAME_S / self._step_s))
        # what is followed from one of them may change the order in others
        keys = {
            t: self._hypotheses.fits[t][decoded.path[t]]
            for t in range(0, len(decoded.path), every)
            if decoded.path[t] != NOT_SEEN and len(turns) > 1
        }
        new = False
        for t, own in keys.items():
            poses = own.pose @ turns[1:]
            moving = np.array([about(own.twist, own.pose[:3, 3], pose[:3, 3]) for pose in poses])
            found = self._observer.assess_all(t, poses, twists=moving)
            found = [one for one in found if one.log_ratio > own.log_ratio - RIVAL_LOG_RATIO]
            found.sort(key=lambda one: -one.log_ratio)
            for other in found[:TURNS_FOLLOWED]:
                if self._hypotheses.known(t, other.pose) is None:
                    prior = MotionPrior(other.pose)
                    fit = self._observer.fit(t, other.pose, prior, twist=other.twist)
                    new |= self._follow(t, [fit])
        return new

    def _follow(self, t: int, found: list[Fit]) -> bool:
        """Follow those of the fits of frame t that may be true; whether one was new."""
        own = self._hypotheses.fits[t]
        weights = self._prior.weigh(t, [*found, *own])
        least = max(float(weights.max(initial=0.0)) - RIVAL_LOG_RATIO, SEEN_LOG_RATIO)
        new = False
        for fit, weight in zip(found, weights, strict=False):
            if weight > least and self._hypotheses.seen(t, fit.pose) is None:
                self._hypotheses.follow(t, fit)
                new = True
        return new


def _beside(t: int, known: Collection[int]) -> list[int]:
    """The nearest of the ``known`` frames before and after frame t, where there are any."""
    before, after = [u for u in known if u < t], [u for u in known if u > t]
    return [*([max(before)] if before else []), *([min(after)] if after else [])]
