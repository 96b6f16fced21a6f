"""Q_t given by annotation, of equation 6: what intervals say of each frame, and what is odd."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise

import numpy as np

from intercap_core.config import ANY_REGION, ContactInterval

# Log odds of an annotation away from its ends: above all that distance and slip can say against it.
ANNOTATED_LOGIT = 12.0
# An annotated contact this far from the object is a mistake of one or the other, metres: beyond
# what the fits err by where they are not flagged. Tuned on the studio.
FAR_CONTACT = 0.15


@dataclass(frozen=True)
class Oddity:
    """What is odd about an annotated interval in ``frames``, in words; ``distrusted`` where these
    frames should not be trusted for it."""

    frames: range
    text: str
    distrusted: bool = False


def annotation_evidence(
    intervals: Sequence[ContactInterval],
    regions: Sequence[str],
    frames: int,
    uncertainty: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Log odds (T, R) that annotated intervals add, and the labels (T, R) int8 they state.

    Regions that no interval names are annotated as free throughout: a sequence's contact is
    annotated as a whole. While some unnamed part touches (``any``), regions have no label (-1) and
    no evidence unless they are named as well. Annotators err by up to ``uncertainty`` frames at an
    end, wherever within them it is: so near to one the annotation says nothing, and what is seen
    decides. The middle between two ends is certain, however near they are.
    """
    labels = np.zeros((frames, len(regions)), np.int8)
    for interval in sorted(intervals, key=lambda interval: interval.part != ANY_REGION):
        during = slice(interval.start, interval.end)
        if interval.part == ANY_REGION:
            labels[during] = -1
        else:
            labels[during, regions.index(interval.part)] = 1
    certain = np.ones(labels.shape, bool)
    for r in range(len(regions)):
        ends = [0, *(np.flatnonzero(np.diff(labels[:, r])) + 1), frames]
        for start, end in pairwise(ends):
            inside = np.arange(start, end) + 0.5
            begins = inside - start if start > 0 else np.full(end - start, np.inf)
            finishes = end - inside if end < frames else np.full(end - start, np.inf)
            away = np.minimum(begins, finishes)
            certain[start:end, r] = away > min(uncertainty, (end - start) / 2 - 1)
    sign = np.choose(labels + 1, (0.0, -1.0, 1.0))
    return sign * certain * ANNOTATED_LOGIT, labels


def oddities(
    intervals: Sequence[ContactInterval],
    regions: Sequence[str],
    distance: np.ndarray,
    unseen: np.ndarray,
) -> list[Oddity]:
    """What is odd about annotated ``intervals``, by what the fit found.

    ``distance`` (T, R) of each region to the object, metres; ``unseen`` (T,) frames in which body
    or object was not seen, so that nothing can be held against the annotation.
    """
    found = [
        Oddity(range(i.start, i.end), f"contact of {i.part} annotated for no frame at {i.start}")
        for i in intervals
        if i.end <= i.start
    ]
    filled = [interval for interval in intervals if interval.end > interval.start]
    found += _overlaps(filled)
    for interval in filled:
        found += _unseen_ends(interval, unseen)
        found += _far_away(interval, regions, distance, unseen)
    return found


def _overlaps(intervals: Sequence[ContactInterval]) -> list[Oddity]:
    """Intervals of one part that name the same frames: they count once."""
    by_part = sorted(intervals, key=lambda i: (i.part, i.start, i.end))
    found = []
    for part, group in groupby(by_part, key=lambda i: i.part):
        reached = 0
        for interval in group:
            if interval.start < reached:
                both = range(interval.start, min(reached, interval.end))
                found.append(Oddity(both, f"contact of {part} annotated twice"))
            reached = max(reached, interval.end)
    return found


def _unseen_ends(interval: ContactInterval, unseen: np.ndarray) -> list[Oddity]:
    """Ends at frames that were not seen: only the annotation says when the contact changes."""
    ends = {"begins": interval.start, "ends": interval.end}
    return [
        Oddity(range(at - 1, at + 1), f"annotated contact of {interval.part} {what} unseen")
        for what, at in ends.items()
        if 0 < at < len(unseen) and unseen[at - 1 : at + 1].any()
    ]


def _far_away(
    interval: ContactInterval,
    regions: Sequence[str],
    distance: np.ndarray,
    unseen: np.ndarray,
) -> list[Oddity]:
    """Runs of frames in which the annotated part is far from the object."""
    of_part = (
        distance.min(axis=1)
        if interval.part == ANY_REGION
        else distance[:, regions.index(interval.part)]
    )
    during = slice(interval.start, interval.end)
    far = np.flatnonzero((of_part[during] > FAR_CONTACT) & ~unseen[during]) + interval.start
    found = []
    for run in np.split(far, np.flatnonzero(np.diff(far) > 1) + 1):
        if len(run):
            metres = of_part[run].min()
            text = f"contact of {interval.part} annotated {metres:.2f} m from the object or more"
            found.append(Oddity(range(run[0], run[-1] + 1), text, distrusted=True))
    return found
