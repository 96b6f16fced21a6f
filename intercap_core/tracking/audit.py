"""A second look at the track: now and then the object is searched for as if nothing was known.

A tracker that slid into a wrong pose while a hand hid the object keeps it afterwards, and what
depth it has fits it passably. Where a search finds another pose the track is followed from there
both ways, and the images of all frames in which the two differ decide.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from intercap_core.tracking.fit import MIN_PIXELS, Fit
from intercap_core.tracking.follow import follow
from intercap_core.tracking.lost import FrameResult, decided
from intercap_core.tracking.observer import Observer
from intercap_core.tracking.search import same_pose

EVERY = 12  # frames
SOUND_VIEWS, SOUND = 3, 0.8  # views that agree this well, in mask and depth: no need to look
NEARLY = 0.03  # of the confidence: a found pose this much worse is a rival
AUDITS_MAX = 8  # of a recording, the least sound windows first


def audited(observer: Observer, track: list[FrameResult]) -> list[FrameResult]:
    """The track (T) with the runs replaced that another pose explains better, and those flagged
    that it explains as well."""
    result = list(track)
    windows = [
        range(start, min(start + EVERY, observer.count))
        for start in range(0, observer.count, EVERY)
    ]
    doubtful = [frames for frames in windows if not any(_sound(track[t]) for t in frames)]
    doubtful.sort(key=lambda frames: max(_evidence(track[t].fit) for t in frames))
    for frames in doubtful[:AUDITS_MAX]:
        t = max(frames, key=observer.promise)
        _look(observer, result, t)
    return result


def _look(observer: Observer, track: list[FrameResult], t: int) -> None:
    """Search frame t; where that finds another pose, decide about the frames around it."""
    own = track[t]
    value = 0.0 if own.lost else observer.value(t, own.fit)
    found = [fit for fit in observer.search(t) if observer.value(t, fit) > value - NEARLY]
    others = [fit for fit in found if not same_pose(observer.mesh, fit.pose, own.fit.pose)]
    if not others:
        return
    rival = _followed(observer, track, t, others[0])
    seen = [(track[u], other) for u, other in rival.items() if not (track[u].lost and other.lost)]
    gain = np.array([_score(other) - _score(mine) for mine, other in seen])
    if decided(gain):
        if gain.mean() > 0:
            for u, other in rival.items():
                track[u] = other
        return
    for u in rival:
        track[u] = replace(track[u], ambiguous=not track[u].lost)


def _followed(
    observer: Observer, track: list[FrameResult], t: int, fit: Fit
) -> dict[int, FrameResult]:
    """The frames in which a track from ``fit`` of frame t differs from the known one."""
    start = FrameResult(fit, False)
    rival = {t: start}
    for frames in (range(t + 1, observer.count), range(t - 1, -1, -1)):
        for u, other in follow(observer, frames, start, may_search=False):
            if same_pose(observer.mesh, other.fit.pose, track[u].fit.pose):
                break
            if other.lost and not track[u].lost:
                break
            rival[u] = other
    return rival


def _score(frame: FrameResult) -> float:
    return 0.0 if frame.lost else frame.fit.score


def _sound(frame: FrameResult) -> bool:
    return not frame.lost and _evidence(frame.fit) >= SOUND_VIEWS


def _evidence(fit: Fit) -> int:
    """Views whose candidate and, where there is any, depth agree well with the pose."""
    return sum(
        view.visible_px >= MIN_PIXELS and view.overlap > SOUND and not view.depth_agreement < SOUND
        for view in fit.views
    )
