"""Which body regions touch the object in which frames, from geometry and motion alone.

The paper annotates contact by hand. Here every region has a two-state hidden Markov chain over the
frames (touching or not). Three things are evidence of contact: the region is as near as the fits
are accurate; it moves along with an object that moves; and an object that moves must be held by
something, so the region that follows it best is the most likely one. Annotated intervals enter as
strong evidence whose ends may be some frames off. The result is Q_t of equation 6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.config import ANY_REGION, ContactInterval
from intercap_core.contact.constants import (
    ANNOTATED_LOGIT,
    ANNOTATION_SLACK,
    CHANGES_PER_SECOND,
    EVIDENCE_CORRELATION_S,
    FREE_RANGE,
    HELD_SPEED_FACTOR,
    HOLDER_LOGIT,
    HOLDER_REACH,
    MAX_SLIP_LOGIT,
    MOVING_SPEED,
    OUTLIER_PROBABILITY,
    SLIP_SIGMA,
    TOUCHING_PRIOR,
)


@dataclass(frozen=True)
class RegionMotion:
    """Observations of R regions in T frames.

    ``distance`` (T, R) signed distance of the region's nearest area to the object, metres;
    ``slip`` (T, R) speed of that area relative to the object's surface beside it, m/s;
    ``object_speed`` (T, R) speed of that surface, m/s; ``sigma`` (T, R) stated standard deviation
    of the distance, metres.
    """

    distance: np.ndarray
    slip: np.ndarray
    object_speed: np.ndarray
    sigma: np.ndarray


def contact_probability(
    motion: RegionMotion,
    fps: float,
    *,
    given: np.ndarray | float = 0.0,
) -> np.ndarray:
    """Probability (T, R) that each region touches the object, smoothed over time.

    Forward-backward over each region's two-state chain; see the module's description. ``given``
    (T, R) are further log odds, from :func:`annotation_evidence`.
    """
    evidence = _distance_evidence(motion) + _motion_evidence(motion)
    evidence = evidence / max(1.0, EVIDENCE_CORRELATION_S * fps)
    evidence += _holder_evidence(motion, evidence, fps)
    return smooth(evidence + given, fps)


def _distance_evidence(motion: RegionMotion) -> np.ndarray:
    """Log odds (T, R) of the distance: normal about the surface against uniform within reach.

    A region inside the object touches it: its depth is error. Where the distance is hardly known,
    both likelihoods are equally wide and the log odds are near zero.
    """
    distance = np.maximum(motion.distance, 0.0)
    free = np.log(FREE_RANGE + np.sqrt(2 * np.pi) * motion.sigma)
    touching = -0.5 * np.square(distance / motion.sigma) - np.log(motion.sigma * np.sqrt(2 * np.pi))
    # An error of some millimetres beyond the stated one must not be impossible.
    return np.logaddexp(touching, np.log(OUTLIER_PROBABILITY) - free) + free


def _motion_evidence(motion: RegionMotion) -> np.ndarray:
    """Log odds (T, R) of the slip in frames where the object moves: half-normal with the jitter's
    standard deviation if the region holds the object, with the object's speed if it is free."""
    moving = motion.object_speed > MOVING_SPEED
    spread = np.maximum(motion.object_speed, MOVING_SPEED)
    holding = -0.5 * np.square(motion.slip / SLIP_SIGMA) - np.log(SLIP_SIGMA)
    free = -0.5 * np.square(motion.slip / spread) - np.log(spread)
    return np.where(moving, np.clip(holding - free, -MAX_SLIP_LOGIT, MAX_SLIP_LOGIT), 0.0)


def _holder_evidence(motion: RegionMotion, evidence: np.ndarray, fps: float) -> np.ndarray:
    """Log odds (T, R) that a moving object adds to the most likely holder within reach."""
    out = np.zeros_like(evidence)
    moving = motion.object_speed.max(axis=1) > HELD_SPEED_FACTOR * MOVING_SPEED
    reachable = motion.distance < HOLDER_REACH * motion.sigma
    score = np.where(reachable, evidence, -np.inf)
    best = score.argmax(axis=1)
    frames = np.flatnonzero(moving & reachable.any(axis=1))
    out[frames, best[frames]] = HOLDER_LOGIT / max(1.0, EVIDENCE_CORRELATION_S * fps)
    return out


def smooth(evidence: np.ndarray, fps: float) -> np.ndarray:
    """Posterior (T, R) of two-state Markov chains given log odds ``evidence`` (T, R) by frame."""
    change = min(0.5, CHANGES_PER_SECOND / fps)
    begin, end = 2 * change * TOUCHING_PRIOR, 2 * change * (1 - TOUCHING_PRIOR)
    transition = np.log(np.array([[1 - begin, begin], [end, 1 - end]]))
    frames, regions = evidence.shape
    emission = np.stack([np.zeros_like(evidence), evidence], axis=2)  # (T, R, 2)
    start = np.log(np.array([1 - TOUCHING_PRIOR, TOUCHING_PRIOR]))
    forward = np.empty((frames, regions, 2))
    forward[0] = start + emission[0]
    for t in range(1, frames):
        forward[t] = emission[t] + np.logaddexp.reduce(forward[t - 1][:, :, None] + transition, 1)
    backward = np.zeros((frames, regions, 2))
    for t in range(frames - 2, -1, -1):
        following = (emission[t + 1] + backward[t + 1])[:, None, :]
        backward[t] = np.logaddexp.reduce(transition[None] + following, axis=2)
    joint = forward + backward
    return np.exp(joint[:, :, 1] - np.logaddexp(joint[:, :, 0], joint[:, :, 1]))


def annotation_evidence(
    intervals: Sequence[ContactInterval],
    regions: Sequence[str],
    frames: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Log odds (T, R) that annotated intervals add, and the labels (T, R) int8 they state.

    Regions that no interval names are annotated as free throughout: a sequence's contact is
    annotated as a whole. While some unnamed part touches (``any``), regions have no label (-1) and
    no evidence unless they are named as well. Towards an interval's ends the evidence fades to
    zero over the frames by which annotators err.
    """
    labels = np.zeros((frames, len(regions)), np.int8)
    for interval in sorted(intervals, key=lambda interval: interval.part != ANY_REGION):
        during = slice(interval.start, interval.end)
        if interval.part == ANY_REGION:
            labels[during] = -1
        else:
            labels[during, regions.index(interval.part)] = 1
    position = np.arange(frames)
    evidence = np.empty(labels.shape)
    for r in range(len(regions)):
        changes = np.flatnonzero(np.diff(labels[:, r])) + 0.5
        nearest = (
            np.abs(position[:, None] - changes).min(axis=1)
            if len(changes)
            else np.full(frames, np.inf)
        )
        certainty = np.clip(nearest / ANNOTATION_SLACK, 0.0, 1.0)
        sign = np.choose(labels[:, r] + 1, (0.0, -1.0, 1.0))
        evidence[:, r] = sign * certainty * ANNOTATED_LOGIT
    return evidence, labels
