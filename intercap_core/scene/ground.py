"""The floor plane: fitted to depth, annotated, stated by the user, or derived from feet."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from intercap_core.annotation import MIN_FLOOR_SPREAD_M, floor_spread
from intercap_core.errors import UserError
from intercap_core.geometry.camera.rig import Rig, ring_centre
from intercap_core.scene.up import UpDirection, degrees_between

FOOT_HEIGHT_M = 0.014  # of the lowest keypoint of a foot, measured on the open body, standing
FOOT_TOLERANCE_M = 0.05  # feet that differ by more do not stand on one floor; tuned on the studio
MIN_FOOT_SPREAD_M = 0.15  # least standard deviation of feet that show a tilt; tuned on the studio
FLOOR_COSINE = 0.94  # 20 degrees: of a floor point's normal with the plane's; tuned on the studio
FLOOR_HYPOTHESIS_TOLERANCE_M = 0.03  # inliers of a hypothesis of the floor; tuned on the studio
BELOW_FLOOR_M = 0.10  # a point this far under the plane speaks against it; tuned on the studio
MIN_FLOOR_AREA_M2 = 0.5  # of visible floor; tuned on the studio
MIN_FOOT_SETS = 5  # sets with feet seen, for a floor; tuned on the studio


@dataclass(frozen=True, eq=False)
class GroundPlane:
    """Floor plane in the master's frame."""

    point: np.ndarray
    """(3,) metres; NaN = no floor."""
    normal: np.ndarray
    """(3,) unit, upwards; NaN = no floor."""
    rms: float
    """Root mean square distance of the inliers, metres; NaN = none."""
    inliers: int
    """Number of points, or of sets with a standing foot, within the tolerance."""
    source: str
    """"fitted", "annotated", "stated", "feet" or "none"."""
    note: str = ""
    """What is unusual about the floor; "" = nothing."""

    @property
    def found(self) -> bool:
        """Whether a floor is known."""
        return self.source != "none"


NO_GROUND = GroundPlane(np.full(3, np.nan), np.full(3, np.nan), float("nan"), 0, "none")


def fit_ground(
    points: np.ndarray,
    normals: np.ndarray,
    rig: Rig,
    up: UpDirection,
    *,
    tolerance_m: float,
    cell_m: float,
) -> GroundPlane:
    """Fit the floor to background points (N, 3) with normals (N, 3), master frame.

    The floor is the lowest large plane that faces up, below the cameras, with few points under it.
    Each point with its normal is a hypothesis; the best is refined by iterated weighted least
    squares. A platform may be larger than the visible floor around it: the lowest plane parallel
    to it that is large enough is the floor. ``cell_m``: spacing of the points, metres.
    """
    cone = up.cone_deg
    facing = normals @ up.direction >= np.cos(np.radians(cone) + np.arccos(FLOOR_COSINE))
    highest = np.median(rig.master_from_colour[:, :3, 3] @ up.direction)
    candidates = np.flatnonzero(facing & (points @ up.direction < highest))
    if not len(candidates):
        return NO_GROUND
    rng = np.random.default_rng(0)
    judging = min(len(points), 6000)
    sample = points[rng.choice(len(points), judging, replace=False)]
    tried = rng.choice(candidates, min(len(candidates), 400), replace=False)
    near_up = normals[tried] @ up.direction >= np.cos(np.radians(cone))
    tried = tried[near_up]
    if not len(tried):
        return NO_GROUND
    height = (sample @ normals[tried].T) - (points[tried] * normals[tried]).sum(1)
    inside = (np.abs(height) < FLOOR_HYPOTHESIS_TOLERANCE_M).sum(0)
    below = (height < -BELOW_FLOOR_M).sum(0)
    # a point below the plane outweighs three inliers; tuned on the studio
    best = tried[np.argmax(inside - 3.0 * below)]
    fitted = _refined(
        points[candidates], normals[candidates], points[best], normals[best], tolerance_m
    )
    if fitted.inliers * cell_m**2 < MIN_FLOOR_AREA_M2:
        return NO_GROUND
    return _lowest(points[candidates], normals[candidates], fitted, tolerance_m, cell_m)


def _lowest(
    points: np.ndarray, normals: np.ndarray, ground: GroundPlane, tolerance_m: float, cell_m: float
) -> GroundPlane:
    """The lowest large plane parallel to ``ground`` among points (N, 3) that face up, or itself."""
    upper = ground
    while True:
        facing = normals @ ground.normal >= FLOOR_COSINE
        height = (points - ground.point) @ ground.normal
        under = np.flatnonzero(facing & (height < -BELOW_FLOOR_M))
        if len(under) * cell_m**2 < MIN_FLOOR_AREA_M2:
            break
        order = under[np.argsort(height[under])]
        reach = height[order] + 2 * FLOOR_HYPOTHESIS_TOLERANCE_M
        count = np.searchsorted(height[order], reach, side="right") - np.arange(len(order))
        first = int(np.argmax(count))
        start = points[order[first : first + count[first]]].mean(0)
        lower = _refined(points, normals, start, ground.normal, tolerance_m)
        parallel = degrees_between(lower.normal, ground.normal) <= 3.0  # both are level
        deep = (lower.point - ground.point) @ ground.normal < -BELOW_FLOOR_M
        if lower.inliers * cell_m**2 < MIN_FLOOR_AREA_M2 or not (parallel and deep):
            break
        if _covered(points, lower, ground, tolerance_m) > 0.5:
            break  # the upper surface, seen by a misplaced camera
        ground = lower
    if ground is upper:
        return ground
    above = float((upper.point - ground.point) @ ground.normal)
    note = f"a larger level surface lies {above:.2f} m above the floor (a platform, or a table)"
    return replace(ground, note=note)


def _covered(
    points: np.ndarray, lower: GroundPlane, upper: GroundPlane, tolerance_m: float
) -> float:
    """Share of the lower plane, in cells of 15 cm, above which the upper one was measured.

    It is small under a platform, which no camera looks through, and large if a misplaced camera
    shows one floor a second time.
    """
    across = np.linalg.svd(upper.normal[None])[2][1:]

    def cells(plane: GroundPlane) -> set[tuple[int, ...]]:
        on = np.abs((points - plane.point) @ plane.normal) < tolerance_m
        flat = np.floor(points[on] @ across.T / 0.15).astype(int)
        return set(map(tuple, flat.tolist()))

    below = cells(lower)
    return len(below & cells(upper)) / max(1, len(below))


def _refined(
    points: np.ndarray,
    normals: np.ndarray,
    point: np.ndarray,
    normal: np.ndarray,
    tolerance_m: float,
) -> GroundPlane:
    """Weighted total least squares, with a gate that narrows from 6 cm to the tolerance."""
    for gate in np.geomspace(max(0.06, tolerance_m), tolerance_m, 8):
        distance = (points - point) @ normal
        weight = np.maximum(0, 1 - (distance / gate) ** 2) ** 2
        weight *= normals @ normal >= FLOOR_COSINE
        if (weight > 0).sum() < 10:
            return NO_GROUND
        point = (weight[:, None] * points).sum(0) / weight.sum()
        centred = points - point
        _, vectors = np.linalg.eigh((weight[:, None] * centred).T @ centred)
        normal = vectors[:, 0] * np.sign(vectors[:, 0] @ normal)
    distance = (points - point) @ normal
    inlier = (np.abs(distance) < tolerance_m) & (normals @ normal >= FLOOR_COSINE)
    rms = float(np.sqrt(np.mean(distance[inlier] ** 2))) if inlier.any() else float("nan")
    return GroundPlane(point, normal, rms, int(inlier.sum()), "fitted")


def annotated_ground(
    floor: np.ndarray, points: np.ndarray, up: UpDirection, *, tolerance_m: float
) -> GroundPlane:
    """Plane through annotated floor points (M, 3), M >= 3, master frame.

    Background ``points`` (N, 3) are only counted.

    Raises:
        UserError: the annotated points lie on one line. The message lacks the sequence.
    """
    point = floor.mean(0)
    axes = np.linalg.svd(floor - point, full_matrices=False)[2]
    if floor_spread(floor) < MIN_FLOOR_SPREAD_M:
        raise UserError(
            f"annotation floor: its {len(floor)} points lie on one line within "
            f"{MIN_FLOOR_SPREAD_M * 1000:.0f} mm; pick points that span the floor"
        )
    normal = axes[2] * np.sign(axes[2] @ up.direction)
    distance = (points - point) @ normal
    inlier = np.abs(distance) < tolerance_m
    rms = float(np.sqrt(np.mean(distance[inlier] ** 2))) if inlier.any() else float("nan")
    return GroundPlane(point, normal, rms, int(inlier.sum()), "annotated")


def stated_ground(up: np.ndarray, floor: np.ndarray) -> GroundPlane:
    """Floor stated by the user: ``up`` (3,) unit, and a point ``floor`` (3,), master frame."""
    return GroundPlane(floor, up, float("nan"), 0, "stated")


def zup_from_master(ground: GroundPlane, rig: Rig, up_hint: UpDirection) -> np.ndarray:
    """Transform (4, 4) to z up, with the origin on the floor under the ring's centre.

    y is the horizontal viewing direction of the master. Without a floor, up is ``up_hint`` and the
    origin is the master camera.
    """
    up, point = ground.normal, ground.point
    if not ground.found:
        up, point = up_hint.direction, np.zeros(3)
    ahead = np.array([0.0, 0, 1]) - up[2] * up
    if np.linalg.norm(ahead) < 0.1:  # the master looks straight down: take its image's up
        ahead = np.array([0.0, -1, 0]) + up[1] * up
    y = ahead / np.linalg.norm(ahead)
    rotation = np.stack([np.cross(y, up), y, up])
    middle = ring_centre(rig) if ground.found else np.zeros(3)
    origin = middle - ((middle - point) @ up) * up
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = rotation, -rotation @ origin
    return result


def fit_ground_to_feet(feet: np.ndarray, up: UpDirection) -> GroundPlane:
    """Floor under standing feet, for scenes whose floor no camera measures.

    ``feet``: (T, F, 3) heels and toes, NaN = unknown. The lowest foot point of each set stands. If
    feet stand on several levels (a beam, stairs), the lowest well supported level is the floor.
    The normal is measured gravity or a stated up. Without them it is fitted to the feet, in each
    direction in which they are spread enough: a walk along a line shows only the tilt along it. The
    height is as accurate as the keypoints, one to two centimetres.
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
        if off > 6.0:  # twice the accuracy of a tilt by feet
            odd = f"the plane of the standing feet is {off:.0f} degrees from the stated up"
            note = f"{note}; {odd}" if note else odd
    distance = (standing - point) @ normal
    point = point + (np.median(distance) - FOOT_HEIGHT_M) * normal
    rms = float(np.sqrt(np.mean((distance - np.median(distance)) ** 2)))
    return GroundPlane(point, normal, rms, len(standing), "feet", note)


def describe_raised_feet(feet: np.ndarray, ground: GroundPlane) -> str:
    """Report if the lower of the feet (T, F, 3) often stands above or below ``ground``; "" = no."""
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
    """Lowest foot point (S, 3) of each set with three or more known points."""
    known = np.isfinite(feet[..., 0]).sum(1) >= 3
    height = np.where(np.isfinite(feet[..., 0]), feet @ up, np.inf)[known]
    return feet[known][np.arange(known.sum()), height.argmin(1)]


def _one_level(standing: np.ndarray, up: np.ndarray, *, sloping: bool) -> tuple[np.ndarray, str]:
    """Mask (S,) of the standing feet (S, 3) on the floor's level, and a note on other levels.

    ``sloping``: one tilted plane explains them all, so there are no levels.
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
    """Lowest height around which ``need`` of the heights (S,) lie, with a gap above it.

    The median if there is no gap: noise about a single level has none.
    """
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
    """Least number of ``count`` sets in which feet form a level of their own."""
    return max(MIN_FOOT_SETS, int(np.ceil(0.15 * count)))


def _one_slope(standing: np.ndarray, up: np.ndarray) -> np.ndarray | None:
    """Normal (3,) of a slightly tilted plane that explains nearly all standing feet (S, 3), or
    None."""
    kept = np.ones(len(standing), bool)
    for _ in range(5):
        normal = _normal_of(standing[kept], up)
        # steeper feet stand on levels: even low stairs, 12 by 40 cm, rise by 17 degrees
        if normal is None or degrees_between(normal, up) > 15.0:
            return None
        distance = (standing - standing[kept].mean(0)) @ normal
        kept = np.abs(distance - np.median(distance[kept])) < FOOT_TOLERANCE_M
        if kept.sum() < MIN_FOOT_SETS:
            return None
    return normal if (~kept).sum() < _supporting(len(standing)) else None


def _normal_of(standing: np.ndarray, up: np.ndarray) -> np.ndarray | None:
    """Unit normal (3,) of the plane through points (S, 3); None if they are all in one place.

    Across points on a line, the normal is that of ``up``.
    """
    _, spread, axes = np.linalg.svd(standing - standing.mean(0), full_matrices=False)
    along, across = spread[:2] / np.sqrt(len(standing))
    if along < MIN_FOOT_SPREAD_M:
        return None
    if across < MIN_FOOT_SPREAD_M:
        normal = up - (up @ axes[0]) * axes[0]
        return normal / np.linalg.norm(normal)
    return axes[2] * np.sign(axes[2] @ up)
