"""Hypotheses of every frame, followed through time, and their prior besides the images.

A hypothesis is a local optimum of the images' likelihood. The prior weighs it by its place in the
room, by how upright it is, and by annotated poses.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from intercap_core.geometry.camera.transforms import step_between
from intercap_core.geometry.solve.time_series import rigid_velocity
from intercap_core.object_track.decoder import HIDDEN, JUMP_COST, Decoded, pose_distances
from intercap_core.object_track.fit import FIT_ROUNDS, FittedPose, MotionPrior
from intercap_core.object_track.given_poses import UNSEEN_S, GivenPose
from intercap_core.object_track.likelihood import CONTRADICTED_LOG_RATIO, SEEN_LOG_RATIO
from intercap_core.object_track.motion import (
    extrapolate,
    predict_prior,
    shift_twist,
    unwrap_symmetry,
)
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.turns import UNSURE_M, UNSURE_RAD, distinct_poses, same_pose

# Largest number of hypotheses of a frame: enough for a mug turned in steps of 30 degrees. With 6,
# the true turn of a mug was dropped.
MAX_HYPOTHESES = 12  # tuned on the studio
RIVAL_PROBABILITY = 0.01  # hypotheses below this probability are not considered further; tuned
RIVAL_LOG_RATIO = 5.0  # hypotheses this much worse than the best are not followed, nats; tuned
UPRIGHT_LOG_RATIO = 2.0  # nats times the cosine of the angle to the standing pose; tuned on studio
# Poses within this distance of an annotated pose may show the annotated object.
ANNOTATED_REACH_M = 0.2  # metres; tuned


class Prior:
    """Weighs hypotheses by all that is known besides the images of their frame.

    Attributes:
        given: annotated poses by frame.
    """

    def __init__(self, observer: Observer) -> None:
        self._observer = observer
        self.given: dict[int, GivenPose] = {}

    def near_annotated(self, hidden: np.ndarray) -> np.ndarray:
        """Find frames (T,) bool within ``UNSEEN_S`` of annotated poses near hidden frames.

        An annotated pose counts if a frame of ``hidden`` (T,) is within ``UNSEEN_S`` of it.
        """
        times = self._observer.times
        result = np.zeros(len(times), bool)
        for t in self.given:
            near = np.abs(times - times[t]) < UNSEEN_S
            if hidden[near].any():
                result |= near
        return result

    def weigh(self, t: int, fits: list[FittedPose]) -> np.ndarray:
        """Return the evidence (K,) for hypotheses of frame t relative to none being true, nats.

        It is the images' log-likelihood ratio, limited by the prior of the place
        (:meth:`.places.Places.weigh`), plus the upright prior, plus that of an annotated pose. All
        hypotheses that explain the same candidates have the place of the likeliest of them.
        """
        mesh, places, share = self._observer.mesh, self._observer.places, self._observer.share
        ratio = np.array([fit.log_ratio for fit in fits])
        result = ratio.copy()
        number = group_by_candidates(fits)
        for group in range(number.max(initial=-1) + 1):
            members = number == group
            best = int(np.where(members, ratio, -np.inf).argmax())
            own = max(float(ratio[best]), 0.0)
            place = mesh.centre_at(fits[best].pose)
            result[members] -= own - places.weigh(t, place, own, share)
        if self._observer.up is not None:
            up = self._observer.up / np.linalg.norm(self._observer.up)
            # column 2 of the rotation is the object's z axis
            result += UPRIGHT_LOG_RATIO * np.array([fit.pose[:3, 2] @ up for fit in fits])
        if t in self.given and fits:
            poses = np.array([fit.pose for fit in fits])
            given = self.given[t]
            (turn,), (shift,) = pose_distances(mesh, given.pose[None], poses)
            squared = (turn / given.sigma_rad) ** 2 + (shift / given.sigma_m) ** 2
            near = np.maximum(JUMP_COST - 0.5 * squared, 0.0)
            # all poses nearby outweigh a jump there and back for this frame alone
            result += (3 * JUMP_COST * (shift < ANNOTATED_REACH_M) + near) / share
        return result


def group_by_candidates(fits: list[FittedPose]) -> np.ndarray:
    """Return for each hypothesis of a frame the number (K,) of the object that it explains, from 0.

    A hypothesis explains the object of a likelier one if both chose the same candidate in at least
    half of the views in which it has one.
    """
    number = np.zeros(len(fits), int)
    leaders: list[np.ndarray] = []
    for k in sorted(range(len(fits)), key=lambda k: -fits[k].log_ratio):
        kept = np.array([view.candidate for view in fits[k].views])
        same = [int(((kept == other) & (kept >= 0)).sum()) for other in leaders]
        most = int(np.argmax(same)) if same else -1
        if most >= 0 and same[most] and 2 * same[most] >= int((kept >= 0).sum()):
            number[k] = most
        else:
            number[k] = len(leaders)
            leaders.append(kept)
    return number


class Hypotheses:
    """Hypotheses of every frame.

    Attributes:
        fits: hypotheses [T] in the order in which they were added.
        prior: prior of the hypotheses.
    """

    def __init__(self, observer: Observer) -> None:
        self._observer = observer
        self.prior = Prior(observer)
        self._times = observer.times
        self._patience = observer.frames_in(UNSEEN_S)
        self.fits: list[list[FittedPose]] = [[] for _ in range(observer.count)]

    def known(self, t: int, pose: np.ndarray) -> int | None:
        """Return the hypothesis of frame t at this pose (4, 4), if any."""
        for k, fit in enumerate(self.fits[t]):
            if same_pose(self._observer.mesh, fit.pose, pose):
                return k
        return None

    def seen(self, t: int, pose: np.ndarray) -> int | None:
        """Return the hypothesis of frame t at this pose (4, 4) if the images support it."""
        k = self.known(t, pose)
        return k if k is not None and self.fits[t][k].log_ratio > SEEN_LOG_RATIO else None

    def best(self, t: int) -> float:
        """Return the evidence of frame t's likeliest hypothesis (:meth:`Prior.weigh`), or 0."""
        return float(self.prior.weigh(t, self.fits[t]).max(initial=0.0))

    def add(self, t: int, fit: FittedPose) -> None:
        """Add a hypothesis to frame t.

        Of two at the same pose the likelier one is kept. If there are too many, one is dropped so
        that ambiguous turns stay evenly spread.
        """
        own = self.fits[t]
        k = self.known(t, fit.pose)
        if k is None:
            own.append(fit)
            if len(own) > MAX_HYPOTHESES:
                del own[self._most_redundant(t)]
        elif fit.log_ratio > own[k].log_ratio:
            own[k] = fit

    def _most_redundant(self, t: int) -> int:
        """Return the hypothesis of frame t to drop: the least likely of the first of these groups.

        1. Hypotheses that the images do not support, if they support another one.
        2. Hypotheses with a likelier one within ``UNSURE_M`` and ``UNSURE_RAD``.
        3. All hypotheses.
        """
        own, mesh = self.fits[t], self._observer.mesh
        order = [int(k) for k in np.argsort(self.prior.weigh(t, own))]
        if own[order[0]].log_ratio < SEEN_LOG_RATIO < own[order[-1]].log_ratio:
            return order[0]
        for i, k in enumerate(order):
            if any(
                same_pose(mesh, own[k].pose, own[j].pose, (UNSURE_M, UNSURE_RAD))
                for j in order[i + 1 :]
            ):
                return k
        return order[0]

    def follow(self, t: int, fit: FittedPose) -> None:
        """Add a fit of frame t and follow it through the frames before and after.

        It ends where it meets a known hypothesis or has been unseen for ``UNSEEN_S``. It also ends
        when the best hypotheses have been better by ``RIVAL_LOG_RATIO`` in total.
        """
        self.add(t, fit)
        for frames in (range(t + 1, self._observer.count), range(t - 1, -1, -1)):
            self._follow(t, fit.pose, frames)

    def refit_moving(self, decoded: Decoded) -> set[int]:
        """Fit moving objects again, with the motion between the frame's time and each exposure.

        The twist follows from the decided poses of the frames around, which are better known than
        at the first fit. All hypotheses of a frame get the twist of the decided one.

        Returns:
            The frames that changed.
        """
        known = decoded.path != HIDDEN
        poses = np.tile(np.eye(4), (len(known), 1, 1))
        frames = np.flatnonzero(known).tolist()
        for t in frames:
            poses[t] = self.fits[t][decoded.path[t]].pose
        motion = rigid_velocity(
            unwrap_symmetry(self._observer.mesh.symmetry, poses, known), known, self._times
        )
        changed = set()
        views = self._observer.views(frames[0]) if frames else []
        late = max((abs(view.geometry.time_offset_s) for view in views), default=0.0)
        for t in frames:
            for k, fit in enumerate(self.fits[t]):
                twist = shift_twist(motion[t], poses[t, :3, 3], fit.pose[:3, 3])
                turn, shift = np.abs(twist - fit.twist).reshape(2, 3).max(1) * late
                unchanged = turn < np.radians(0.5) and shift < 0.003
                if unchanged or decoded.probability[t][k] < RIVAL_PROBABILITY:
                    continue
                prior = MotionPrior(fit.pose)
                again = self._observer.fit(t, fit.pose, prior, FIT_ROUNDS, twist=twist)
                if again.log_ratio > fit.log_ratio:
                    self.fits[t][k] = again
                    changed.add(t)
            if t in changed:  # hypotheses may have become equal: keep the likeliest
                fits = sorted(self.fits[t], key=lambda fit: -fit.log_ratio)
                distinct = distinct_poses(self._observer.mesh, [fit.pose for fit in fits])
                self.fits[t] = [fits[k] for k in distinct]
        return changed

    def _follow(self, last: int, pose: np.ndarray, frames: Iterable[int]) -> None:
        """Follow ``pose`` (4, 4) of frame ``last`` through ``frames``, as in :meth:`follow`."""
        before = now = pose
        unseen, deficit, step_s = 0, 0.0, self._observer.step_s
        for t in frames:
            predicted = self._predict(t, last, before, now)
            twist = step_between(now, predicted) / (self._times[t] - self._times[last])
            last = t
            if self.seen(t, predicted) is not None:
                return
            prior = predict_prior(before, now, predicted, step_s, unseen * step_s)
            fit = self._fit(t, predicted, prior, twist)
            if self.seen(t, fit.pose) is not None:
                return
            weights = self.prior.weigh(t, [fit, *self.fits[t]])
            if fit.log_ratio > CONTRADICTED_LOG_RATIO:
                self.add(t, fit)
            deficit += self._observer.share * float(weights.max(initial=0.0) - weights[0])
            if deficit > RIVAL_LOG_RATIO or unseen >= self._patience:
                return
            if fit.log_ratio > SEEN_LOG_RATIO:
                before, now = (fit.pose if unseen else now), fit.pose
                unseen = 0
            else:
                before = now = predicted
                unseen += 1

    def _predict(self, t: int, last: int, before: np.ndarray, now: np.ndarray) -> np.ndarray:
        """Predict the pose (4, 4) of frame t: of several predictions, the likeliest by its images.

        Predictions are constant velocity, rest, and motion with each hand. ``before`` and ``now``
        (4, 4) are the last two poses, ``now`` in frame ``last``.
        """
        poses = np.array([extrapolate(before, now), now, *self._observer.carried(last, t, now)])
        starts = poses[distinct_poses(self._observer.mesh, poses, (UNSURE_M, UNSURE_RAD))]
        if len(starts) == 1:
            return starts[0]
        rates = step_between(now, starts) / (self._times[t] - self._times[last])
        assessed = self._observer.assess_all(t, starts, twists=rates)
        return max(assessed, key=lambda fit: fit.log_ratio).pose

    def _fit(self, t: int, start: np.ndarray, prior: MotionPrior, twist: np.ndarray) -> FittedPose:
        """Fit frame t from ``start`` (4, 4).

        A fit that ends 1.5 standard deviations away from the prior's mean is repeated with a prior
        that is four times as wide: the object started to move or stopped.
        """
        fit = self._observer.fit(t, start, prior, twist=twist)
        step = np.abs(step_between(prior.pose, fit.pose))
        limit = np.repeat([prior.sigma_rad, prior.sigma_m], 3) * 1.5
        if fit.log_ratio < SEEN_LOG_RATIO or (step < limit).all():
            return fit
        wide = MotionPrior(prior.pose, 4.0 * prior.sigma_m, 4.0 * prior.sigma_rad)
        again = self._observer.fit(t, fit.pose, wide, twist=twist)
        return again if again.log_ratio > fit.log_ratio else fit
