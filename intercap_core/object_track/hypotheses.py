"""Hypotheses of every frame: local optima of the images' likelihood, followed through time."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from intercap_core.geometry.camera.transforms import step_between
from intercap_core.geometry.solve.time_series import rigid_velocity
from intercap_core.object_track.constants import (
    BASIN,
    CONTRADICTED_LOG_RATIO,
    CROWDED,
    FIT_ROUNDS,
    MAX_HYPOTHESES,
    MOTION_CHANGED_M,
    MOTION_CHANGED_RAD,
    PRIOR_CONTRADICTED,
    PRIOR_WIDENED,
    RIVAL_LOG_RATIO,
    RIVAL_PROBABILITY,
    SEEN_LOG_RATIO,
    UNSEEN_S,
)
from intercap_core.object_track.decoder import NOT_SEEN, Decoded
from intercap_core.object_track.fit import Fit, MotionPrior
from intercap_core.object_track.motion import about, expected, extrapolated, unwrapped
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.prior import Prior
from intercap_core.object_track.search import same_pose


class Hypotheses:
    """The fits [T] that may be true, each frame's in the order in which they were found.

    ``share`` is how many independent observations a frame is; ``times`` (T,) seconds.
    """

    def __init__(self, observer: Observer, prior: Prior, share: float, times: np.ndarray) -> None:
        self._observer = observer
        self._prior = prior
        self._share = share
        self._times = times
        self._step_s = float(np.median(np.diff(times))) if len(times) > 1 else UNSEEN_S
        self._patience = max(1, round(UNSEEN_S / self._step_s))
        self.fits: list[list[Fit]] = [[] for _ in range(observer.count)]

    def known(self, t: int, pose: np.ndarray) -> int | None:
        """The hypothesis of frame t at this pose (4, 4), if there is one."""
        for k, fit in enumerate(self.fits[t]):
            if same_pose(self._observer.mesh, fit.pose, pose):
                return k
        return None

    def seen(self, t: int, pose: np.ndarray) -> int | None:
        """:meth:`known`, where the images support it."""
        k = self.known(t, pose)
        return k if k is not None and self.fits[t][k].log_ratio > SEEN_LOG_RATIO else None

    def best(self, t: int) -> float:
        """What speaks for frame t's likeliest hypothesis, nats; 0 where nothing does."""
        return float(self._prior.weigh(t, self.fits[t]).max(initial=0.0))

    def shown(self, t: int) -> bool:
        """Whether the images of frame t support any of its hypotheses."""
        return any(fit.log_ratio > SEEN_LOG_RATIO for fit in self.fits[t])

    def add(self, t: int, fit: Fit) -> None:
        """Add a hypothesis of frame t; of two at one pose the likelier stays. Of too many one goes,
        so that turns that nothing tells apart stay spread."""
        own = self.fits[t]
        k = self.known(t, fit.pose)
        if k is None:
            own.append(fit)
            if len(own) > MAX_HYPOTHESES:
                del own[self._least_missed(t)]
        elif fit.log_ratio > own[k].log_ratio:
            own[k] = fit

    def _least_missed(self, t: int) -> int:
        """The least likely hypothesis of frame t: of those that the images do not support, or of
        those that have a likelier one close by, or of all."""
        own, mesh = self.fits[t], self._observer.mesh
        order = [int(k) for k in np.argsort(self._prior.weigh(t, own))]
        if own[order[0]].log_ratio < SEEN_LOG_RATIO < own[order[-1]].log_ratio:
            return order[0]
        for i, k in enumerate(order):
            if any(same_pose(mesh, own[k].pose, own[j].pose, CROWDED) for j in order[i + 1 :]):
                return k
        return order[0]

    def follow(self, t: int, fit: Fit) -> None:
        """Add a fit of frame t and where it leads in the frames before and after, until it meets
        what is known, is not seen for long or is hopelessly worse than another."""
        self.add(t, fit)
        for frames in (range(t + 1, self._observer.count), range(t - 1, -1, -1)):
            self._follow(t, fit.pose, frames)

    def see_moving(self, decoded: Decoded) -> set[int]:
        """Fit again what moves, as each view saw it when it exposed; the frames that changed.

        The motion is that of the frames around, better known than when a frame was fitted; rivals
        move as what is believed does.
        """
        known = decoded.path != NOT_SEEN
        poses = np.tile(np.eye(4), (len(known), 1, 1))
        frames = [t for t, k in enumerate(decoded.path) if k != NOT_SEEN]
        for t in frames:
            poses[t] = self.fits[t][decoded.path[t]].pose
        motion = rigid_velocity(
            unwrapped(self._observer.mesh.symmetry, poses, known), known, self._times
        )
        changed = set()
        for t in frames:
            late = max(abs(view.geometry.time_offset_s) for view in self._observer.views(t))
            for k, fit in enumerate(self.fits[t]):
                twist = about(motion[t], poses[t, :3, 3], fit.pose[:3, 3])
                turn, shift = np.abs(twist - fit.twist).reshape(2, 3).max(1) * late
                if decoded.probability[t][k] < RIVAL_PROBABILITY or (
                    turn < MOTION_CHANGED_RAD and shift < MOTION_CHANGED_M
                ):
                    continue
                prior = MotionPrior(fit.pose)
                again = self._observer.fit(t, fit.pose, prior, FIT_ROUNDS, twist=twist)
                if again.log_ratio > fit.log_ratio:
                    self.fits[t][k] = again
                    changed.add(t)
            if t in changed:
                self._join(t)
        return changed

    def _join(self, t: int) -> None:
        """Leave one of several hypotheses of frame t that have become one pose, the likeliest."""
        left, self.fits[t] = sorted(self.fits[t], key=lambda fit: -fit.log_ratio), []
        for fit in left:
            if self.known(t, fit.pose) is None:
                self.fits[t].append(fit)

    def _follow(self, last: int, pose: np.ndarray, frames: Iterable[int]) -> None:
        before = now = pose
        unseen, deficit = 0, 0.0
        for t in frames:
            predicted = self._likeliest(t, last, before, now)
            twist = step_between(now, predicted) / (self._times[t] - self._times[last])
            last = t
            if self.seen(t, predicted) is not None:
                return
            prior = expected(before, now, predicted, self._step_s, unseen * self._step_s)
            fit = self._fit(t, predicted, prior, twist)
            if self.seen(t, fit.pose) is not None:
                return
            weights = self._prior.weigh(t, [fit, *self.fits[t]])
            if fit.log_ratio > CONTRADICTED_LOG_RATIO:
                self.add(t, fit)
            deficit += self._share * float(weights.max(initial=0.0) - weights[0])
            if deficit > RIVAL_LOG_RATIO or unseen >= self._patience:
                return
            if fit.log_ratio > SEEN_LOG_RATIO:
                before, now = (fit.pose if unseen else now), fit.pose
                unseen = 0
            else:
                before = now = predicted
                unseen += 1

    def _likeliest(self, t: int, last: int, before: np.ndarray, now: np.ndarray) -> np.ndarray:
        """The pose (4, 4) expected in frame t that its images support best: at constant velocity,
        as in frame ``last``, or carried by a hand."""
        starts = [extrapolated(before, now)]
        for pose in (now, *self._observer.carried(last, t, now)):
            if not any(same_pose(self._observer.mesh, pose, other, BASIN) for other in starts):
                starts.append(pose)
        if len(starts) == 1:
            return starts[0]
        rates = step_between(now, np.array(starts)) / (self._times[t] - self._times[last])
        found = self._observer.assess_all(t, np.array(starts), twists=rates)
        return max(found, key=lambda one: one.log_ratio).pose

    def _fit(self, t: int, start: np.ndarray, prior: MotionPrior, twist: np.ndarray) -> Fit:
        """The fit of frame t from ``start`` (4, 4), moving by ``twist`` (6,); its prior widened
        where the images contradict it."""
        fit = self._observer.fit(t, start, prior, twist=twist)
        step = np.abs(step_between(prior.pose, fit.pose))
        limit = np.repeat([prior.sigma_rad, prior.sigma_m], 3) * PRIOR_CONTRADICTED
        if fit.log_ratio < SEEN_LOG_RATIO or (step < limit).all():
            return fit
        wide = (PRIOR_WIDENED * prior.sigma_m, PRIOR_WIDENED * prior.sigma_rad)
        again = self._observer.fit(t, fit.pose, MotionPrior(prior.pose, *wide), twist=twist)
        return again if again.log_ratio > fit.log_ratio else fit
