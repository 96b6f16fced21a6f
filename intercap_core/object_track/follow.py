"""One pass over the frames: each pose initialises the next, and a lost object is searched for
again."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from intercap_core.object_track.constants import (
    CLEARLY_BETTER,
    DOUBTFUL_SCORE,
    LEAP_COST_HALF_TURN,
    LEAP_COST_PER_M,
    LEAP_MAX_COST_M,
    LEAP_MAX_COST_TURN,
    LOST_SCORE,
    NEAR_LAST_PLACE_M,
    RECOVERY_NAMED_VIEWS,
    RECOVERY_VALUE,
    RECOVERY_VIEWS_EACH,
    RECOVERY_WAIT_FRAMES,
    RING_VIEWS,
    SEARCH_EVERY_FRAMES,
    SEARCHES_MAX,
    USUAL_SCORE_RATE,
)
from intercap_core.object_track.fit import Fit
from intercap_core.object_track.lost import DetectionSupport, FrameResult, judged
from intercap_core.object_track.motion import expected, extrapolated, loose
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.search import same_pose
from intercap_core.rigid.mesh import ObjectMesh


def follow(
    observer: Observer,
    frames: range,
    start: FrameResult,
    known: list[FrameResult] | None = None,
    may_search: bool = True,
) -> Iterator[tuple[int, FrameResult]]:
    """Track ``frames`` in order from the result before the first; yields (t, result).

    ``known`` are the results of an earlier pass: a frame in which this pass would start where
    that one ended is not fitted again. ``may_search``: re-initialise where lost.
    """
    before, now = start.fit.pose, start.fit.pose
    usual = max(start.fit.score, LOST_SCORE)
    lost_for = 1 if start.lost else 0
    support = DetectionSupport(observer.mesh.centre_at(now))
    searches = doubted_for = 0
    most = SEARCHES_MAX + len(frames) // SEARCH_EVERY_FRAMES
    for t in frames:
        predicted = now if lost_for else extrapolated(before, now)
        prior = expected(before, now, predicted, lost_for)
        start_pose = _better_start(observer, t, predicted, now)
        if known is not None and same_pose(observer.mesh, start_pose, known[t].fit.pose):
            result = known[t]
        else:
            result = judged(observer.fit(t, start_pose, prior), observer.settings)
        if not support.believes(observer.mesh.centre_at(result.fit.pose), result.fit):
            result = replace(result, lost=True)
        leapt = False
        doubtful = result.lost or result.fit.score < DOUBTFUL_SCORE * usual
        if may_search and doubtful and _is_due(doubted_for) and searches < most:
            again = _recovered(observer, t, now, result)
            leapt = again is not None
            searches += not leapt
            result = again or result
        doubted_for = doubted_for + 1 if doubtful and not leapt else 0
        if result.lost:
            lost_for += 1
            frozen = replace(result.fit, pose=predicted, covariance=loose(prior))
            result = replace(result, fit=frozen)
            before = now = predicted
        else:
            broken = leapt or lost_for > 0
            result = replace(result, leapt=leapt)
            before, now = (result.fit.pose if broken else now), result.fit.pose
            lost_for = 0
            if result.fit.score > DOUBTFUL_SCORE * usual:
                observer.places.tracked(t, observer.mesh.centre_at(result.fit.pose))
            usual += USUAL_SCORE_RATE * (result.fit.score - usual)
        yield t, result


def _is_due(doubted_for: int) -> bool:
    late = doubted_for > RECOVERY_WAIT_FRAMES[-1] and doubted_for % SEARCH_EVERY_FRAMES == 0
    return late or doubted_for in RECOVERY_WAIT_FRAMES


def _better_start(observer: Observer, t: int, predicted: np.ndarray, now: np.ndarray) -> np.ndarray:
    """The start of the next fit: the prediction, or the last pose where the two differ much and it
    agrees better with the images."""
    if same_pose(observer.mesh, predicted, now):
        return predicted
    options = [observer.assess(t, pose) for pose in (predicted, now)]
    return max(options, key=lambda fit: fit.score).pose


def _recovered(
    observer: Observer, t: int, last: np.ndarray, result: FrameResult
) -> FrameResult | None:
    """A searched pose that is clearly better than what tracking found, if there is one."""
    found = [fit for fit in observer.search(t, near=last[:3, 3]) if _named(observer, last, fit)][:3]
    if not found:
        return None
    best = max(
        found,
        key=lambda fit: observer.value(t, fit) - _leap(observer.mesh, last, fit.pose),
    )
    if same_pose(observer.mesh, best.pose, result.fit.pose):
        return None
    needed = max(min_value(observer, t), CLEARLY_BETTER * observer.value(t, result.fit))
    if observer.value(t, best) < needed or judged(best, observer.settings).lost:
        return None
    return FrameResult(best, False)


def min_value(observer: Observer, t: int) -> float:
    """The value from which a pose that was searched for in frame t may be the object."""
    # few cameras can never be as sure as a ring
    surest = min(1.0, (1 - 0.5 ** len(observer.views(t))) / (1 - 0.5**RING_VIEWS))
    return RECOVERY_VALUE * surest


def _named(observer: Observer, last: np.ndarray, fit: Fit) -> bool:
    """Whether candidates of enough views support the object there: far from its last place a single
    candidate is not trusted."""
    looked = sum(view.detected for view in fit.views)
    supporting = sum(view.candidate >= 0 for view in fit.views)
    away = float(np.linalg.norm(observer.mesh.centre_at(fit.pose) - observer.mesh.centre_at(last)))
    far = away > NEAR_LAST_PLACE_M
    return supporting >= min(RECOVERY_NAMED_VIEWS if far else 1, -(-looked // RECOVERY_VIEWS_EACH))


def _leap(mesh: ObjectMesh, last: np.ndarray, pose: np.ndarray) -> float:
    """How implausible a jump is, in units of value: a tie goes to the nearer pose."""
    distance = float(np.linalg.norm(pose[:3, 3] - last[:3, 3]))
    angle = float(mesh.symmetry.rotation_error_deg(pose[:3, :3], last[:3, :3]))
    return min(LEAP_COST_PER_M * distance, LEAP_MAX_COST_M) + min(
        LEAP_COST_HALF_TURN * angle / 180, LEAP_MAX_COST_TURN
    )
