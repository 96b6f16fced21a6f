"""The floor that someone stands on, and feet that do not stand on it."""

from __future__ import annotations

import numpy as np

from intercap_core.scene.constants import (
    FEET_TILT_DEG,
    FOOT_HEIGHT_M,
    FOOT_TOLERANCE_M,
    LEVEL_SHARE,
    MAX_SLOPE_DEG,
    MIN_FOOT_SETS,
    MIN_FOOT_SPREAD_M,
)
from intercap_core.scene.ground import NO_GROUND, Ground
from intercap_core.scene.up import Up, degrees_between


def ground_of_feet(feet: np.ndarray, up: Up) -> Ground:
    """The floor that someone stands on: from heels and toes (T, F, 3), NaN = not known.

    In each set the lowest of the feet stands, in most of them on the floor; where they stand on
    several levels (a beam, stairs) the lowest that is well supported is the floor. Measured gravity
    or a stated up gives the normal; without them the feet do, as far as they have been apart: who
    walks along a line shows the tilt along it, and across it the cameras' own up stands. For
    scenes whose floor no camera measures; its height is as good as the keypoints, a centimetre or
    two.
    """
    standing = _standing(feet, up.direction)
    if len(standing) < MIN_FOOT_SETS:
        return NO_GROUND
    slope = _one_slope(standing, up.direction)
    inlier, note = _one_level(standing, up.direction, sloping=slope is not None)
    standing = standing[inlier]
    if len(standing) < MIN_FOOT_SETS:
        return NO_GROUND
    point, normal = np.median(standing, 0), up.direction
    if up.source == "cameras":
        own = _normal_of(standing, up.direction)
        if own is None:
            return NO_GROUND
        point, normal = standing.mean(0), own
    elif up.source == "stated" and slope is not None:
        off = degrees_between(slope, normal)
        if off > FEET_TILT_DEG:
            odd = f"the plane of the standing feet is {off:.0f} degrees from the stated up"
            note = f"{note}; {odd}" if note else odd
    distance = (standing - point) @ normal
    point = point + (np.median(distance) - FOOT_HEIGHT_M) * normal
    rms = float(np.sqrt(np.mean((distance - np.median(distance)) ** 2)))
    return Ground(point, normal, rms, len(standing), "feet", note)


def feet_off_the_floor(feet: np.ndarray, ground: Ground) -> str:
    """Say, "" = nothing, where the lower of the feet (T, F, 3) often stands above ``ground``, or
    below it."""
    standing = _standing(feet, ground.normal)
    if len(standing) < MIN_FOOT_SETS:
        return ""
    height = (standing - ground.point) @ ground.normal - FOOT_HEIGHT_M
    for off, side in (
        (height > 2 * FOOT_TOLERANCE_M, "above"), (height < -2 * FOOT_TOLERANCE_M, "below"),
    ):  # fmt: skip
        if off.sum() >= _supporting(len(standing)):
            return _levels(off, np.abs(height), side)
    return ""


def _standing(feet: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(S, 3): the lowest foot point of each set in which three or more are known."""
    known = np.isfinite(feet[..., 0]).sum(1) >= 3
    height = np.where(np.isfinite(feet[..., 0]), feet @ up, np.inf)[known]
    return feet[known][np.arange(known.sum()), height.argmin(1)]


def _one_level(standing: np.ndarray, up: np.ndarray, *, sloping: bool) -> tuple[np.ndarray, str]:
    """Which of the standing feet (S, 3) are on one level, the floor: (S,) bool, and a note.

    ``sloping``: one plane holds them all, be ``up`` tilted or the floor.
    """
    height = standing @ up
    middle = np.median(height)
    inlier = np.abs(height - middle) < FOOT_TOLERANCE_M
    need = _supporting(len(standing))
    above, below = height > middle + FOOT_TOLERANCE_M, height < middle - FOOT_TOLERANCE_M
    if max(above.sum(), below.sum()) < need or sloping:
        return inlier, ""
    if below.sum() >= need:
        middle = _lowest_level(height, need)
        inlier = np.abs(height - middle) < FOOT_TOLERANCE_M
        above = height > middle + FOOT_TOLERANCE_M
    return inlier, _levels(above, height - middle, "above") if above.sum() >= need else ""


def _lowest_level(height: np.ndarray, need: int) -> float:
    """The lowest of the heights (S,) about which ``need`` of them lie and above which few do; their
    median where there is none such: noise about one level has no gap below it."""
    order, middle = np.sort(height), float(np.median(height))
    ends = np.searchsorted(order, order + 2 * FOOT_TOLERANCE_M, side="right")
    first = int(np.argmax(ends - np.arange(len(order)) >= need))
    level = float(np.median(order[first : ends[first]]))
    between = np.arange(level, middle, 0.2 * FOOT_TOLERANCE_M)
    near = np.abs(height[:, None] - between) < 0.5 * FOOT_TOLERANCE_M
    count = near.sum(0)
    return level if len(count) and count.min() < 0.5 * count[0] else middle


def _levels(off: np.ndarray, height: np.ndarray, side: str) -> str:
    return (
        f"feet do not stand on one plane: in {100 * off.mean():.0f} % of the sets the lower one is "
        f"{np.median(height[off]):.2f} m {side} the floor (a beam, stairs, jumps)"
    )


def _supporting(count: int) -> int:
    return max(MIN_FOOT_SETS, int(np.ceil(LEVEL_SHARE * count)))


def _one_slope(standing: np.ndarray, up: np.ndarray) -> np.ndarray | None:
    """Normal (3,) of the one plane, little tilted, that explains nearly all of the standing feet
    (S, 3); None where there is no such plane."""
    kept = np.ones(len(standing), bool)
    for _ in range(5):
        normal = _normal_of(standing[kept], up)
        if normal is None or degrees_between(normal, up) > MAX_SLOPE_DEG:
            return None
        distance = (standing - standing[kept].mean(0)) @ normal
        kept = np.abs(distance - np.median(distance[kept])) < FOOT_TOLERANCE_M
        if kept.sum() < MIN_FOOT_SETS:
            return None
    return normal if (~kept).sum() < _supporting(len(standing)) else None


def _normal_of(standing: np.ndarray, up: np.ndarray) -> np.ndarray | None:
    """Unit normal (3,) of the plane through points (S, 3), across a line that of ``up``; None
    where they are all in one place."""
    _, spread, axes = np.linalg.svd(standing - standing.mean(0), full_matrices=False)
    along, across = spread[:2] / np.sqrt(len(standing))
    if along < MIN_FOOT_SPREAD_M:
        return None
    if across < MIN_FOOT_SPREAD_M:
        normal = up - (up @ axes[0]) * axes[0]
        return normal / np.linalg.norm(normal)
    return axes[2] * np.sign(axes[2] @ up)
