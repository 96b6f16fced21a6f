"""Detect contact of body regions with the object from geometry and motion: Q_t of equation 6.

Each region is a hidden chain over the frames: free, in a brief contact, or in a long one. Evidence
of contact is a distance within the accuracy of the fits, and motion along with a moving object.
Most of a distance's error lasts (shape, clothing, mesh): it is estimated in the frames of likely
contact and subtracted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.joint.contact.chain import DwellChain
from intercap_core.joint.proximity import Proximity
from intercap_core.joint.skin import SURFACE_SIGMA, Patches

# Standard deviation of a region's distance beyond that of the fits, metres. It is the same in all
# frames, as errors of shape, clothing and both meshes are. Tuned on the studio.
LASTING_SIGMA = 0.006

# Contacts per second of a free region. Four in five are brief (a sip, a kick: 0.3 s), the others
# are holds (3 s). Tuned on the studio.
_TOUCH = DwellChain(begins=0.6, durations=(0.3, 3.0), shares=(0.8, 0.2))


@dataclass(frozen=True)
class RegionMotion:
    """Observations of R regions in T frames."""

    distance: np.ndarray  # (T, R) signed distance of the nearest area to the object, metres
    slip: np.ndarray  # (T, R) speed of that area relative to the object's surface next to it, m/s
    object_speed: np.ndarray  # (T, R) speed of that surface, m/s
    sigma: np.ndarray  # (T, R) standard deviation of the lasting error of the distance, metres


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

    A vertex that is ``SURFACE_SIGMA`` farther away than the nearest one has a third of its weight.

    Args:
        points: (T, M, 3) patch vertices, master frame, metres.
        near: their distances to the object.
        rotation: (T, 3, 3) of master_from_object.
        translation: (T, 3) of master_from_object, metres.
        joint_sigma: (T, 55) standard deviations of the joints, metres.
        object_sigma: (T,) standard deviation of the object, metres.
    """
    frames = len(points)
    # speed of the skin in the object's frame, and speed of the object's surface next to it
    local = (points - translation[:, None]) @ rotation
    skin_speed = np.linalg.norm(_derivative(local, fps), axis=2)
    surface = points - near.distance[..., None] * near.normals
    local = (surface - translation[:, None]) @ rotation
    turn, shift = _derivative(rotation, fps), _derivative(translation, fps)
    velocity = local @ turn.transpose(0, 2, 1) + shift[:, None]
    surface_speed = np.linalg.norm(velocity, axis=2)
    regions = int(patches.region.max()) + 1
    distance, slip, speed, sigma = (np.zeros((frames, regions)) for _ in range(4))
    for r in range(regions):
        members = np.flatnonzero(patches.region == r)
        away = near.distance[:, members]
        weight = np.exp((away.min(axis=1, keepdims=True) - away) / SURFACE_SIGMA)
        weight *= patches.share[members]
        weight /= weight.sum(axis=1, keepdims=True)
        distance[:, r] = (weight * away).sum(axis=1)
        slip[:, r] = (weight * skin_speed[:, members]).sum(axis=1)
        speed[:, r] = (weight * surface_speed[:, members]).sum(axis=1)
        joint = (weight * joint_sigma[:, patches.joint[members]]).sum(axis=1)
        sigma[:, r] = np.sqrt(joint**2 + object_sigma**2 + LASTING_SIGMA**2)
    return RegionMotion(distance, slip, speed, sigma)


def _derivative(values: np.ndarray, fps: float) -> np.ndarray:
    """Central differences over the first axis, one-sided at the ends."""
    if len(values) < 2:
        return np.zeros_like(values)
    return np.gradient(values, 1 / fps, axis=0)


def contact_probability(
    motion: RegionMotion, fps: float, *, given: np.ndarray | float = 0.0
) -> np.ndarray:
    """Probability (T, R) that each region touches the object, smoothed over time.

    The posterior of each region's chain is computed twice: with an unknown lasting error, and with
    the error that follows from the first posterior.

    ``given`` (T, R) are further log odds, from annotations.
    """
    correlated = max(1.0, 0.07 * fps)  # frames with the same error: 0.07 s, tuned on the studio
    slip = _motion_evidence(motion, fps)

    def posterior(error: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        near = _distance_evidence(motion.distance - error, sigma)
        return _TOUCH.posterior((near + slip) / correlated + given, fps)

    unknown = np.zeros(motion.distance.shape[1])
    first = posterior(unknown, np.hypot(motion.sigma, SURFACE_SIGMA))
    return posterior(*lasting_error(motion, first, correlated))


def lasting_error(
    motion: RegionMotion, probability: np.ndarray, correlated: float
) -> tuple[np.ndarray, np.ndarray]:
    """Lasting error (R,) of each region's distance, and the remaining deviation (T, R), metres.

    The error is the mean distance in frames of likely contact, at most 3 standard deviations.
    Without such frames it is 0, with the stated deviation.

    Args:
        probability: (T, R) of contact.
        correlated: number of frames that are one measurement.
    """
    prior = np.median(motion.sigma, axis=0)
    # a frame's deviation beyond the usual one is no lasting error (a lost track)
    frame = SURFACE_SIGMA**2 + np.maximum(motion.sigma**2 - prior**2, 0.0)
    weight = np.maximum(0.0, 2 * probability - 1) / (frame * correlated)
    limit = 3.0 * prior
    variance = 1 / (prior**-2 + weight.sum(axis=0))
    error = variance * (weight * np.clip(motion.distance, -limit, limit)).sum(axis=0)
    return error, np.sqrt(variance + frame)


def _distance_evidence(distance: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Log odds (T, R) of distances: normal about the surface against uniform within 0.1 m.

    A region inside the object counts as distance 0: its depth is error. If ``sigma`` is large, both
    likelihoods are wide, and the log odds near zero. A touching region has an outlier as distance
    with probability 1 %. Both numbers are tuned on the studio.
    """
    free = np.log(0.10 + np.sqrt(2 * np.pi) * sigma)
    outside = np.maximum(distance, 0.0)
    touching = -0.5 * np.square(outside / sigma) - np.log(sigma * np.sqrt(2 * np.pi))
    return np.logaddexp(touching, np.log(0.01) - free) + free


def _motion_evidence(motion: RegionMotion, fps: float) -> np.ndarray:
    """Log odds (T, R) of the slip while the object moves faster than its jitter.

    The slip is half-normal: with the jitter's standard deviation if the region holds the object,
    with the object's speed if it is free. Jitter and limit are tuned on the studio.
    """
    jitter, limit = 0.12, 4.0  # m/s; log odds of one frame
    moving = motion.object_speed > jitter
    # central differences of independent errors of a position
    own = np.sqrt(np.maximum(motion.sigma**2 - LASTING_SIGMA**2, 0.0)) * fps / np.sqrt(2)
    own = np.hypot(jitter, own)
    spread = np.hypot(motion.object_speed, own)
    holding = -0.5 * np.square(motion.slip / own) - np.log(own)
    free = -0.5 * np.square(motion.slip / spread) - np.log(spread)
    return np.where(moving, np.clip(holding - free, -limit, limit), 0.0)
