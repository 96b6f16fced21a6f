"""Which body regions touch the object in which frames, from geometry and motion alone.

The paper annotates contact by hand. Here every region is free, touches briefly or touches for long,
a hidden chain over the frames. Three things are evidence of contact: the region is as near as the
fits are accurate; it moves along with an object that moves; and an object that neither rests nor
falls is held by something. Most of a distance's error lasts (shape, clothing, mesh), so each
region's is estimated where it most likely touches, and what remains tells its first and last frame
of contact, and short contacts, from near misses. Annotated intervals enter as strong evidence
(:mod:`.annotated`). The result is Q_t of equation 6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.joint.contact.chain import Chain
from intercap_core.joint.contact.constants import (
    EVIDENCE_CORRELATION_S,
    FRAME_SIGMA,
    FREE_RANGE,
    MAX_LASTING_SIGMAS,
    MAX_SLIP_LOGIT,
    MOVING_SPEED,
    OUTLIER_PROBABILITY,
    SLIP_SIGMA,
    TOUCH_BEGINS,
    TOUCH_S,
    TOUCH_SHARES,
)
from intercap_core.joint.contact.support import support_evidence

_TOUCH = Chain(TOUCH_BEGINS, TOUCH_S, TOUCH_SHARES)


@dataclass(frozen=True)
class RegionMotion:
    """Observations of R regions in T frames.

    ``distance`` (T, R) signed distance of the region's nearest area to the object, metres;
    ``slip`` (T, R) speed of that area relative to the object's surface beside it, m/s;
    ``object_speed`` (T, R) speed of that surface, m/s; ``sigma`` (T, R) stated standard deviation
    of the part of the distance's error that lasts, metres.
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
    held: np.ndarray | None = None,
) -> np.ndarray:
    """Probability (T, R) that each region touches the object, smoothed over time.

    The posterior of each region's chain, twice: where a region touches without
    knowing its lasting error, and again with what that says of the error. See the module's
    description. ``given`` (T, R) are further log odds, from annotations; ``held`` (T,) the frames
    in which something must hold the object.
    """
    correlated = max(1.0, EVIDENCE_CORRELATION_S * fps)
    slip = _motion_evidence(motion)

    def posterior(error: np.ndarray, sigma: np.ndarray, support: np.ndarray | float) -> np.ndarray:
        near = _distance_evidence(motion.distance - error, sigma)
        evidence = (near + slip + support) / correlated
        return _TOUCH.posterior(evidence + given, fps)

    unknown = np.zeros(motion.distance.shape[1])
    first = posterior(unknown, np.hypot(motion.sigma, FRAME_SIGMA), 0.0)
    support = 0.0 if held is None else support_evidence(first, held)
    return posterior(*lasting_error(motion, first, correlated), support)


def lasting_error(
    motion: RegionMotion,
    probability: np.ndarray,
    correlated: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Each region's lasting error (R,) of its distance, metres, and the deviation (T, R) that is
    left when it is taken off.

    Measured where a region more likely touches than not, by ``probability`` (T, R): its distance is
    then nothing but error. ``correlated`` frames are one measurement; before any, the error is as
    stated.
    """
    prior = np.median(motion.sigma, axis=0)
    # What a frame's own sigma has beyond the usual is no lasting error (a lost track).
    frame = FRAME_SIGMA**2 + np.maximum(motion.sigma**2 - prior**2, 0.0)
    weight = np.maximum(0.0, 2 * probability - 1) / (frame * correlated)
    limit = MAX_LASTING_SIGMAS * prior
    variance = 1 / (prior**-2 + weight.sum(axis=0))
    error = variance * (weight * np.clip(motion.distance, -limit, limit)).sum(axis=0)
    return error, np.sqrt(variance + frame)


def _distance_evidence(distance: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Log odds (T, R) of distances: normal about the surface against uniform within reach.

    A region inside the object touches it: its depth is error. Where the distance is hardly known,
    both likelihoods are equally wide and the log odds are near zero.
    """
    free = np.log(FREE_RANGE + np.sqrt(2 * np.pi) * sigma)
    outside = np.maximum(distance, 0.0)
    touching = -0.5 * np.square(outside / sigma) - np.log(sigma * np.sqrt(2 * np.pi))
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
