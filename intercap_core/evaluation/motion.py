"""Motion of a track against the true motion: jitter, acceleration, lag, slip and planted feet.

A foot stands where enough of its true sole rests near the floor, or near the furniture under it. A
fit that froze all feet would have no error there, so swinging feet are measured too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from intercap_core.geometry.rigid.symmetry import SymmetryGroup

REFERENCE_FPS = 30.0
REST_SPEED = 0.02  # m/s: the true object rests below this ...
REST_TURN = np.radians(5.0)  # ... and below this, rad/s
ONSET_M = 0.010  # the object has started to move when it is this far from where it rested
MIN_REST_S = 0.2


def second_difference(positions: np.ndarray, fps: float) -> np.ndarray:
    """x[t+1] - 2 x[t] + x[t-1] of (T, ..., 3), scaled to 30 fps; NaN at both ends, metres.

    A second difference grows with the square of the frame's duration, so one at ``fps`` is
    multiplied by (fps / 30)^2.
    """
    result = np.full(positions.shape, np.nan)
    if len(positions) > 2:
        middle = positions[2:] - 2 * positions[1:-1] + positions[:-2]
        result[1:-1] = middle * (fps / REFERENCE_FPS) ** 2
    return result


def acceleration(positions: np.ndarray, fps: float) -> np.ndarray:
    """Mean length (T,) of the second differences of points (T, N, 3), metres a frame^2."""
    return np.linalg.norm(second_difference(positions, fps), axis=-1).mean(-1)


def acceleration_error(positions: np.ndarray, true: np.ndarray, fps: float) -> np.ndarray:
    """Mean length (T,) of the difference of second differences of (T, N, 3), as above."""
    return acceleration(np.asarray(positions, np.float64) - true, fps)


def moving(rotation: np.ndarray, centre: np.ndarray, fps: float) -> np.ndarray:
    """Frames (T,) in which a true object moves, from (T, 3, 3) and (T, 3).

    A frame moves when the step before or after it is faster than 20 mm/s or 5 degrees/s.
    """
    result = np.zeros(len(centre), bool)
    speed = np.linalg.norm(np.diff(centre, axis=0), axis=-1) * fps
    chord = np.linalg.norm(np.diff(rotation, axis=0), axis=(-1, -2)) / (2 * np.sqrt(2))
    turn = 2 * np.arcsin(np.clip(chord, 0, 1)) * fps
    step = (speed > REST_SPEED) | (turn > REST_TURN)
    result[:-1] |= step
    result[1:] |= step
    return result


def resting_steps(is_moving: np.ndarray) -> np.ndarray:
    """Steps (T-1,) between frames (T,) over which the true object rests."""
    return ~is_moving[1:] & ~is_moving[:-1]


def steps(centre: np.ndarray, true_centre: np.ndarray) -> np.ndarray:
    """Length (T-1,) of the track's steps beyond the true ones, metres; both (T, 3)."""
    return np.linalg.norm(np.diff(centre - true_centre, axis=0), axis=-1)


def turns(rotation: np.ndarray, true_rotation: np.ndarray, symmetry: SymmetryGroup) -> np.ndarray:
    """Angle (T-1,) of the track's turns beyond the true ones, degrees; both (T, 3, 3).

    Each rotation is taken as the equivalent one that is nearest to the rotation before it.
    """
    nearest = symmetry.nearest_equivalent(rotation[1:], rotation[:-1])
    turned = nearest @ np.swapaxes(rotation[:-1], -1, -2)
    truly = true_rotation[1:] @ np.swapaxes(true_rotation[:-1], -1, -2)
    return SymmetryGroup.none().rotation_error_deg(turned, truly)


def motion_onset_lags(
    centre: np.ndarray,
    true_centre: np.ndarray,
    is_moving: np.ndarray,
    fps: float,
) -> list[float]:
    """Frames by which the track is late each time the object starts to move (negative: early).

    For each rest of at least 0.2 s that ends in motion: the frame at which the track is 10 mm from
    its own mean position during that rest, minus the same for the truth. A track that does not
    start before the true motion is over counts the motion's length.
    """
    lags: list[float] = []
    start = 0
    total = len(is_moving)
    while start < total:
        end = start
        while end < total and is_moving[end] == is_moving[start]:
            end += 1
        rested = not is_moving[start] and end < total and end - start >= max(2, MIN_REST_S * fps)
        if rested:
            over = end
            while over < total and is_moving[over]:
                over += 1
            found, true = (_leaves(path[start:over], end - start) for path in (centre, true_centre))
            if true is not None:
                lags.append(float((over - start if found is None else found) - true))
        start = end
    return lags


def _leaves(path: np.ndarray, rest: int) -> int | None:
    """First frame at which a path (N, 3) is ``ONSET_M`` from the mean of its first ``rest``."""
    away = np.linalg.norm(path - path[:rest].mean(0), axis=-1) > ONSET_M
    away[: max(1, rest // 2)] = False  # jitter at the start of the rest is no motion
    return int(np.argmax(away)) if away.any() else None


# Between the two moments that a velocity is taken from: noise from frame to frame is no slip.
SLIP_S = 0.2


def slip_speed(
    local: np.ndarray,
    true_local: np.ndarray,
    touching: np.ndarray,
    normals_at: Callable[[np.ndarray], np.ndarray],
    fps: float,
) -> np.ndarray:
    """Speed (T,) at which fitted skin slides over the fitted object, beyond the true one, m/s.

    Of skin vertices in the object's own frame, fitted ``local`` and ``true_local`` (T, V, 3), over
    those ``touching`` (T, V) truly both in the frame and :data:`SLIP_S` later: the mean norm of the
    difference of both velocities along the surface, of which ``normals_at`` gives the unit normals
    (N, 3) nearest to true points (N, 3). NaN where no vertex touches at both ends.
    """
    total = len(local)
    found = np.full(total, np.nan)
    window = max(1, round(SLIP_S * fps))
    for t in range(total - window):
        held = np.flatnonzero(touching[t] & touching[t + window])
        if not len(held):
            continue
        moved, truly = (
            points[t + window, held].astype(np.float64) - points[t, held]
            for points in (local, true_local)
        )
        excess = (moved - truly) * (fps / window)
        normal = normals_at(true_local[t, held].astype(np.float64))
        along = excess - (excess * normal).sum(1, keepdims=True) * normal
        found[t] = np.linalg.norm(along, axis=1).mean()
    return found


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
