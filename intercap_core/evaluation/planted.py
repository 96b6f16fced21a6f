"""Feet: how still and how high those stand that truly stand, and how well the others are followed.

A foot stands where enough of its sole truly rests near the floor, or the furniture under it. What
truly carries it has to stay where it is; a fit that froze the feet would pass that, so that
swinging feet and the lag with which a foot lifts are measured beside it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Of a sole vertex that carries weight: height above the floor, and speed, of the truth.
SUPPORT_HEIGHT_M, SUPPORT_SPEED_M_S = 0.015, 0.05
STANDING_SHARE = 0.1  # of a sole's vertices that rest so: toes or a heel alone are a stand too


@dataclass(frozen=True)
class Floor:
    """The plane normal . x + offset = 0: ``normal`` (3,) unit and up, ``offset`` metres."""

    normal: np.ndarray
    offset: float

    def height(self, points: np.ndarray) -> np.ndarray:
        """Of points (..., 3) above the floor, metres."""
        return points @ self.normal + self.offset

    def along(self, vectors: np.ndarray) -> np.ndarray:
        """The part of vectors (..., 3) that lies in the floor."""
        return vectors - (vectors @ self.normal)[..., None] * self.normal


def support(
    true_sole: np.ndarray, floor: Floor, fps: float, level: np.ndarray | None = None
) -> np.ndarray:
    """Vertices of a true sole (T, S, 3) that carry weight from a frame to the next: (T - 1, S).

    ``level`` (T,) is how high above the floor what is under it lies, metres, None = it is the
    floor. No vertices of a foot that does not stand.
    """
    above = floor.height(true_sole) if level is None else floor.height(true_sole) - level[:, None]
    low = above < SUPPORT_HEIGHT_M
    speed = np.linalg.norm(np.diff(true_sole, axis=0), axis=-1) * fps
    carrying = low[1:] & low[:-1] & (speed < SUPPORT_SPEED_M_S)
    carrying[carrying.mean(1) < STANDING_SHARE] = False
    return carrying


@dataclass(frozen=True)
class FootErrors:
    """Of one foot, metres and m/s, NaN where there is nothing to measure. Of what carries it
    ``speed`` (T - 1,) along the floor and ``height`` (T - 1,), the mean distance from the true
    height; ``swing`` (T - 1,), the mean distance of all of the sole from the true one where it does
    not stand."""

    speed: np.ndarray
    height: np.ndarray
    swing: np.ndarray


def foot_errors(
    sole: np.ndarray, true_sole: np.ndarray, carrying: np.ndarray, floor: Floor, fps: float
) -> FootErrors:
    """Errors of a fitted sole (T, S, 3), ``carrying`` (T - 1, S) as of :func:`support`."""
    speed = np.linalg.norm(floor.along(np.diff(sole, axis=0)), axis=-1) * fps
    away = (sole - true_sole)[1:]
    swing = np.linalg.norm(away, axis=-1).mean(1)
    swing[carrying.any(1)] = np.nan
    return FootErrors(_mean(speed, carrying), _mean(np.abs(away @ floor.normal), carrying), swing)


def _mean(values: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """Means (T,) of the values (T, S) that are ``counted``; NaN where none is."""
    number = counted.sum(1)
    total = np.where(counted, values, 0.0).sum(1)
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)
