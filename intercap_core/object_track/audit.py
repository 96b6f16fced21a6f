"""A second look at the track: now and then the object is searched for as if nothing was known.

A tracker that slid into a wrong pose while a hand hid the object keeps it afterwards, and what
depth it has fits it passably. Where a search finds another pose the track is followed from there
both ways, and the images of all frames in which the two differ decide.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from intercap_core.object_track.choices import best_sequence
from intercap_core.object_track.fit import MIN_PIXELS, Fit
from intercap_core.object_track.follow import NEAR_M, follow, value_to_believe
from intercap_core.object_track.lost import FrameResult, decided
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.places import LEAST
from intercap_core.object_track.search import same_pose
from intercap_core.object_track.turns import near_turns

EVERY = 12  # frames
SOUND_VIEWS, SOUND = 3, 0.8  # views that agree this well, in mask and depth: no need to look
NEARLY = 0.03  # of the confidence: a found pose this much worse is a rival
TURN_DEG = 20.0  # from a turn that hardly changes the object
DIFFERENT_M, DIFFERENT_DEG = 0.05, 30.0
AROUND = 3  # frames on each side, whose images decide together
# Audits of a recording, the least sound windows first; of a long one, one in so many frames.
AUDITS_MAX, AUDIT_EVERY = 8, 45


def audited(observer: Observer, track: list[FrameResult], times: np.ndarray) -> list[FrameResult]:
    """The track (T) with the frames replaced that another pose explains better, and those flagged
    that it explains as well; ``times`` (T,) seconds."""
    result = list(track)
    windows = [
        range(start, min(start + EVERY, observer.count))
        for start in range(0, observer.count, EVERY)
    ]
    doubtful = [frames for frames in windows if not any(_sound(track[t]) for t in frames)]
    doubtful.sort(key=lambda frames: max(_evidence(track[t].fit) for t in frames))
    most = max(AUDITS_MAX, observer.count // AUDIT_EVERY)
    for frames in doubtful[:most]:
        t = max(frames, key=observer.promise)
        _look(observer, result, t, times)
    return result


def _look(observer: Observer, track: list[FrameResult], t: int, times: np.ndarray) -> None:
    """Search frame t; where that finds another pose, decide about the frames around it."""
    own = track[t]
    value = 0.0 if own.lost else observer.value(t, own.fit)
    others = [
        fit
        for fit in observer.search(t)
        if observer.value(t, fit) > value - NEARLY
        and not same_pose(observer.mesh, fit.pose, own.fit.pose)
        and _may_be_there(observer, t, own, fit)
    ]
    if not others:
        return
    rival = _followed(observer, track, t, others[0])
    unsure = [] if _is_turn(observer, own.fit, others[0]) else _undecided(observer, track, rival)
    for u in unsure:
        track[u] = replace(track[u], ambiguous=not track[u].lost)
    for u in _preferred(observer, track, rival, times):
        track[u] = replace(rival[u], ambiguous=track[u].ambiguous and not rival[u].lost)


def _may_be_there(observer: Observer, t: int, own: FrameResult, fit: Fit) -> bool:
    """Whether what a search found may be the object: images alone would prefer a twin in plain
    sight to the object in a hand."""
    there = observer.mesh.centre_at(fit.pose)
    away = float(np.linalg.norm(there - observer.mesh.centre_at(own.fit.pose)))
    if not own.lost and away < NEAR_M:
        return True
    sure = observer.value(t, fit) >= value_to_believe(observer, t)
    return sure and observer.places.worth(t, there) > LEAST


def _undecided(
    observer: Observer, track: list[FrameResult], rival: dict[int, FrameResult]
) -> list[int]:
    """The frames in which the two are quite different and the images around do not decide."""
    run = sorted(rival)
    gain = np.array([rival[u].score - track[u].score for u in run])
    symmetry = observer.mesh.symmetry
    found = []
    for i, u in enumerate(run):
        own, other = track[u].fit.pose, rival[u].fit.pose
        apart = float(np.linalg.norm(observer.mesh.centre_at(own) - observer.mesh.centre_at(other)))
        turn = float(symmetry.rotation_error_deg(own[:3, :3], other[:3, :3]))
        around = gain[max(i - AROUND, 0) : i + AROUND + 1]
        if (apart > DIFFERENT_M or turn > DIFFERENT_DEG) and not decided(around):
            found.append(u)
    return found


def _preferred(
    observer: Observer,
    track: list[FrameResult],
    rival: dict[int, FrameResult],
    times: np.ndarray,
) -> list[int]:
    """The frames in which the rival explains the images better, for the object's inertia."""
    run = range(max(min(rival) - 1, 0), min(max(rival) + 2, len(track)))
    options: list[list[tuple[Fit, bool]]] = []
    for u in run:
        own, other = track[u], rival.get(u)
        both = [(own.fit, False)] if other is None or not own.lost or other.lost else []
        if other is not None and not other.lost:
            both.append((other.fit, True))
        options.append(both)
    path = best_sequence(observer.mesh, [[fit for fit, _ in both] for both in options], times[run])
    return [u for u, both, index in zip(run, options, path, strict=True) if both[index][1]]


def _is_turn(observer: Observer, own: Fit, other: Fit) -> bool:
    """Whether the two poses differ by a turn that hardly changes the object: which of those it is
    all frames of the track decide together."""
    turned = own.pose[:3, :3] @ near_turns(observer.mesh)[:, :3, :3]
    error = observer.mesh.symmetry.rotation_error_deg(turned, other.pose[:3, :3])
    return bool(np.min(error) < TURN_DEG)


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


def _sound(frame: FrameResult) -> bool:
    return not frame.lost and _evidence(frame.fit) >= SOUND_VIEWS


def _evidence(fit: Fit) -> int:
    """Views whose candidate and, where there is any, depth agree well with the pose."""
    return sum(
        view.visible_px >= MIN_PIXELS and view.overlap > SOUND and not view.depth_agreement < SOUND
        for view in fit.views
    )
