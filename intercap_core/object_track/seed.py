"""The pose that tracking starts from, found with nothing to start from."""

from __future__ import annotations

import logging

import numpy as np

from intercap_core.object_track.fit import Fit, MotionPrior
from intercap_core.object_track.follow import follow, value_to_believe
from intercap_core.object_track.lost import judged
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.search import same_pose

log = logging.getLogger(__name__)

SURE = 0.65  # confidence that is good enough to stop looking for a better seed frame
SEARCHED = 3  # frames searched for the seed, more while nothing is found
SEARCHED_MAX = 10
RIVALS = 5  # hypotheses of the seed frame, compared over its neighbours
RIVAL_MARGIN = 0.80  # of the best confidence
RIVAL_FRAMES = 3  # on each side
ANNOTATION_FRAMES = 5  # by which an annotation's frame may be off
ANNOTATION_ROUNDS = (4, 5)
CLEARLY_BETTER = 1.15  # of the value, for which another frame or pose is preferred


class NotFound(Exception):
    """No frame shows anything that could be the object."""


def find_seed(observer: Observer) -> tuple[int, Fit]:
    """The frame to start from and the pose there. Raises NotFound where there is none."""
    seen: list[tuple[int, list[Fit]]] = []
    for tried, t in enumerate(observer.frames_to_search()):
        if tried >= SEARCHED_MAX or (tried >= SEARCHED and seen):
            break
        found = observer.search(t)
        if found:
            seen.append((t, found))
            if observer.value(t, found[0]) > SURE:
                break
    if not seen:
        raise NotFound
    t, found = max(seen, key=lambda one: observer.value(one[0], one[1][0]))
    if observer.value(t, found[0]) < value_to_believe(observer, t):
        # nobody is at anything that looks like it: then it is what looks like it most
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
    whether the images bear the annotation out.

    Where they do not, the frames beside it are tried, then what a search finds; a pose near the
    annotation that is not lost goes before a better one elsewhere.
    """
    frames = range(
        max(frame - ANNOTATION_FRAMES, 0), min(frame + ANNOTATION_FRAMES + 1, observer.count)
    )
    best: tuple[int, Fit] | None = None
    for t in sorted(frames, key=lambda t: abs(t - frame)):
        fit = observer.fit(t, pose, MotionPrior(pose), rounds=ANNOTATION_ROUNDS, scale=1.0)
        if best is None or observer.value(t, fit) > CLEARLY_BETTER * observer.value(*best):
            best = (t, fit)
        if observer.value(*best) > SURE:
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
    least = RIVAL_MARGIN * observer.value(seed_frame, found[0])
    rivals = [fit for fit in found if observer.value(seed_frame, fit) > least][:RIVALS]
    if len(rivals) == 1:
        return rivals[0]
    totals = []
    for rival in rivals:
        total = [observer.value(seed_frame, rival)]
        for frames in (
            range(seed_frame + 1, min(seed_frame + 1 + RIVAL_FRAMES, observer.count)),
            range(seed_frame - 1, max(seed_frame - 1 - RIVAL_FRAMES, -1), -1),
        ):
            start = judged(rival, observer.settings)
            following = follow(observer, frames, start, may_search=False)
            total += [observer.value(t, result.fit) for t, result in following]
        totals.append(float(np.mean(total)))
    return rivals[int(np.argmax(totals))]
