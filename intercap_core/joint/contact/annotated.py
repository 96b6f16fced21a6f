"""Q_t of equation 6 from annotated intervals: evidence by frame, and implausible intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from intercap_core.annotation import ANY_REGION, ContactInterval


@dataclass(frozen=True)
class AnnotationIssue:
    """An implausible annotated interval."""

    frames: range  # Frames concerned
    text: str  # Description
    distrusted: bool = False  # Whether the frames are flagged


def annotation_evidence(
    intervals: Sequence[ContactInterval], regions: Sequence[str], frames: int, uncertainty: int
) -> tuple[np.ndarray, np.ndarray]:
    """Log odds (T, R) of contact from annotated intervals, and their labels (T, R) int8.

    Labels are 1 (touching), 0 (free) and -1 (no label). Contact is annotated for a sequence as a
    whole: regions that no interval names are free in all frames. During an interval of an unnamed
    part (``any``) regions that are not named have no label and no evidence.

    The evidence is 0 within ``uncertainty`` frames of an end of an interval, where annotators err
    and the geometry decides. The middle between two ends always has evidence. Elsewhere it is plus
    or minus 12, beyond the evidence of distance and slip in one frame, which is between -9 and 7
    (:mod:`.detect`).
    """
    labels = np.zeros((frames, len(regions)), np.int8)
    # intervals of an unnamed part come first: those of a named part overwrite their labels
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
    sign = np.choose(labels + 1, (0.0, -1.0, 1.0))  # of the labels -1, 0, 1
    return sign * certain * 12.0, labels


def find_issues(
    intervals: Sequence[ContactInterval],
    regions: Sequence[str],
    distance: np.ndarray,
    unseen: np.ndarray,
) -> list[AnnotationIssue]:
    """Find implausible annotated intervals.

    Args:
        distance: (T, R) of each region to the object in the fit, metres.
        unseen: (T,) frames in which body or object was not seen.
    """
    issues = []
    for interval in intervals:
        if interval.end > interval.start:
            issues += _find_far(interval, regions, distance, unseen)
        else:
            text = f"contact of {interval.part} annotated for no frame at {interval.start}"
            issues.append(AnnotationIssue(range(interval.start, interval.end), text))
    return issues


def _find_far(
    interval: ContactInterval, regions: Sequence[str], distance: np.ndarray, unseen: np.ndarray
) -> list[AnnotationIssue]:
    """Find runs of frames in which the annotated part is more than 0.15 m from the object.

    The limit is tuned: unflagged frames of the studio have smaller errors.
    """
    of_part = (
        distance.min(axis=1)
        if interval.part == ANY_REGION
        else distance[:, regions.index(interval.part)]
    )
    during = slice(interval.start, interval.end)
    far = np.flatnonzero((of_part[during] > 0.15) & ~unseen[during]) + interval.start
    issues = []
    for run in np.split(far, np.flatnonzero(np.diff(far) > 1) + 1):
        if len(run):
            metres = of_part[run].min()
            text = f"contact of {interval.part} annotated {metres:.2f} m from the object or more"
            issues.append(AnnotationIssue(range(run[0], run[-1] + 1), text, distrusted=True))
    return issues
