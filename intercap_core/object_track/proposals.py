"""Sources of hypotheses: annotated poses, searches, neighbouring frames, near symmetries.

Weight is the evidence for a hypothesis with its prior (:meth:`.hypotheses.Prior.weigh`), nats. A
frame is sure if it is not uncertain by the rule of :meth:`Proposals.search_uncertain`.
"""

from __future__ import annotations

import logging

import numpy as np

from intercap_core.geometry.camera.transforms import apply_step, rotation_exp, step_between
from intercap_core.geometry.solve.time_series import nearest, runs
from intercap_core.object_track.decoder import HIDDEN, Decoded
from intercap_core.object_track.fit import AT_REST, FIT_ROUNDS, FittedPose, MotionPrior
from intercap_core.object_track.given_poses import GivenPose
from intercap_core.object_track.hypotheses import RIVAL_LOG_RATIO, Hypotheses
from intercap_core.object_track.likelihood import DECISIVE_LOG_RATIO, SEEN_LOG_RATIO
from intercap_core.object_track.motion import shift_twist
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.turns import (
    UNSURE_M,
    UNSURE_RAD,
    distinct_poses,
    find_near_symmetries,
)

SEED_SURE_LOG_RATIO = 40.0  # a first frame with this weight ends the search, nats; tuned
KEY_FRAME_S = 0.2  # time between frames in which near symmetries and colours are compared; tuned
DOUBTFUL_PROBABILITY = 0.9  # below this probability of its hypothesis a frame is uncertain; tuned
# Log-likelihood ratio at which the images of a frame clearly contradict an annotated pose: two or
# three views see past the object. An occluded frame reaches -6, and so does chance.
DENIED_LOG_RATIO = -25.0  # nats; tuned on five objects at noise 2 with two cameras of the studio

log = logging.getLogger(__name__)


class NotFound(Exception):
    """No frame shows a possible object."""


class Proposals:
    """Adds hypotheses to the frames of a recording."""

    def __init__(self, observer: Observer, hypotheses: Hypotheses) -> None:
        self._observer = observer
        self._hypotheses = hypotheses
        self._prior = hypotheses.prior
        self._times = observer.times
        self._reach = observer.frames_in(0.3)
        self._searched: set[int] = set()
        self._searched_near_annotated: set[int] = set()
        self._searched_nearby: set[int] = set()

    def start(self) -> int:
        """Search the three most promising frames, more while none shows the object, ten at most.

        A frame that certainly shows the object ends the search at once. All hypotheses are
        followed. Returns the frame with the largest weight; raises NotFound if there is none.
        """
        results: list[tuple[float, int, list[FittedPose]]] = []
        for tried, t in enumerate(self._observer.frames_to_search()):
            if tried >= 10 or (tried >= 3 and results):
                break
            self._searched.add(t)
            fits = self._observer.search(t)
            if fits:
                best = float(self._prior.weigh(t, fits).max())
                results.append((best, t, fits))
                if best > SEED_SURE_LOG_RATIO:
                    break
        if not results:
            raise NotFound
        results.sort(key=lambda result: -result[0])
        best, first, fits = results[0]
        if best < SEEN_LOG_RATIO:
            # no match near the person: take the best match, wherever it is
            likeliest = max(fits, key=lambda fit: fit.log_ratio)
            self._observer.places.claim(self._observer.mesh.centre_at(likeliest.pose))
        for _, t, fits in results:
            self._follow(t, fits)
        log.info("first frame %d, log-likelihood ratio %.0f", first, best)
        return first

    def add_annotated(self, given: GivenPose) -> bool:
        """Follow an annotated pose, unless the images clearly contradict it; returns whether."""
        t, pose = given.frame, given.pose
        wide = self._fit(t, pose)
        fits = [wide] if wide.log_ratio > SEEN_LOG_RATIO else []
        if not fits or not given.holds(self._observer.mesh, wide.pose):
            prior = MotionPrior(pose, given.sigma_m, given.sigma_rad)
            own = self._observer.fit(t, pose, prior, FIT_ROUNDS)
            if own.log_ratio > DENIED_LOG_RATIO:
                fits.append(own)
        if not fits:
            return False
        self._prior.given[t] = given
        if fits[0].log_ratio > SEEN_LOG_RATIO:  # the first fit claims its place
            self._searched.add(t)
            self._observer.places.claim(self._observer.mesh.centre_at(fits[0].pose))
        for fit in fits:
            if self._hypotheses.known(t, fit.pose) is None:
                self._hypotheses.follow(t, fit)
        return True

    def search_uncertain(self, decoded: Decoded) -> bool:
        """Search the uncertain frames; returns whether a hypothesis is new.

        1. From the poses of neighbouring frames, outwards from sure frames.
        2. With all rotations, once in each run of visible frames and near annotated poses.
        3. If nothing is new, with all rotations in frames that are at least 0.25 s from searched
           ones, until a hypothesis is new.

        All searches with all rotations but those near annotated poses share a budget: six frames,
        and one more for each 0.5 s of the recording. A frame is uncertain if the object is hidden
        in it, or if its hypothesis is improbable or has less than half of the weight that is usual
        in this recording.
        """
        fits, hidden = self._hypotheses.fits, decoded.path == HIDDEN
        weight, probability = np.zeros(len(fits)), np.zeros(len(fits))
        for t, k in enumerate(decoded.path):
            weight[t] = 0.0 if k == HIDDEN else self._prior.weigh(t, fits[t])[k]
            probability[t] = decoded.probability[t][k]
        # if the object is hidden in all frames, no weight is usual, and every frame is uncertain
        usual = float(np.median(weight[weight > 0])) if (weight > 0).any() else np.inf
        poor = 0.5 * usual
        doubtful = (weight < poor) | (probability < DOUBTFUL_PROBABILITY) | hidden
        sure = {int(t): fits[t][decoded.path[t]].pose for t in np.flatnonzero(~doubtful)}
        uncertain = np.flatnonzero(doubtful).tolist()
        new = False
        away = dict(zip(uncertain, _distance(uncertain, list(sure)), strict=True))
        for t in sorted(uncertain, key=away.__getitem__):  # nearest first
            if self._hypotheses.best(t) < poor and t not in self._searched_nearby:
                new |= self._search_nearby(t, sure)
        near = self._prior.near_annotated(hidden)
        new |= self._search_near_annotated([t for t in uncertain if near[t]], sure)
        every_s = 0.5
        budget = 6 + int((self._times[-1] - self._times[0]) / every_s)
        runs = self._unsearched_runs(decoded.path, weight)
        for t in runs[: max(budget - len(self._searched), 0)]:
            new |= self._search(t)
        if new:
            return True
        apart = self._observer.frames_in(every_s) // 2
        # a probable pose of small weight follows from the motion, although little is visible
        is_open = (probability < DOUBTFUL_PROBABILITY) | (weight < 0.25 * usual)
        uncertain = [t for t in uncertain if is_open[t]]
        while len(self._searched) < budget and not new:
            distance = _distance(uncertain, sorted(self._searched), default=apart)
            uncertain = [
                t
                for t, away in zip(uncertain, distance, strict=True)
                if away >= apart and self._hypotheses.best(t) < poor
            ]
            if not uncertain:
                break
            new = self._search(max(uncertain, key=self._observer.count_promising_views))
        return new

    def _search(self, t: int) -> bool:
        """Search frame t with all rotations; returns whether a hypothesis is new."""
        self._searched.add(t)
        return self._follow(t, self._observer.search(t))

    def _fit(self, t: int, pose: np.ndarray, twist: np.ndarray = AT_REST) -> FittedPose:
        """Fit frame t from an inaccurate pose (4, 4), with wide robust scales."""
        return self._observer.fit(t, pose, MotionPrior(pose), FIT_ROUNDS, 1.0, twist=twist)

    def _search_near_annotated(self, frames: list[int], sure: dict[int, np.ndarray]) -> bool:
        """Search ``frames`` near annotated poses once, around the nearest ``sure`` poses (4, 4).

        All rotations are tried. Returns whether a hypothesis is new.
        """
        new = False
        for t in frames:
            if t not in self._searched | self._searched_near_annotated:
                self._searched_near_annotated.add(t)
                before, after = [u for u in sure if u < t], [u for u in sure if u > t]
                poses = [sure[u] for u in (*before[-1:], *after[:1])]
                places = np.array([self._observer.mesh.centre_at(pose) for pose in poses])
                new |= self._follow(t, self._observer.search(t, places=places if poses else None))
        return new

    def allow_search_near(self, changed: set[int]) -> None:
        """Let :meth:`search_uncertain` search again near frames whose hypotheses have changed."""
        near = range(-self._reach, self._reach + 1)
        self._searched_nearby -= {t + step for t in changed for step in near}

    def _unsearched_runs(self, path: np.ndarray, weight: np.ndarray) -> list[int]:
        """Return a frame of each run of visible frames in which no frame was searched.

        It is the frame with the largest ``weight`` (T,). Runs shorter than 0.2 s are left out. An
        object that reappears may have been rotated while it was hidden.
        """
        return [
            first + int(weight[first : last + 1].argmax())
            for first, last in runs(path != HIDDEN)
            if (last + 1 - first) * self._observer.step_s >= 0.2
            and not self._searched & set(range(first, last + 1))
        ]

    def _search_nearby(self, t: int, sure: dict[int, np.ndarray]) -> bool:
        """Search frame t from poses of neighbouring frames; returns whether a hypothesis is new."""
        starts, rates = self._starts(t, sure)
        if not len(starts):
            return False
        self._searched_nearby.add(t)
        assessed = self._observer.assess_all(t, starts, twists=rates)
        assessed.sort(key=lambda fit: -fit.log_ratio)
        mesh, fits = self._observer.mesh, []
        poses = [fit.pose for fit in assessed]
        for k in distinct_poses(mesh, poses, (UNSURE_M, UNSURE_RAD), count=3):
            fits.append(self._fit(t, assessed[k].pose, assessed[k].twist))
            if fits[-1].log_ratio > DECISIVE_LOG_RATIO:
                break
        best = max(fits, key=lambda fit: fit.log_ratio)
        if best.log_ratio < DECISIVE_LOG_RATIO:
            # no turn, and 35 degrees about each axis either way
            turns = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]) * np.radians(35)
            around = rotation_exp(turns)[:, None] @ starts[None, :, :3, :3]
            places = [mesh.centre_at(start) for start in starts]
            motion = best.twist, best.pose[:3, 3]
            fits += self._observer.search(t, around.reshape(-1, 3, 3), np.array(places), motion)
        return self._follow(t, fits)

    def _starts(self, t: int, sure: dict[int, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Predict poses (N, 4, 4) of frame t and their twists (N, 6) from neighbouring frames.

        From the frames before and from those after: at rest, at constant velocity, in a hand. From
        both: interpolated.
        """
        fits, times = self._hypotheses.fits, self._times
        same = self._observer.mesh.symmetry.nearest_equivalent_pose
        poses = {}
        for u in range(max(t - self._reach, 0), min(t + self._reach + 1, len(fits))):
            if u in sure:
                poses[u] = sure[u]
            elif u != t and self._hypotheses.best(u) > DECISIVE_LOG_RATIO:
                poses[u] = fits[u][int(self._prior.weigh(u, fits[u]).argmax())].pose
        before = [u for u in poses if u < t][:-3:-1]  # the last two, the nearest first
        after = [u for u in poses if u > t][:2]
        starts, rates = [], []
        for near in (before, after):
            if not near:
                continue
            here, ahead = poses[near[0]], times[t] - times[near[0]]
            starts.append(here)
            rates.append(np.zeros(6))
            if len(near) > 1:
                step = step_between(same(poses[near[1]], here), here)
                rates.append(step / (times[near[0]] - times[near[1]]))
                starts.append(apply_step(here, rates[-1] * ahead))
            for pose in self._observer.carried(near[0], t, here):
                starts.append(pose)
                rates.append(step_between(here, pose) / ahead)
        if before and after:
            a, b = before[0], after[0]
            step = step_between(poses[a], same(poses[b], poses[a]))
            rates.append(step / (times[b] - times[a]))
            starts.append(apply_step(poses[a], rates[-1] * (times[t] - times[a])))
        return np.array(starts).reshape(-1, 4, 4), np.array(rates).reshape(-1, 6)

    def add_near_symmetries(self, decoded: Decoded) -> bool:
        """Follow poses that near symmetries make as likely as the chosen hypothesis.

        One frame in ``KEY_FRAME_S`` is tested. Returns whether a hypothesis is new.
        """
        turns = find_near_symmetries(self._observer.mesh, self._observer.field)
        every = self._observer.frames_in(KEY_FRAME_S)
        # copied, since following from one key frame may change the order in others
        keys = {
            t: self._hypotheses.fits[t][decoded.path[t]]
            for t in range(0, len(decoded.path), every)
            if decoded.path[t] != HIDDEN and len(turns) > 1
        }
        new = False
        for t, own in keys.items():
            poses = own.pose @ turns[1:]
            rates = [shift_twist(own.twist, own.pose[:3, 3], pose[:3, 3]) for pose in poses]
            fits = self._observer.assess_all(t, poses, np.array(rates))
            fits = [fit for fit in fits if fit.log_ratio > own.log_ratio - RIVAL_LOG_RATIO]
            fits.sort(key=lambda fit: -fit.log_ratio)
            for other in fits[:2]:
                if self._hypotheses.known(t, other.pose) is None:
                    prior = MotionPrior(other.pose)
                    fit = self._observer.fit(t, other.pose, prior, twist=other.twist)
                    new |= self._follow(t, [fit])
        return new

    def _follow(self, t: int, fits: list[FittedPose]) -> bool:
        """Follow the fits of frame t that may be true; returns whether a hypothesis is new."""
        own = self._hypotheses.fits[t]
        weights = self._prior.weigh(t, [*fits, *own])
        least = max(float(weights.max(initial=0.0)) - RIVAL_LOG_RATIO, SEEN_LOG_RATIO)
        new = False
        for fit, weight in zip(fits, weights, strict=False):
            if weight > least and self._hypotheses.seen(t, fit.pose) is None:
                self._hypotheses.follow(t, fit)
                new = True
        return new


def _distance(frames: list[int], known: list[int], default: int = 0) -> list[int]:
    """Return the distances (k,) of frames from the nearest of ``known``, ascending."""
    if not known or not frames:
        return [default] * len(frames)
    return np.abs(nearest(known, frames) - frames).tolist()
