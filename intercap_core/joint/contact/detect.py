"""Contact of body regions with the object, detected from geometry and motion alone.

The paper annotates contact by hand. Here each region is a hidden chain over the frames: free, in a
brief contact, or in a long one. Three kinds of evidence speak for contact: the region is as near as
the fits are accurate; it moves along with a moving object; and an object that neither rests nor
falls is held by some region.

Most of a distance's error lasts (shape, clothing, mesh). Each region's lasting error is estimated
in the frames in which it most likely touches. The distance less this error separates contact from
near misses, and gives its first and last frame. Annotated intervals enter as strong evidence
(:mod:`.annotated`). The result is Q_t of equation 6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.joint.contact.chain import DwellChain
from intercap_core.joint.proximity import Proximity
from intercap_core.joint.skin import Patches

# Standard deviations of a region's distance beyond those that the fits state, metres: lasting
# errors (shape, clothing, the two meshes), and errors of single frames. Tuned on the studio.
LASTING_SIGMA = 0.006
FRAME_SIGMA = 0.004
# Standard deviations up to which a lasting error is plausible. Tuned on the studio.
MAX_LASTING_SIGMAS = 3.0
# Speed of skin over a held surface that the fits' jitter explains, m/s. Tuned on the studio.
SLIP_SIGMA = 0.12
# Correlation time of the fits' errors, seconds: frames within it are one observation. Tuned on the
# studio.
EVIDENCE_CORRELATION_S = 0.07
# Probability that the distance of a touching region errs by more than stated: some millimetres must
# not rule contact out. Tuned on the studio.
OUTLIER_PROBABILITY = 0.01
# Distance within which a free region near the object is uniformly distributed, metres: on its way
# there or back, or beside a touching region. Tuned on the studio.
FREE_RANGE = 0.10
# Speed of the object's surface above which it moves, m/s: the track's jitter stays below. Tuned on
# the studio.
MOVING_SPEED = 0.12
# Height above which an object is off the floor, metres: above errors of floor and track. Tuned on
# the studio.
LIFTED_HEIGHT = 0.03
# Difference of a fall's acceleration from gravity, m/s^2: air, and the track's jitter. Tuned on the
# studio.
FALL_TOLERANCE = 4.0
STANDARD_GRAVITY = 9.80665  # m/s^2, by definition
# Probability that no region holds an object that neither rests nor falls: it slides on furniture,
# or something that is not modelled holds it. Tuned on the studio.
UNHELD_PROBABILITY = 0.1
# Limit of the log odds of the slip in one frame: its model is rough. Tuned on the studio.
MAX_SLIP_LOGIT = 4.0
# Scale of the soft minimum of a region's distance, metres: a vertex that is this much farther than
# the nearest one has a third of its weight. Tuned on the studio.
SOFT_MINIMUM = 0.004

# A free region begins to touch 0.6 times a second. Four contacts in five are brief (a sip, a kick;
# 0.3 s), the others are holds (3 s). Tuned on the studio.
_TOUCH = DwellChain(begins=0.6, durations=(0.3, 3.0), shares=(0.8, 0.2))


@dataclass(frozen=True)
class RegionMotion:
    """Observations of R regions in T frames."""

    distance: np.ndarray
    """(T, R) signed distance of the region's nearest area to the object, metres."""
    slip: np.ndarray
    """(T, R) speed of that area relative to the object's surface next to it, m/s."""
    object_speed: np.ndarray
    """(T, R) speed of that surface, m/s."""
    sigma: np.ndarray
    """(T, R) standard deviation of the lasting error of the distance, metres."""


def region_motion(
    patches: Patches,
    points: np.ndarray,
    near: Proximity,
    rotation: np.ndarray,
    translation: np.ndarray,
    joint_sigma: np.ndarray,
    object_sigma: np.ndarray,
    fps: float,
) -> RegionMotion:
    """Summarise the patches' vertices by region, by means that weigh the nearest vertices most.

    Args:
        points: (T, M, 3) patch vertices, master frame, metres.
        near: their distances to the object.
        rotation: (T, 3, 3) of master_from_object.
        translation: (T, 3) of master_from_object, metres.
        joint_sigma: (T, 55) standard deviations of the joints, metres.
        object_sigma: (T,) standard deviation of the object, metres.
    """
    frames = len(points)
    surface = points - near.distance[..., None] * near.normals
    skin_speed = _speed_over_object(points, rotation, translation, fps)
    surface_speed = _rigid_speed(surface, rotation, translation, fps)
    regions = int(patches.region.max()) + 1
    distance, slip, speed, sigma = (np.zeros((frames, regions)) for _ in range(4))
    for r in range(regions):
        members = np.flatnonzero(patches.region == r)
        away = near.distance[:, members]
        weight = np.exp((away.min(axis=1, keepdims=True) - away) / SOFT_MINIMUM)
        weight *= patches.share[members]
        weight /= weight.sum(axis=1, keepdims=True)
        distance[:, r] = (weight * away).sum(axis=1)
        slip[:, r] = (weight * skin_speed[:, members]).sum(axis=1)
        speed[:, r] = (weight * surface_speed[:, members]).sum(axis=1)
        joint = (weight * joint_sigma[:, patches.joint[members]]).sum(axis=1)
        sigma[:, r] = np.sqrt(joint**2 + object_sigma**2 + LASTING_SIGMA**2)
    return RegionMotion(distance, slip, speed, sigma)


def _speed_over_object(
    points: np.ndarray, rotation: np.ndarray, translation: np.ndarray, fps: float
) -> np.ndarray:
    """Speed (T, M) of points (T, M, 3) in the object's frame, m/s."""
    local = (points - translation[:, None]) @ rotation
    return np.linalg.norm(_derivative(local, fps), axis=2)


def _rigid_speed(
    surface: np.ndarray, rotation: np.ndarray, translation: np.ndarray, fps: float
) -> np.ndarray:
    """Speed (T, M) of points (T, M, 3) that move with the object, m/s."""
    local = (surface - translation[:, None]) @ rotation
    turn, shift = _derivative(rotation, fps), _derivative(translation, fps)
    velocity = local @ turn.transpose(0, 2, 1) + shift[:, None]
    return np.linalg.norm(velocity, axis=2)


def _derivative(values: np.ndarray, fps: float) -> np.ndarray:
    """Central differences over the first axis, one-sided at the ends."""
    if len(values) < 2:
        return np.zeros_like(values)
    return np.gradient(values, 1 / fps, axis=0)


def contact_probability(
    motion: RegionMotion,
    fps: float,
    *,
    given: np.ndarray | float = 0.0,
    held: np.ndarray | None = None,
) -> np.ndarray:
    """Probability (T, R) that each region touches the object, smoothed over time.

    The posterior of each region's chain is computed twice: with an unknown lasting error, and with
    the error that follows from the first posterior.

    Args:
        given: (T, R) further log odds, from annotations.
        held: (T,) frames in which some region must hold the object.
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
    """Lasting error (R,) of each region's distance, and the remaining deviation (T, R), metres.

    The error is the weighted mean distance in frames in which the region more likely touches than
    not. Without such frames it is 0, with the stated deviation.

    Args:
        probability: (T, R) of contact.
        correlated: number of frames that are one measurement.
    """
    prior = np.median(motion.sigma, axis=0)
    # a frame's deviation beyond the usual one is no lasting error (a lost track)
    frame = FRAME_SIGMA**2 + np.maximum(motion.sigma**2 - prior**2, 0.0)
    weight = np.maximum(0.0, 2 * probability - 1) / (frame * correlated)
    limit = MAX_LASTING_SIGMAS * prior
    variance = 1 / (prior**-2 + weight.sum(axis=0))
    error = variance * (weight * np.clip(motion.distance, -limit, limit)).sum(axis=0)
    return error, np.sqrt(variance + frame)


def _distance_evidence(distance: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Log odds (T, R) of distances: normal about the surface against uniform within reach.

    A region inside the object touches it: its depth is error. If the distance is hardly known, both
    likelihoods are equally wide and the log odds are near zero.
    """
    free = np.log(FREE_RANGE + np.sqrt(2 * np.pi) * sigma)
    outside = np.maximum(distance, 0.0)
    touching = -0.5 * np.square(outside / sigma) - np.log(sigma * np.sqrt(2 * np.pi))
    return np.logaddexp(touching, np.log(OUTLIER_PROBABILITY) - free) + free


def _motion_evidence(motion: RegionMotion) -> np.ndarray:
    """Log odds (T, R) of the slip while the object moves.

    Half-normal with the jitter's standard deviation if the region holds the object, with the
    object's speed if it is free.
    """
    moving = motion.object_speed > MOVING_SPEED
    spread = np.maximum(motion.object_speed, MOVING_SPEED)
    holding = -0.5 * np.square(motion.slip / SLIP_SIGMA) - np.log(SLIP_SIGMA)
    free = -0.5 * np.square(motion.slip / spread) - np.log(spread)
    return np.where(moving, np.clip(holding - free, -MAX_SLIP_LOGIT, MAX_SLIP_LOGIT), 0.0)


def find_held(centre: np.ndarray, height: np.ndarray, up: np.ndarray, fps: float) -> np.ndarray:
    """Mask (T,) of frames in which the object is lifted, moves and does not fall.

    An object that does not move may stand on furniture, one at the floor may roll on it.

    Args:
        centre: (T, 3) of the object, master frame, metres.
        height: (T,) of its lowest point above the floor, metres.
        up: (3,) the floor's normal.
    """
    if len(centre) < 3:
        return np.zeros(len(centre), bool)
    velocity = np.gradient(centre, 1 / fps, axis=0)
    acceleration = np.diff(centre, 2, axis=0) * fps**2
    acceleration = np.concatenate([acceleration[:1], acceleration, acceleration[-1:]])
    falls = np.linalg.norm(acceleration + STANDARD_GRAVITY * up, axis=1) < FALL_TOLERANCE
    moves = np.linalg.norm(velocity, axis=1) > MOVING_SPEED
    return (height > LIFTED_HEIGHT) & moves & ~falls


def support_evidence(probability: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Log odds (T, R) that each region touches, given that some region holds the object.

    The message of the constraint "at least one touches" to a region: it touches, or one of the
    others does. A region gains nothing if another one surely touches.

    Args:
        probability: (T, R) of contact without this constraint.
        held: (T,) frames with this constraint.
    """
    free = np.log1p(-np.clip(probability, 0.0, 1 - 1e-9))
    others = np.exp(free.sum(axis=1, keepdims=True) - free)
    return np.where(held[:, None], -np.log(1 - others * (1 - UNHELD_PROBABILITY)), 0.0)
