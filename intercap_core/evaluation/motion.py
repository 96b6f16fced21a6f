"""Motion of a track against the true motion: jitter, acceleration, lag, slip and planted feet.

A foot carries weight if enough of its true sole is near the floor or the furniture under it, and at
rest. Speed and height of such soles are errors. The position of swinging feet is measured too: a
fit whose feet never move would otherwise seem perfect.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from intercap_core.geometry.rigid.symmetry import SymmetryGroup
from intercap_core.geometry.solve.time_series import runs


def acceleration(positions: np.ndarray, fps: float) -> np.ndarray:
    """Mean length (T,) of the second differences x[t+1] - 2 x[t] + x[t-1] of N points (T, N, 3).

    NaN at both ends. The unit is metres per frame^2 at 30 fps: a second difference grows with the
    square of the frame's duration, so the one at ``fps`` is multiplied by (fps / 30)^2.
    """
    change = np.full(positions.shape, np.nan)
    if len(positions) > 2:
        middle = positions[2:] - 2 * positions[1:-1] + positions[:-2]
        change[1:-1] = middle * (fps / 30.0) ** 2
    return np.linalg.norm(change, axis=-1).mean(-1)


def acceleration_error(positions: np.ndarray, true: np.ndarray, fps: float) -> np.ndarray:
    """Mean length (T,) of the second differences of the position errors, metres per frame^2.

    ``positions``, ``true``: (T, N, 3).
    """
    return acceleration(np.asarray(positions, np.float64) - true, fps)


def moving(rotation: np.ndarray, centre: np.ndarray, fps: float) -> np.ndarray:
    """Mask (T,) of the frames in which the true object moves.

    A frame counts if the step from the frame before or to the next one is faster than 20 mm/s or
    5 degrees/s.

    Args:
        rotation: (T, 3, 3) true rotations.
        centre: (T, 3) true centre of mass, metres.
    """
    result = np.zeros(len(centre), bool)
    speed = np.linalg.norm(np.diff(centre, axis=0), axis=-1) * fps
    chord = np.linalg.norm(np.diff(rotation, axis=0), axis=(-1, -2)) / (2 * np.sqrt(2))
    turn = 2 * np.arcsin(np.clip(chord, 0, 1)) * fps
    step = (speed > 0.02) | (turn > np.radians(5.0))
    result[:-1] |= step
    result[1:] |= step
    return result


def resting_steps(is_moving: np.ndarray) -> np.ndarray:
    """Mask (T-1,) of the steps between frames (T,) during which the true object rests."""
    return ~is_moving[1:] & ~is_moving[:-1]


def steps(centre: np.ndarray, true_centre: np.ndarray) -> np.ndarray:
    """Length (T-1,) of the error of the track's displacement from frame to frame, metres.

    ``centre``, ``true_centre``: (T, 3).
    """
    return np.linalg.norm(np.diff(centre - true_centre, axis=0), axis=-1)


def turns(rotation: np.ndarray, true_rotation: np.ndarray, symmetry: SymmetryGroup) -> np.ndarray:
    """Angle (T-1,) between the track's and the true frame-to-frame rotations, degrees.

    Both rotations are (T, 3, 3). Each tracked rotation is replaced by the equivalent rotation of
    the symmetry group that is nearest to the rotation before it.
    """
    nearest = symmetry.nearest_equivalent(rotation[1:], rotation[:-1])
    turned = nearest @ np.swapaxes(rotation[:-1], -1, -2)
    truly = true_rotation[1:] @ np.swapaxes(true_rotation[:-1], -1, -2)
    return SymmetryGroup.none().rotation_error_deg(turned, truly)


def motion_onset_lags(
    centre: np.ndarray, true_centre: np.ndarray, is_moving: np.ndarray, fps: float
) -> list[float]:
    """Delay of the track, in frames, each time the true object starts to move; negative = early.

    Evaluated for each true rest of at least 0.2 s that ends in motion. The onset is the first frame
    in which a path is 10 mm from its own mean position during that rest. The delay is the onset of
    the track minus that of the truth. If the track has no onset before the true motion ends, the
    end of the motion is taken as its onset.

    Args:
        centre, true_centre: (T, 3) metres.
        is_moving: (T,) mask of true motion.
        fps: frames per second.
    """
    lags: list[float] = []
    motions = {first: last + 1 for first, last in runs(is_moving)}
    for start, last in runs(~is_moving):
        rest, over = last + 1 - start, motions.get(last + 1)
        if over is None or rest < max(2, 0.2 * fps):
            continue
        fitted, true = (_onset(path[start:over], rest) for path in (centre, true_centre))
        if true is not None:
            lags.append(float((over - start if fitted is None else fitted) - true))
    return lags


def _onset(path: np.ndarray, rest: int) -> int | None:
    """First frame at which a path (N, 3) is 10 mm from the mean of its first ``rest`` frames."""
    away = np.linalg.norm(path - path[:rest].mean(0), axis=-1) > 0.010
    away[: max(1, rest // 2)] = False  # deviations in the first half of the rest are jitter
    return int(np.argmax(away)) if away.any() else None


# Time between the two positions from which a slip velocity is computed, seconds: long enough that
# noise between consecutive frames does not count as slip.
SLIP_S = 0.2


def slip_speed(
    local: np.ndarray,
    true_local: np.ndarray,
    touching: np.ndarray,
    normals_at: Callable[[np.ndarray], np.ndarray],
    fps: float,
) -> np.ndarray:
    """Speed (T,) at which fitted skin slides over the fitted object beyond the true slip, m/s.

    It is the mean length, over touching vertices, of the tangential part of fitted minus true
    velocity in the object's frame. Velocities are displacements over :data:`SLIP_S`. NaN if no
    vertex touches in both the frame and :data:`SLIP_S` later.

    Args:
        local: (T, V, 3) fitted skin vertices in the fitted object's frame, metres.
        true_local: (T, V, 3) the same vertices of the true body in the true object's frame.
        touching: (T, V) mask of vertices in true contact.
        normals_at: returns the unit normals (N, 3) of the true surface nearest to points (N, 3).
    """
    total = len(local)
    found = np.full(total, np.nan)
    window = max(1, round(SLIP_S * fps))
    for t in range(total - window):
        both = np.flatnonzero(touching[t] & touching[t + window])
        if not len(both):
            continue
        moved, truly = (
            points[t + window, both].astype(np.float64) - points[t, both]
            for points in (local, true_local)
        )
        excess = (moved - truly) * (fps / window)
        normal = normals_at(true_local[t, both].astype(np.float64))
        along = excess - (excess * normal).sum(1, keepdims=True) * normal
        found[t] = np.linalg.norm(along, axis=1).mean()
    return found


@dataclass(frozen=True)
class Floor:
    """The plane normal . x + offset = 0."""

    normal: np.ndarray
    """(3,) unit, pointing up."""
    offset: float
    """Metres."""

    def height(self, points: np.ndarray) -> np.ndarray:
        """Height (...) of points (..., 3) above the floor, metres."""
        return points @ self.normal + self.offset

    def along(self, vectors: np.ndarray) -> np.ndarray:
        """Component of vectors (..., 3) parallel to the floor."""
        return vectors - (vectors @ self.normal)[..., None] * self.normal


def support(
    true_sole: np.ndarray, floor: Floor, fps: float, level: np.ndarray | None = None
) -> np.ndarray:
    """Mask (T - 1, S) of the sole vertices that carry weight from one frame to the next.

    A vertex carries weight if it is lower than 15 mm and slower than 50 mm/s. The foot stands if at
    least a tenth of its vertices carry weight, so toes or a heel suffice. The mask is False while
    the foot does not stand.

    Args:
        true_sole: (T, S, 3) vertices of a true sole, metres.
        level: (T,) height above the floor of the surface under the sole, metres; None = the floor.
    """
    above = floor.height(true_sole) if level is None else floor.height(true_sole) - level[:, None]
    low = above < 0.015
    speed = np.linalg.norm(np.diff(true_sole, axis=0), axis=-1) * fps
    carrying = low[1:] & low[:-1] & (speed < 0.05)
    carrying[carrying.mean(1) < 0.1] = False
    return carrying


@dataclass(frozen=True)
class FootErrors:
    """Errors of one foot between consecutive frames; NaN if they are not defined."""

    speed: np.ndarray
    """(T - 1,) speed along the floor of the vertices that carry weight, m/s."""
    height: np.ndarray
    """(T - 1,) mean height error of the vertices that carry weight, metres."""
    swing: np.ndarray
    """(T - 1,) mean distance of the sole from the true sole while no vertex carries weight,
    metres."""


def foot_errors(
    sole: np.ndarray, true_sole: np.ndarray, carrying: np.ndarray, floor: Floor, fps: float
) -> FootErrors:
    """Errors of a fitted sole (T, S, 3); ``carrying`` (T - 1, S) is from :func:`support`."""
    speed = np.linalg.norm(floor.along(np.diff(sole, axis=0)), axis=-1) * fps
    away = (sole - true_sole)[1:]
    swing = np.linalg.norm(away, axis=-1).mean(1)
    swing[carrying.any(1)] = np.nan
    return FootErrors(
        _masked_mean(speed, carrying), _masked_mean(np.abs(away @ floor.normal), carrying), swing
    )


def _masked_mean(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Means (T,) of the values (T, S) within ``mask``; NaN if the mask is empty."""
    number = mask.sum(1)
    total = np.where(mask, values, 0.0).sum(1)
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)
