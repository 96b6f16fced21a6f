"""Audits the track: in selected frames the object is searched for without using the track.

A tracker that drifted into a wrong pose while a hand occluded the object keeps that pose
afterwards, and the visible depth fits it passably. Where a search finds another pose the track is
followed from there both ways, and the images of all frames in which the two differ decide.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from intercap_core.object_track.choices import best_sequence
from intercap_core.object_track.constants import (
    AUDIT_DIFFERENT_DEG,
    AUDIT_DIFFERENT_M,
    AUDIT_EVERY_FRAMES,
    AUDIT_NEAR_TURN_DEG,
    AUDIT_NEIGHBOURS,
    AUDIT_RIVAL_MARGIN,
    AUDIT_WINDOW_FRAMES,
    AUDITS_MIN,
    MIN_PLACE_PRIOR,
    MIN_RENDERED_PX,
    NEAR_LAST_PLACE_M,
    SOUND_AGREEMENT,
    SOUND_VIEWS,
)
from intercap_core.object_track.fit import Fit
from intercap_core.object_track.follow import follow, min_value
from intercap_core.object_track.lost import FrameResult, decided
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.search import same_pose
from intercap_core.object_track.turns import near_turns


def audited(observer: Observer, track: list[FrameResult], times: np.ndarray) -> list[FrameResult]:
    """The track (T): frames that another pose explains better are replaced, frames that it explains
    equally well are flagged ambiguous; ``times`` (T,) seconds."""
    result = list(track)
    windows = [
        range(start, min(start + AUDIT_WINDOW_FRAMES, observer.count))
        for start in range(0, observer.count, AUDIT_WINDOW_FRAMES)
    ]
    doubtful = [frames for frames in windows if not any(_sound(track[t]) for t in frames)]
    doubtful.sort(key=lambda frames: max(_evidence(track[t].fit) for t in frames))
    most = max(AUDITS_MIN, observer.count // AUDIT_EVERY_FRAMES)
    for frames in doubtful[:most]:
        t = max(frames, key=observer.promise)
        _look(observer, result, t, times)
    return result


def _look(observer: Observer, track: list[FrameResult], t: int, times: np.ndarray) -> None:
    """Search frame t; where the search finds another pose, decide which of the two the frames
    around it keep."""
    own = track[t]
    value = 0.0 if own.lost else observer.value(t, own.fit)
    others = [
        fit
        for fit in observer.search(t)
        if observer.value(t, fit) > value - AUDIT_RIVAL_MARGIN
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
    """Whether a searched pose may be the object: the images alone would prefer a fully visible
    object of the same kind to the partly occluded one in a hand."""
    there = observer.mesh.centre_at(fit.pose)
    away = float(np.linalg.norm(there - observer.mesh.centre_at(own.fit.pose)))
    if not own.lost and away < NEAR_LAST_PLACE_M:
        return True
    sure = observer.value(t, fit) >= min_value(observer, t)
    return sure and observer.places.prior(t, there) > MIN_PLACE_PRIOR


def _undecided(
    observer: Observer, track: list[FrameResult], rival: dict[int, FrameResult]
) -> list[int]:
    """The frames in which the two poses are far apart and the images of the frames around do not
    decide between them."""
    run = sorted(rival)
    gain = np.array([rival[u].score - track[u].score for u in run])
    symmetry = observer.mesh.symmetry
    found = []
    for i, u in enumerate(run):
        own, other = track[u].fit.pose, rival[u].fit.pose
        apart = float(np.linalg.norm(observer.mesh.centre_at(own) - observer.mesh.centre_at(other)))
        turn = float(symmetry.rotation_error_deg(own[:3, :3], other[:3, :3]))
        around = gain[max(i - AUDIT_NEIGHBOURS, 0) : i + AUDIT_NEIGHBOURS + 1]
        if (apart > AUDIT_DIFFERENT_M or turn > AUDIT_DIFFERENT_DEG) and not decided(around):
            found.append(u)
    return found


def _preferred(
    observer: Observer,
    track: list[FrameResult],
    rival: dict[int, FrameResult],
    times: np.ndarray,
) -> list[int]:
    """The frames in which the rival hypothesis explains the images better, given the object's
    inertia."""
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
    """Whether the two poses differ by a near symmetry of the object; that ambiguity is resolved
    later, over all frames (:mod:`.turns`)."""
    turned = own.pose[:3, :3] @ near_turns(observer.mesh)[:, :3, :3]
    error = observer.mesh.symmetry.rotation_error_deg(turned, other.pose[:3, :3])
    return bool(np.min(error) < AUDIT_NEAR_TURN_DEG)


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
        view.visible_px >= MIN_RENDERED_PX
        and view.overlap > SOUND_AGREEMENT
        and not view.depth_agreement < SOUND_AGREEMENT
        for view in fit.views
    )
