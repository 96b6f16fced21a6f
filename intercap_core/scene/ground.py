"""The floor plane: fitted to depth, annotated, stated by the user, or derived from feet."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from intercap_core.annotation import MIN_FLOOR_SPREAD_M, floor_spread
from intercap_core.errors import UserError
from intercap_core.geometry.camera.rig import Rig, ring_centre
from intercap_core.scene.up import UpDirection, degrees_between

# Height above the floor of the lowest foot keypoint (heel or toe) of a standing person, measured on
# the open body.
FOOT_HEIGHT_M = 0.014
# Least difference in height of two levels. Feet within half of it of a height stand on one level,
# and a point this far under a plane is evidence against the plane as the floor. Tuned on the
# studio: at 0.2 m, beams of 12 cm, stairs and platforms of 15 cm are taken for the floor.
LEVEL_M = 0.10
# Least number of sets with visible feet that form a level: the median of five tolerates two wrong
# detections.
MIN_FOOT_SETS = 5
# Cosine of the largest angle of a floor point's normal to the plane's, 20 degrees. Tuned on the
# studio.
FLOOR_COSINE = 0.94
MIN_FLOOR_AREA_M2 = 0.5  # least visible area of a floor: a square of 0.7 m; tuned on the studio


@dataclass(frozen=True, eq=False)
class GroundPlane:
    """Floor plane in the master's frame."""

    point: np.ndarray
    """(3,) any point of the plane, metres; NaN = no floor."""
    normal: np.ndarray
    """(3,) unit, upwards; NaN = no floor."""
    rms: float
    """Root mean square distance of the inliers, metres; NaN = none."""
    inliers: int
    """Number of background points within the tolerance; for "feet", number of sets; for "stated",
    0."""
    source: str
    """"fitted" to depth, "annotated", "stated" by the user, fitted to "feet", or "none"."""
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

    1. Up to 400 upward-facing points with their normals are plane hypotheses. Each is scored on
       6000 sampled points: inliers minus three times the points clearly below.
    2. The best hypothesis is refined by iterated weighted least squares.
    3. A platform may be larger than the visible floor around it. The search therefore continues to
       the lowest parallel plane that is large enough.

    Args:
        up: approximate up direction. Normals of hypotheses lie within its cone.
        tolerance_m: largest distance of inliers of the result, metres.
        cell_m: spacing of the points, metres; each stands for an area of its square.
    """
    cone = up.cone_deg
    facing = normals @ up.direction >= np.cos(np.radians(cone) + np.arccos(FLOOR_COSINE))
    # the floor is below the median camera
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
    inside = (np.abs(height) < 2 * tolerance_m).sum(0)  # hypotheses are not refined
    below = (height < -LEVEL_M).sum(0)
    # a point below the plane counts as much as three inliers; tuned on the studio
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
    """The lowest large plane below and parallel to ``ground``, or ``ground`` if there is none.

    Points (N, 3) with normals (N, 3) that face up. Each round looks for the densest layer, four
    tolerances thick, at least :data:`LEVEL_M` below the current plane, and refines a plane there.
    """
    upper = ground
    while True:
        facing = normals @ ground.normal >= FLOOR_COSINE
        height = (points - ground.point) @ ground.normal
        under = np.flatnonzero(facing & (height < -LEVEL_M))
        if len(under) * cell_m**2 < MIN_FLOOR_AREA_M2:
            break
        order = under[np.argsort(height[under])]
        reach = height[order] + 4 * tolerance_m
        count = np.searchsorted(height[order], reach, side="right") - np.arange(len(order))
        first = int(np.argmax(count))
        start = points[order[first : first + count[first]]].mean(0)
        lower = _refined(points, normals, start, ground.normal, tolerance_m)
        parallel = degrees_between(lower.normal, ground.normal) <= 3.0  # two level surfaces
        deep = (lower.point - ground.point) @ ground.normal < -LEVEL_M
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
    """Share of the lower plane's cells, 15 cm wide, above which the upper plane was measured too.

    A camera cannot look through a platform, so the share is small there. If a misplaced camera
    shows the one floor at two heights, the share is large.
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
    """Refine a plane (``point``, ``normal``) by weighted total least squares.

    Eight iterations; the largest distance of points that take part (gate) narrows from four
    tolerances to one. Weights are Tukey's biweight of the distance.
    """
    for gate in np.geomspace(4 * tolerance_m, tolerance_m, 8):
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

    Background ``points`` (N, 3) only provide the inlier count and the RMS distance.

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
    """Transform (4, 4) from the master's frame to one with z up, y along the master's view.

    The origin lies on the floor under the centre of the ring of cameras. Without a floor, z is the
    direction ``up_hint`` and the origin is the master camera.
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


def standing_on_floor(feet: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, str]:
    """Foot points (S, 3) that stand on the floor, and a note on other levels.

    The lowest foot point of each set is taken to stand. If feet stand on several levels (a beam,
    stairs), the lowest level with enough sets is the floor.

    Args:
        feet: (T, F, 3) heels and toes, master frame, metres; NaN = unknown.
        up: (3,) approximate up direction.
    """
    standing = _standing(feet, up)
    if len(standing) < MIN_FOOT_SETS:
        return standing[:0], ""
    sloping = _one_slope(standing, up) is not None
    inlier, note = _one_level(standing, up, sloping=sloping)
    return standing[inlier], note


def fit_ground_to_feet(feet: np.ndarray, up: UpDirection) -> GroundPlane:
    """Floor under standing feet, for scenes whose floor no camera measures.

    Its normal is ``up``. Its height is as accurate as the keypoints, one to two centimetres.
    ``feet``: see :func:`standing_on_floor`.
    """
    standing, note = standing_on_floor(feet, up.direction)
    if len(standing) < MIN_FOOT_SETS:
        return NO_GROUND
    point, normal = np.median(standing, 0), up.direction
    slope = _one_slope(_standing(feet, up.direction), up.direction)
    if up.source == "stated" and slope is not None:
        off = degrees_between(slope, normal)
        if off > 6.0:  # twice the accuracy of a tilt by feet
            odd = f"the plane of the standing feet is {off:.0f} degrees from the stated up"
            note = f"{note}; {odd}" if note else odd
    distance = (standing - point) @ normal
    point = point + (np.median(distance) - FOOT_HEIGHT_M) * normal
    rms = float(np.sqrt(np.mean((distance - np.median(distance)) ** 2)))
    return GroundPlane(point, normal, rms, len(standing), "feet", note)


def describe_raised_feet(feet: np.ndarray, ground: GroundPlane) -> str:
    """Report if the lowest foot point often lies 10 cm or more above or below ``ground``.

    Returns "" if not. ``feet``: (T, F, 3), metres; NaN = unknown.
    """
    standing = _standing(feet, ground.normal)
    if len(standing) < MIN_FOOT_SETS:
        return ""
    height = (standing - ground.point) @ ground.normal - FOOT_HEIGHT_M
    for off, side in (
        (height > LEVEL_M, "above"), (height < -LEVEL_M, "below"),
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

    The floor's level is the median height, or a lower one on which enough feet stand.

    ``sloping``: one tilted plane explains all feet, so they do not stand on several levels.
    """
    height = standing @ up
    middle = np.median(height)
    inlier = np.abs(height - middle) < LEVEL_M / 2
    need = _supporting(len(standing))
    above, below = height > middle + LEVEL_M / 2, height < middle - LEVEL_M / 2
    if max(above.sum(), below.sum()) < need or sloping:
        return inlier, ""
    if below.sum() >= need:
        middle = _lowest_level(height, need)
        inlier = np.abs(height - middle) < LEVEL_M / 2
        above = height > middle + LEVEL_M / 2
    return inlier, _levels(above, height - middle, "above") if above.sum() >= need else ""


def _lowest_level(height: np.ndarray, need: int) -> float:
    """Lowest level of the heights (S,), metres, if it is separate from the median, else the median.

    A level is the median of the lowest 10 cm interval with at least ``need`` heights. It is
    separate if the density of heights between it and the median falls below half of its own. Noise
    about a single level leaves no such gap.
    """
    order, middle = np.sort(height), float(np.median(height))
    ends = np.searchsorted(order, order + LEVEL_M, side="right")
    first = int(np.argmax(ends - np.arange(len(order)) >= need))
    level = float(np.median(order[first : ends[first]]))
    # number of heights within 2.5 cm of places every centimetre from the level up to the median
    between = np.arange(level, middle, LEVEL_M / 10)
    near = np.abs(height[:, None] - between) < LEVEL_M / 4
    count = near.sum(0)
    return level if len(count) and count.min() < 0.5 * count[0] else middle


def _levels(off: np.ndarray, height: np.ndarray, side: str) -> str:
    """Note on the sets ``off`` (S,) bool whose feet are ``height`` (S,) metres off the floor."""
    return (
        f"feet do not stand on one plane: in {100 * off.mean():.0f} % of the sets the lower one is "
        f"{np.median(height[off]):.2f} m {side} the floor (a beam, stairs, jumps)"
    )


def _supporting(count: int) -> int:
    """Least number of sets that form a level of their own, of ``count`` sets: 15 %."""
    return max(MIN_FOOT_SETS, int(np.ceil(0.15 * count)))


def _one_slope(standing: np.ndarray, up: np.ndarray) -> np.ndarray | None:
    """Normal (3,) of a plane through nearly all standing feet (S, 3).

    None if the feet are too close together, or no plane tilted by at most 15 degrees fits them.
    """
    kept = np.ones(len(standing), bool)
    for _ in range(5):
        normal = _normal_of(standing[kept], up)
        # a steeper plane fits feet on stairs: even low ones, 12 cm high and 40 cm deep, rise by 17
        if normal is None or degrees_between(normal, up) > 15.0:
            return None
        distance = (standing - standing[kept].mean(0)) @ normal
        kept = np.abs(distance - np.median(distance[kept])) < LEVEL_M / 2
        if kept.sum() < MIN_FOOT_SETS:
            return None
    return normal if (~kept).sum() < _supporting(len(standing)) else None


def _normal_of(standing: np.ndarray, up: np.ndarray) -> np.ndarray | None:
    """Unit normal (3,) of the plane through points (S, 3); None if they are all in one place.

    Points on a line determine one tilt only: the normal is then ``up`` made perpendicular to the
    line.
    """
    _, spread, axes = np.linalg.svd(standing - standing.mean(0), full_matrices=False)
    # standard deviations of at least 15 cm determine a tilt; tuned on the studio
    along, across = spread[:2] / np.sqrt(len(standing)) >= 0.15
    if not along:
        return None
    if not across:
        normal = up - (up @ axes[0]) * axes[0]
        return normal / np.linalg.norm(normal)
    return axes[2] * np.sign(axes[2] @ up)
