"""Q_t of equation 6 from annotated intervals: evidence by frame, and what the fit contradicts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from intercap_core.annotation import ANY_REGION, ContactInterval
from intercap_core.geometry.solve.time_series import runs

# Least probability, by distance and slip alone, at which the fit contradicts a statement; chosen.
CONTRADICTED = 0.95


@dataclass(frozen=True)
class AnnotationIssue:
    """An annotated interval without frames, or one that the fit contradicts."""

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

    The evidence is 0 within ``uncertainty`` frames of an end that is marked as uncertain, where the
    geometry decides. The middle between two ends always has evidence. In all other frames with a
    label the statement holds exactly (:func:`hold_exactly`); there the evidence is plus or minus
    100, far beyond that of distance and slip and of the chain's transitions (:mod:`.detect`).
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
    for r, region in enumerate(regions):
        stated = [end for i in intervals if i.part in (region, ANY_REGION) for end in i.ends]
        unsure = {at for at, doubt in stated if doubt and 0 < at < frames}
        unsure -= {at for at, doubt in stated if not doubt}
        ends = [0, *(np.flatnonzero(np.diff(labels[:, r])) + 1), frames]
        for start, end in pairwise(ends):
            inside = np.arange(start, end) + 0.5
            begins = inside - start if start in unsure else np.full(end - start, np.inf)
            finishes = end - inside if end in unsure else np.full(end - start, np.inf)
            away = np.minimum(begins, finishes)
            certain[start:end, r] = away > min(uncertainty, (end - start) / 2 - 1)
    sign = np.choose(labels + 1, (0.0, -1.0, 1.0))  # of the labels -1, 0, 1
    return sign * certain * 100.0, labels


def hold_exactly(probability: np.ndarray, evidence: np.ndarray) -> np.ndarray:
    """Probability (T, R) that equals the statement, 0 or 1, where the annotation has evidence."""
    return np.where(evidence != 0, evidence > 0, probability)


def find_issues(
    intervals: Sequence[ContactInterval],
    regions: Sequence[str],
    evidence: np.ndarray,
    detected: np.ndarray,
    distance: np.ndarray,
    unseen: np.ndarray,
) -> list[AnnotationIssue]:
    """Find annotated intervals that have no frames, or that the fit contradicts.

    The fit contradicts an annotation if it has no contact of a part that is stated to touch, or
    contact of a part that is stated to be free.

    Args:
        evidence: (T, R) of the annotation.
        detected: (T, R) probability of contact by the fit alone.
        distance: (T, R) of each region to the object in the fit, metres.
        unseen: (T,) frames in which body or object was not seen.
    """
    issues = []
    for interval in intervals:
        part, during = interval.part, np.zeros(len(unseen), bool)
        if interval.end == interval.start:
            text = f"contact of {part} annotated for no frame at {interval.start}"
            issues.append(AnnotationIssue(range(interval.start, interval.end), text))
            continue
        during[interval.start : interval.end] = True
        of = np.arange(len(regions)) if part == ANY_REGION else np.array([regions.index(part)])
        if part != ANY_REGION:
            during &= evidence[:, of[0]] > 0
        free = (detected[:, of] < 1 - CONTRADICTED).all(axis=1)
        for first, last in runs(during & free & ~unseen):
            metres = distance[first : last + 1, of].min()
            text = f"contact of {part} annotated {metres:.2f} m from the object or more"
            issues.append(AnnotationIssue(range(first, last + 1), text, distrusted=True))
    touching = (detected > CONTRADICTED) & (evidence < 0) & ~unseen[:, None]
    for r, region in enumerate(regions):
        for first, last in runs(touching[:, r]):
            text = f"{region} annotated as free of contact, but it touches the object in the fit"
            issues.append(AnnotationIssue(range(first, last + 1), text, distrusted=True))
    return issues
