"""Support test: what carries the object in each frame.

The acceleration that a support must give the object is a - g, of its centre of mass with the
acceleration a. In free fall it is 0, at rest 9.81 m/s^2 upward. A frame is *unsupported* if the
object needs a support and there is none: no body, no floor and no furniture near it. "Near" and
"apart" have different limits, so that a frame between them is *not determined*.

A person in the scene, a rope or a shelf that no camera shows can carry an object too. If the images
confirm the pose, an unsupported frame is no evidence against it: the object is then *held by
something unknown*, which is reported and not judged.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from intercap_core.evaluation.physics.rest_test import GRAVITY
from intercap_core.geometry.solve.time_series import runs
from intercap_core.schemas import CONTACT_M

# Half-width of the window of a fitted parabola, seconds. A position error of 3 mm gives an error of
# 0.2 m/s^2 at 15 frames per second.
WINDOW_S = 0.2
# Distance, metres, beyond which body and object are apart although both poses are in error: twice
# the mean error of a hand that holds an object (bench/RESULTS.md, `hand_grasp_mpjpe_mm`).
APART_M = 0.05
SIGMAS = 3.0  # deviations of a significant difference
HELD_S = 0.5  # shortest time in which the object is reported as held by something unknown, seconds


class Carrier(StrEnum):
    """What carries the object in a frame."""

    BODY = "body"
    FLOOR = "floor"
    FURNITURE = "furniture"
    NOTHING = "free fall"
    UNSUPPORTED = "unsupported"
    UNKNOWN = "held by something unknown"
    UNDETERMINED = "not determined"


def support_acceleration(
    height: np.ndarray, sigma: np.ndarray, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Upward acceleration (T,) that a support must give, and its standard deviation (T,), m/s^2.

    The second derivative of a parabola fitted to the heights within ``WINDOW_S``, plus g. NaN in
    frames with fewer than two frames on either side in the window.

    Args:
        height: (T,) of the centre of mass, metres; NaN = unknown.
        sigma: (T,) standard deviation of each height, metres.
        times: (T,) seconds.
    """
    value, deviation = np.full(len(height), np.nan), np.full(len(height), np.nan)
    known = np.isfinite(height) & np.isfinite(sigma)
    for t in np.flatnonzero(known):
        window = np.flatnonzero(known & (np.abs(times - times[t]) <= WINDOW_S + 1e-6))
        if (window < t).sum() < 2 or (window > t).sum() < 2:
            continue
        since = times[window] - times[t]
        design = np.stack([np.ones_like(since), since, since**2 / 2], axis=1)
        rows = np.linalg.pinv(design)[2]
        value[t] = rows @ height[window] + GRAVITY
        deviation[t] = np.sqrt((rows**2) @ sigma[window] ** 2)
    return value, deviation


@dataclass(frozen=True, eq=False)
class Distances:
    """Distances (T,) of the object to its possible carriers, metres; NaN = unknown."""

    body: np.ndarray
    """To the skin."""
    floor: np.ndarray
    """Height of the lowest point above the floor."""
    furniture: np.ndarray
    """To the nearest static surface."""
    sigma: np.ndarray
    """Standard deviation of the object's position along one axis."""
    touched: np.ndarray
    """(T,) bool: the joint fit states contact with the body."""
    body_known: np.ndarray
    """(T,) bool: body and hands are determined by the images."""


def find_carriers(
    distances: Distances,
    acceleration: np.ndarray,
    acceleration_sigma: np.ndarray,
    confirmed: np.ndarray,
    times: np.ndarray,
) -> np.ndarray:
    """Carrier (T,) of each frame, as the text of :class:`Carrier`.

    Args:
        acceleration, acceleration_sigma: (T,) from :func:`support_acceleration`.
        confirmed: (T,) bool, the images confirm the object's pose.
        times: (T,) seconds.
    """
    near = CONTACT_M + 2 * distances.sigma
    apart = APART_M + SIGMAS * distances.sigma
    needed = acceleration - SIGMAS * acceleration_sigma > GRAVITY / 2
    falling = acceleration + SIGMAS * acceleration_sigma < GRAVITY / 2
    alone = (
        (distances.body > apart)
        & ~distances.touched
        & distances.body_known
        & (distances.floor > apart)
        & (distances.furniture > apart)
    )
    found = np.full(len(times), str(Carrier.UNDETERMINED), object)
    found[falling] = str(Carrier.NOTHING)
    found[needed & alone] = str(Carrier.UNSUPPORTED)
    found[distances.furniture <= near] = str(Carrier.FURNITURE)
    found[distances.floor <= near] = str(Carrier.FLOOR)
    found[(distances.body <= near) | distances.touched] = str(Carrier.BODY)
    unsupported = found == Carrier.UNSUPPORTED
    found[unsupported & confirmed] = str(Carrier.UNDETERMINED)
    for first, last in runs(unsupported & confirmed):
        if times[last] - times[first] >= HELD_S:
            found[first : last + 1] = str(Carrier.UNKNOWN)
    return found
