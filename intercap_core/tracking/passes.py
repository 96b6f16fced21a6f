"""The object's pose over time: a seed frame, tracking both ways from it, and a second opinion.

From the seed the track runs to both ends; then from the ends back over all frames. Where the two
passes end in different poses the better one is kept and the frame is flagged.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from intercap_core.config import ObjectTrackSettings
from intercap_core.rigid.mesh import ObjectMesh
from intercap_core.rigid.twist import twists
from intercap_core.tracking.evidence import View
from intercap_core.tracking.fit import Fit, MotionPrior, assess, fit_pose
from intercap_core.tracking.motion import expected, extrapolated, loose
from intercap_core.tracking.search import own_turns, plausibility, rank_frames, same_pose, search

log = logging.getLogger(__name__)

SEED_CONFIDENCE = 0.65  # good enough to stop looking for a better seed frame
SEED_FRAMES = 3  # frames searched for the seed, more while nothing is found
SEED_FRAMES_MAX = 10
HYPOTHESES = 5  # of the seed frame, compared over its neighbours
HYPOTHESIS_MARGIN = 0.80  # of the best confidence
HYPOTHESIS_FRAMES = 3  # on each side
TURNS = 12  # about each axis, by which the whole track may be wrong
TURN_FRAMES, TURN_RIVALS = 8, 5  # frames and turned tracks that are compared by fitting
TURN_GAIN = 0.003  # of the mean score, for which the track is turned
LOST_SCORE = 0.20
DOUBT = 0.55  # of the usual score: below, a search may find better
RECOVERY_CONFIDENCE = 0.40  # with a ring of cameras
RING = 6
RECOVERY_WAIT = (0, 2, 5, 9, 14, 20, 30, 45, 60)  # lost frames after which to search
SEARCHES_MAX = 12  # re-initialisations of a pass, so that a hopeless recording ends
AGREE_M, AGREE_DEG = 0.02, 10.0
CACHED_FRAMES = 12
PASS_ROUNDS = (3, 3)
PASS_SCALE = 0.5
# What a view sees has moved by less until it exposes: not worth another fit.
MOVED_M, MOVED_RAD = 0.001, np.radians(0.2)
TIMED_ROUNDS, TIMED_SCALE = (4,), 0.25
WORSE_SCORE = 0.98  # of a fit that allows for the motion, for which the motion is not believed


@dataclass(frozen=True)
class FrameResult:
    """One frame of the track.

    ``disagree``: the passes ended in different poses and the images do not decide between them;
    ``ambiguous``: a quite different pose explains the images nearly as well; ``free_axis`` (3,),
    master frame: a turn about it through the object's origin changes nothing that was seen, 0 =
    there is none.
    """

    fit: Fit
    lost: bool
    recovered: bool = False
    disagree: bool = False
    ambiguous: bool = False
    resting: bool = False
    free_axis: np.ndarray = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True)
class Track:
    """All frames (T), the frame that the track started from and how its pose was found."""

    frames: list[FrameResult]
    seed_frame: int
    annotated: bool


class NotFound(Exception):
    """No frame shows anything that could be the object."""


class Tracker:
    """Tracks one object through one recording.

    ``load`` gives the views of frame t, one a camera; ``labels_by_view`` [T][C][candidates] the
    labels alone; ``times`` (T,) of the frames, seconds; ``labels`` the classes the object may be
    given; ``up`` (3,) the vertical.
    """

    def __init__(
        self,
        mesh: ObjectMesh,
        load: Callable[[int], list[View]],
        labels_by_view: list[list[list[str]]],
        settings: ObjectTrackSettings,
        *,
        times: np.ndarray,
        labels: tuple[str, ...],
        up: np.ndarray | None,
    ) -> None:
        self._mesh = mesh
        self._views = lru_cache(maxsize=CACHED_FRAMES)(load)
        self._labels_by_view = labels_by_view
        self._count = len(labels_by_view)
        self._settings = settings
        self._times = times
        self._labels = labels
        self._up = up
        self._searches = 0

    def run(self, initial: tuple[int, np.ndarray] | None = None) -> Track:
        """Track from an annotated (frame, pose (4, 4)), or from a seed that is searched for.

        Raises NotFound where no frame holds a candidate that could be the object.
        """
        if initial is not None:
            seed_frame, start = initial
            seed = self._fit(seed_frame, start, MotionPrior(start), rounds=(4, 5), scale=1.0)
        else:
            seed_frame, seed = self._find_seed()
        one = self._both_ways(seed_frame, seed)
        # who annotates a pose knows on which side the handle is
        turned = self._turned_seed(seed_frame, one) if initial is None else None
        if turned is not None:
            one = self._both_ways(seed_frame, turned)
        last = self._count - 1
        two = list(one)
        for frames, start_at in (
            (range(last - 1, seed_frame, -1), last),
            (range(1, seed_frame), 0),
        ):
            for t, result in self._pass(frames, one[start_at], known=one, may_search=False):
                two[t] = result
        merged = [self._merge(a, b) for a, b in zip(one, two, strict=True)]
        timed = self._unwrapped(self._timed(self._unwrapped(merged)))
        return Track([self._with_axis(frame) for frame in timed], seed_frame, initial is not None)

    def _with_axis(self, frame: FrameResult) -> FrameResult:
        """The frame with the axis about which the object is a solid of revolution."""
        axis = self._mesh.symmetry.axis
        return frame if axis is None else replace(frame, free_axis=frame.fit.pose[:3, :3] @ axis)

    def _both_ways(self, seed_frame: int, seed: Fit) -> list[FrameResult]:
        """Every frame (T), tracked from the seed to both ends."""
        results = {seed_frame: self._result(seed)}
        for frames in (range(seed_frame + 1, self._count), range(seed_frame - 1, -1, -1)):
            results.update(self._pass(frames, results[seed_frame]))
        return [results[t] for t in range(self._count)]

    # --- the seed -----------------------------------------------------------------------------

    def _find_seed(self) -> tuple[int, Fit]:
        best: tuple[int, list[Fit]] | None = None
        for tried, t in enumerate(rank_frames(self._labels_by_view, self._labels)):
            if tried >= SEED_FRAMES_MAX or (tried >= SEED_FRAMES and best is not None):
                break
            found = self._search(t)
            if found and (best is None or found[0].confidence > best[1][0].confidence):
                best = (t, found)
            if best is not None and best[1][0].confidence > SEED_CONFIDENCE:
                break
        if best is None:
            raise NotFound
        t, found = best
        log.info("seed frame %d, confidence %.2f", t, found[0].confidence)
        return t, self._settle(t, found)

    def _search(self, t: int, near: np.ndarray | None = None) -> list[Fit]:
        return search(
            self._mesh,
            self._views(t),
            labels=self._labels,
            up=self._up,
            min_overlap=self._settings.min_overlap,
            background_term=self._settings.background_term,
            near=near,
        )

    def _settle(self, seed_frame: int, found: list[Fit]) -> Fit:
        """The hypothesis that stays best over the neighbouring frames."""
        rivals = [fit for fit in found if fit.confidence > HYPOTHESIS_MARGIN * found[0].confidence][
            :HYPOTHESES
        ]
        if len(rivals) == 1:
            return rivals[0]
        totals = []
        for rival in rivals:
            total = [self._plausibility(rival)]
            for frames in (
                range(seed_frame + 1, min(seed_frame + 1 + HYPOTHESIS_FRAMES, self._count)),
                range(seed_frame - 1, max(seed_frame - 1 - HYPOTHESIS_FRAMES, -1), -1),
            ):
                following = self._pass(frames, self._result(rival), may_search=False)
                total += [self._plausibility(result.fit) for _, result in following]
            totals.append(float(np.mean(total)))
        return rivals[int(np.argmax(totals))]

    def _turned_seed(self, seed_frame: int, track: list[FrameResult]) -> Fit | None:
        """The seed turned about the object's own axes, where all frames together prefer that.

        One frame may not show on which side a handle is; the frames of the whole track do. Every
        turn is compared over a few well seen frames, the best are fitted there.
        """
        if self._mesh.symmetry.sphere:
            return None
        seen = [t for t, result in enumerate(track) if not result.lost]
        if not seen:
            return None
        seen.sort(key=lambda t: -track[t].fit.confidence)
        half = sorted(seen[: max(TURN_FRAMES, len(seen) // 2)])
        frames = [
            half[i]
            for i in np.linspace(0, len(half) - 1, min(TURN_FRAMES, len(half))).round().astype(int)
        ]
        turns = own_turns(self._mesh, TURNS)
        few = frames[:: max(1, len(frames) // 4)]
        first = [
            np.mean([self._plausibility(self._assess(t, track[t].fit.pose @ turn)) for t in few])
            for turn in turns
        ]
        rivals = [turns[i] for i in np.argsort(first, kind="stable")[::-1][:TURN_RIVALS]]
        totals = []
        for turn in [np.eye(4), *rivals]:
            fits = []
            for t in frames:
                start = track[t].fit.pose @ turn
                fits.append(self._plausibility(self._fit(t, start, MotionPrior(start))))
            totals.append(float(np.mean(fits)))
        best = int(np.argmax(totals[1:]))
        if totals[1 + best] < totals[0] + TURN_GAIN:
            return None
        start = track[seed_frame].fit.pose @ rivals[best]
        fit = self._fit(seed_frame, start, MotionPrior(start))
        return None if same_pose(self._mesh, fit.pose, track[seed_frame].fit.pose) else fit

    def _plausibility(self, fit: Fit) -> float:
        return plausibility(fit, self._up)

    # --- one pass -----------------------------------------------------------------------------

    def _pass(
        self,
        frames: range,
        start: FrameResult | None,
        known: list[FrameResult] | None = None,
        may_search: bool = True,
    ) -> Iterator[tuple[int, FrameResult]]:
        """Track ``frames`` in order from the result before the first; yields (t, result).

        ``known`` are the results of an earlier pass: a frame in which this pass would start where
        that one ended is not fitted again. ``may_search``: re-initialise where lost.
        """
        assert start is not None
        before, now = start.fit.pose, start.fit.pose
        usual = max(start.fit.score, LOST_SCORE)
        lost_for = 1 if start.lost else 0
        self._searches = 0
        for t in frames:
            predicted = now if lost_for else extrapolated(before, now)
            prior = expected(before, now, predicted, lost_for)
            start_pose = self._better_start(t, predicted, now)
            if known is not None and same_pose(self._mesh, start_pose, known[t].fit.pose):
                result = known[t]
            else:
                fit = self._fit(t, start_pose, prior)
                result = self._result(fit)
            recovered = False
            doubtful = result.lost or result.fit.score < DOUBT * usual
            if may_search and doubtful and self._may_search(lost_for):
                again = self._recover(t, now, result)
                recovered = again is not None and (result.lost or lost_for > 0)
                result = again or result
            if result.lost:
                lost_for += 1
                frozen = replace(result.fit, pose=predicted, covariance=loose(prior))
                result = replace(result, fit=frozen)
                before = now = predicted
            else:
                result = replace(result, recovered=recovered or lost_for > 0)
                before, now = (
                    (now if not (recovered or lost_for) else result.fit.pose),
                    (result.fit.pose),
                )
                lost_for = 0
                usual += 0.1 * (result.fit.score - usual)
            yield t, result

    def _fit(
        self,
        t: int,
        pose: np.ndarray,
        prior: MotionPrior,
        rounds: tuple[int, ...] = PASS_ROUNDS,
        scale: float = PASS_SCALE,
        twist: np.ndarray | None = None,
    ) -> Fit:
        return fit_pose(
            self._mesh,
            self._views(t),
            pose,
            prior=prior,
            min_overlap=self._settings.min_overlap,
            background_term=self._settings.background_term,
            labels=self._labels,
            rounds=rounds,
            start_scale=scale,
            twist=twist,
        )

    def _better_start(self, t: int, predicted: np.ndarray, now: np.ndarray) -> np.ndarray:
        """The prediction or the last pose, whichever agrees better where they differ much."""
        if same_pose(self._mesh, predicted, now):
            return predicted
        options = [self._assess(t, pose) for pose in (predicted, now)]
        return max(options, key=lambda fit: fit.score).pose

    def _assess(self, t: int, pose: np.ndarray) -> Fit:
        return assess(self._mesh, self._views(t), pose, min_overlap=0.1, labels=self._labels)

    def _result(self, fit: Fit) -> FrameResult:
        overlaps = fit.mean_overlap
        lost = fit.support == 0 or fit.score < LOST_SCORE
        lost |= 0 < overlaps < self._settings.lost_overlap
        return FrameResult(fit, lost)

    def _may_search(self, lost_for: int) -> bool:
        return lost_for in RECOVERY_WAIT and self._searches < SEARCHES_MAX

    def _recover(self, t: int, last: np.ndarray, result: FrameResult) -> FrameResult | None:
        """A searched pose that is clearly better than what tracking found, if there is one."""
        self._searches += 1
        found = self._search(t, near=last[:3, 3])
        if not found:
            return None
        best = max(found[:3], key=lambda fit: fit.confidence - _leap(self._mesh, last, fit.pose))
        # few cameras can never be as sure as a ring
        surest = min(1.0, (1 - 0.5 ** len(self._views(t))) / (1 - 0.5**RING))
        needed = max(RECOVERY_CONFIDENCE * surest, 1.15 * result.fit.confidence)
        if best.confidence < needed or self._result(best).lost:
            return None
        return FrameResult(best, False)

    # --- two passes ---------------------------------------------------------------------------

    def _merge(self, one: FrameResult, two: FrameResult) -> FrameResult:
        if one is two:
            return one
        angle = float(
            self._mesh.symmetry.rotation_error_deg(one.fit.pose[:3, :3], two.fit.pose[:3, :3])
        )
        apart = float(np.linalg.norm(one.fit.pose[:3, 3] - two.fit.pose[:3, 3]))
        disagree = apart > AGREE_M or angle > AGREE_DEG
        better = two if (not two.lost, two.fit.score) > (not one.lost, one.fit.score) else one
        if not disagree:
            better = one if not one.lost else better
        return replace(better, disagree=disagree and not better.lost)

    def _timed(self, frames: list[FrameResult]) -> list[FrameResult]:
        """The frames in which the object moves, fitted again to what each view sees of it when it
        exposes: the passes take all views to show one moment."""
        poses = np.array([frame.fit.pose for frame in frames])
        known = np.array([not frame.lost for frame in frames])
        found = twists(poses, known, self._times)
        late = max(abs(view.geometry.time_offset_s) for view in self._views(0))
        turn, shift = (late * np.linalg.norm(part, axis=1) for part in (found[:, :3], found[:, 3:]))
        result = list(frames)
        for t in map(int, np.flatnonzero(known & ((turn > MOVED_RAD) | (shift > MOVED_M)))):
            before = poses[max(t - 1, 0)]
            fit = self._fit(
                t,
                poses[t],
                expected(before, poses[t], poses[t], 0),
                rounds=TIMED_ROUNDS,
                scale=TIMED_SCALE,
                twist=found[t],
            )
            if fit.score >= WORSE_SCORE * frames[t].fit.score and not self._result(fit).lost:
                result[t] = replace(frames[t], fit=fit)
        return result

    def _unwrapped(self, frames: list[FrameResult]) -> list[FrameResult]:
        """Equivalent poses that follow each other as closely as the symmetry allows."""
        if self._mesh.symmetry.trivial:
            return frames
        result = frames[:1]
        for frame in frames[1:]:
            pose = self._mesh.symmetry.nearest_equivalent_pose(frame.fit.pose, result[-1].fit.pose)
            result.append(replace(frame, fit=replace(frame.fit, pose=pose)))
        return result


def _leap(mesh: ObjectMesh, last: np.ndarray, pose: np.ndarray) -> float:
    """How implausible a jump is, in units of confidence: a tie goes to the nearer pose."""
    distance = float(np.linalg.norm(pose[:3, 3] - last[:3, 3]))
    angle = float(mesh.symmetry.rotation_error_deg(pose[:3, :3], last[:3, :3]))
    return min(0.1 * distance, 0.1) + min(0.05 * angle / 180, 0.05)
