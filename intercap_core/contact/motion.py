"""The observations of contact detection: each region's distance to the object and its slip."""

from __future__ import annotations

import numpy as np

from intercap_core.contact.constants import MIN_DISTANCE_SIGMA, NEAREST_VERTICES
from intercap_core.contact.detect import RegionMotion
from intercap_core.contact.patches import Patches
from intercap_core.energy.proximity import Proximity


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
    """Summarise the patches' vertices by region.

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
        order = np.argsort(near.distance[:, members], axis=1, kind="stable")[:, :NEAREST_VERTICES]
        nearest = members[order]  # (T, k)
        rows = np.arange(frames)[:, None]
        distance[:, r] = near.distance[rows, nearest].mean(axis=1)
        slip[:, r] = skin_speed[rows, nearest].mean(axis=1)
        speed[:, r] = surface_speed[rows, nearest].mean(axis=1)
        joint = joint_sigma[rows, patches.joint[nearest]].mean(axis=1)
        sigma[:, r] = np.sqrt(joint**2 + object_sigma**2 + MIN_DISTANCE_SIGMA**2)
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
