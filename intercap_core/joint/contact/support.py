"""When something must hold the object: it is off the floor, moves and does not fall."""

from __future__ import annotations

import numpy as np

from intercap_core.joint.contact.constants import (
    FALL_TOLERANCE,
    LIFTED_HEIGHT,
    MOVING_SPEED,
    STANDARD_GRAVITY,
    UNHELD_PROBABILITY,
)


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
