"""The observations of contact detection: each region's distance to the object and its slip."""

from __future__ import annotations

import numpy as np

from intercap_core.joint.contact.constants import LASTING_SIGMA, SOFT_MINIMUM
from intercap_core.joint.contact.detect import RegionMotion
from intercap_core.joint.contact.patches import Patches
from intercap_core.joint.proximity import Proximity


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
