"""Keypoints brought from the moment a camera exposes to the time of the frame set."""

from __future__ import annotations

import numpy as np

from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.solve.velocity import limited_velocity
from intercap_core.person.constants import MAX_IMAGE_SPEED_RAD_S


def at_set_times(
    keypoints: np.ndarray,
    times: np.ndarray,
    time_offset: np.ndarray,
    rig: Rig,
    *,
    min_confidence: float,
) -> np.ndarray:
    """Keypoints (T, C, K, 3) as they would be had every camera exposed at ``times`` (T,).

    ``keypoints`` (T, C, K, 3) x, y, confidence as exposed, ``time_offset`` (C,) seconds later.
    Moved by the velocity in the image, from neighbouring sets and limited where one of them jumps.
    """
    result = keypoints.copy()
    known = keypoints[..., 2] >= min_confidence
    for c in np.flatnonzero(time_offset):
        speed = MAX_IMAGE_SPEED_RAD_S * rig[int(c)].colour.fx
        seen = keypoints[:, c, :, :2]
        velocity = limited_velocity(seen, times, max_speed=speed, known=known[:, c])
        result[:, c, :, :2] = seen - time_offset[c] * velocity
    return result
