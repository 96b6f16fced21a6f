"""Smoothness and lag of a track over time."""

from __future__ import annotations

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
