"""When something must hold the object: it is off the floor, moves and does not fall.

Which body regions touch the object in which frames, from geometry and motion alone.

The paper annotates contact by hand. Here every region is free, touches briefly or touches for long,
a hidden chain over the frames. Three things are evidence of contact: the region is as near as the
fits are accurate; it moves along with an object that moves; and an object that neither rests nor
falls is held by something. Most of a distance's error lasts (shape, clothing, mesh), so each
region's is estimated where it most likely touches, and what remains tells its first and last frame
of contact, and short contacts, from near misses. Annotated intervals enter as strong evidence
(:mod:`.annotated`). The result is Q_t of equation 6.

The observations of contact detection: each region's distance to the object and its slip.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.joint.contact.chain import Chain
from intercap_core.joint.proximity import Proximity
from intercap_core.joint.skin import Patches

# Errors of a region's distance that last through a contact, metres, beside what the fits state: of
# shape, clothing and the two meshes; and those that change from frame to frame. Tuned on the
# studio.
LASTING_SIGMA, FRAME_SIGMA = 0.006, 0.004
# A lasting error is believed up to so many of its standard deviations. Tuned on the studio.
MAX_LASTING_SIGMAS = 3.0
# Speed of skin over a held surface that the fits' jitter explains, m/s. Tuned on the studio.
SLIP_SIGMA = 0.12
# The evidence of one frame repeats in its neighbours for about so many seconds: what does not last
# of the fits' errors.
# Tuned on the studio.
EVIDENCE_CORRELATION_S = 0.07
# Probability that the error of a touching region's distance is beyond the stated one: some
# millimetres more must not rule contact out. Tuned on the studio.
OUTLIER_PROBABILITY = 0.01
# How often a second a free region begins to touch, and how long it does, seconds: four contacts in
# five are brief (a sip, a kick), the others are holds. Tuned on the studio.
TOUCH_BEGINS = 0.6
TOUCH_S, TOUCH_SHARES = (0.3, 3.0), (0.8, 0.2)
# A free region near the object is anywhere within this distance of it, metres: on its way there or
# back, or beside one that touches. Tuned on the studio.
FREE_RANGE = 0.10
# An object moves when its surface does so faster than this, m/s: the track's jitter stays below.
# Tuned on the studio.
MOVING_SPEED = 0.12
# An object is off the floor from this height on, metres: above the floor's and the track's errors.
# Tuned on the studio.
LIFTED_HEIGHT = 0.03
# A fall's acceleration differs from gravity's by less than this, m/s^2: air, and the track's jitter
# between frames. Tuned on the studio.
FALL_TOLERANCE = 4.0
STANDARD_GRAVITY = 9.80665  # m/s^2, by definition
# Probability that no region holds an object that neither rests nor falls: it slides on furniture,
# or something that is not modelled holds it. Tuned on the studio.
UNHELD_PROBABILITY = 0.1
# Limit of the log odds that the slip of one frame gives: the model of it is rough. Tuned on the
# studio.
MAX_SLIP_LOGIT = 4.0
# Depth over which the soft minimum of a region's distance fades, metres: what is this much farther
# than its nearest vertex counts a third. Tuned on the studio.
SOFT_MINIMUM = 0.004

_TOUCH = Chain(TOUCH_BEGINS, TOUCH_S, TOUCH_SHARES)


def held(centre: np.ndarray, height: np.ndarray, up: np.ndarray, fps: float) -> np.ndarray:
    """Frames (T,) in which the object neither rests on anything nor falls.

    ``centre`` (T, 3) of the object and ``up`` (3,) the floor's normal, master frame; ``height``
    (T,) of the object's lowest point above the floor; metres. What does not move may stand on
    furniture, and what is at the floor may stand or roll on it.
    """
    if len(centre) < 3:
        return np.zeros(len(centre), bool)
    velocity = np.gradient(centre, 1 / fps, axis=0)
    acceleration = np.diff(centre, 2, axis=0) * fps**2
    acceleration = np.concatenate([acceleration[:1], acceleration, acceleration[-1:]])
    falls = np.linalg.norm(acceleration + STANDARD_GRAVITY * up, axis=1) < FALL_TOLERANCE
    moves = np.linalg.norm(velocity, axis=1) > MOVING_SPEED
    return (height > LIFTED_HEIGHT) & moves & ~falls


def support_evidence(probability: np.ndarray, held_in: np.ndarray) -> np.ndarray:
    """Log odds (T, R) that each region touches, from knowing that some region holds the object.

    ``probability`` (T, R) of each without this, ``held_in`` (T,) the frames. The message of the
    constraint "at least one touches" to a region: it touches, or one of the others does. A region
    gains nothing where another one surely touches.
    """
    free = np.log1p(-np.clip(probability, 0.0, 1 - 1e-9))
    others = np.exp(free.sum(axis=1, keepdims=True) - free)
    return np.where(held_in[:, None], -np.log(1 - others * (1 - UNHELD_PROBABILITY)), 0.0)


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
    """Summarise the patches' vertices by region: means that weigh the nearest ones most, which
    for the distance is a soft minimum.

    ``points`` (T, N, 3) patch vertices and ``near`` their proximity, object pose ``rotation``
    (T, 3, 3), ``translation`` (T, 3), master frame, metres; ``joint_sigma`` (T, 55) and
    ``object_sigma`` (T,) stated standard deviations, metres.
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
    points: np.ndarray,
    rotation: np.ndarray,
    translation: np.ndarray,
    fps: float,
) -> np.ndarray:
    """Speed (T, N) of points (T, N, 3) in the object's frame, m/s."""
    local = (points - translation[:, None]) @ rotation
    return np.linalg.norm(_derivative(local, fps), axis=2)


def _rigid_speed(
    surface: np.ndarray,
    rotation: np.ndarray,
    translation: np.ndarray,
    fps: float,
) -> np.ndarray:
    """Speed (T, N) of the object's surface points (T, N, 3), moving rigidly with it, m/s."""
    local = (surface - translation[:, None]) @ rotation
    turn, shift = _derivative(rotation, fps), _derivative(translation, fps)
    velocity = local @ turn.transpose(0, 2, 1) + shift[:, None]
    return np.linalg.norm(velocity, axis=2)


def _derivative(values: np.ndarray, fps: float) -> np.ndarray:
    """Central differences over the first axis, one-sided at the ends."""
    if len(values) < 2:
        return np.zeros_like(values)
    return np.gradient(values, 1 / fps, axis=0)
