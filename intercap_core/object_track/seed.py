"""The initial pose for tracking, found without any prior pose."""

from __future__ import annotations

import logging

import numpy as np

from intercap_core.object_track.constants import (
    ANNOTATION_FRAMES,
    CLEARLY_BETTER,
    FIT_ROUNDS,
    SEED_RIVAL_FRAMES,
    SEED_RIVAL_SHARE,
    SEED_RIVALS,
    SEED_SEARCHES,
    SEED_SEARCHES_MAX,
    SEED_SURE_VALUE,
)
from intercap_core.object_track.fit import Fit, MotionPrior
from intercap_core.object_track.follow import follow, min_value
from intercap_core.object_track.lost import judged
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.search import same_pose

log = logging.getLogger(__name__)


class NotFound(Exception):
    """No frame shows anything that could be the object."""


def find_seed(observer: Observer) -> tuple[int, Fit]:
    """The frame to start from and the pose there. Raises NotFound where there is none."""
    seen: list[tuple[int, list[Fit]]] = []
    for tried, t in enumerate(observer.frames_to_search()):
        if tried >= SEED_SEARCHES_MAX or (tried >= SEED_SEARCHES and seen):
            break
        found = observer.search(t)
        if found:
            seen.append((t, found))
            if observer.value(t, found[0]) > SEED_SURE_VALUE:
                break
    if not seen:
        raise NotFound
    t, found = max(seen, key=lambda one: observer.value(one[0], one[1][0]))
    if observer.value(t, found[0]) < min_value(observer, t):
        # no match near the person: take the best match, wherever it is
        t, fit = max(
            ((t, fit) for t, found in seen for fit in found),
            key=lambda one: observer.plausibility(one[1]),
        )
        observer.places.claim(observer.mesh.centre_at(fit.pose))
        found = sorted(dict(seen)[t], key=lambda fit: -observer.value(t, fit))
    log.info("seed frame %d, confidence %.2f", t, found[0].confidence)
    return t, _settled(observer, t, found)


def annotated_seed(observer: Observer, frame: int, pose: np.ndarray) -> tuple[int, Fit, bool]:
    """The frame and the pose to start from, near an annotated ``pose`` (4, 4) of ``frame``, and
    whether the images support the annotation.

    Where they do not, the frames beside it are tried, then what a search finds; a pose near the
    annotation that is not lost goes before a better one elsewhere.
    """
    frames = range(
        max(frame - ANNOTATION_FRAMES, 0), min(frame + ANNOTATION_FRAMES + 1, observer.count)
    )
    best: tuple[int, Fit] | None = None
    for t in sorted(frames, key=lambda t: abs(t - frame)):
        fit = observer.fit(t, pose, MotionPrior(pose), rounds=FIT_ROUNDS, scale=1.0)
        if best is None or observer.value(t, fit) > CLEARLY_BETTER * observer.value(*best):
            best = (t, fit)
        if observer.value(*best) > SEED_SURE_VALUE:
            return *best, True
    assert best is not None
    t, fit = best
    lost = judged(fit, observer.settings).lost
    found = [
        other
        for other in observer.search(t, near=observer.mesh.centre_at(pose))
        if observer.value(t, other) > CLEARLY_BETTER * observer.value(t, fit)
        and not judged(other, observer.settings).lost
        and not same_pose(observer.mesh, other.pose, fit.pose)
    ]
    if found and lost:
        nearest = min(
            found, key=lambda other: float(np.linalg.norm(other.pose[:3, 3] - pose[:3, 3]))
        )
        return t, nearest, False
    return t, fit, not found and not lost


def _settled(observer: Observer, seed_frame: int, found: list[Fit]) -> Fit:
    """The hypothesis that stays best over the neighbouring frames."""
    least = SEED_RIVAL_SHARE * observer.value(seed_frame, found[0])
    rivals = [fit for fit in found if observer.value(seed_frame, fit) > least][:SEED_RIVALS]
    if len(rivals) == 1:
        return rivals[0]
    totals = []
    for rival in rivals:
        total = [observer.value(seed_frame, rival)]
        for frames in (
            range(seed_frame + 1, min(seed_frame + 1 + SEED_RIVAL_FRAMES, observer.count)),
            range(seed_frame - 1, max(seed_frame - 1 - SEED_RIVAL_FRAMES, -1), -1),
        ):
            start = judged(rival, observer.settings)
            following = follow(observer, frames, start, may_search=False)
            total += [observer.value(t, result.fit) for t, result in following]
        totals.append(float(np.mean(total)))
    return rivals[int(np.argmax(totals))]
