"""The floor: a plane through what all cameras see, or through annotated points."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from intercap_core.config import MIN_FLOOR_SPREAD_M, floor_spread
from intercap_core.errors import UserError
from intercap_core.geometry.camera.rig import Rig, ring_centre
from intercap_core.scene.constants import (
    BELOW_FLOOR_COST,
    BELOW_FLOOR_M,
    COVER_CELL_M,
    FLOOR_COSINE,
    FLOOR_FIRST_GATE_M,
    FLOOR_HYPOTHESES,
    FLOOR_HYPOTHESIS_POINTS,
    FLOOR_HYPOTHESIS_TOLERANCE_M,
    FLOOR_REFINE_STEPS,
    LOWER_FLOOR_DEG,
    MAX_COVERED_SHARE,
    MIN_FLOOR_AREA_M2,
)
from intercap_core.scene.up import Up, degrees_between


@dataclass(frozen=True, eq=False)
class Ground:
    """``point`` (3,) and unit ``normal`` (3,), up, master frame; ``rms`` metres over the
    ``inliers`` points, or sets in which someone stands, within the tolerance; NaN and 0 where
    there is no floor. ``note``: what is odd about it, in words, "" = nothing."""

    point: np.ndarray
    normal: np.ndarray
    rms: float
    inliers: int
    source: str
    note: str = ""

    @property
    def found(self) -> bool:
        """Whether a floor is known."""
        return self.source != "none"


NO_GROUND = Ground(np.full(3, np.nan), np.full(3, np.nan), float("nan"), 0, "none")


def fit_ground(
    points: np.ndarray,
    normals: np.ndarray,
    rig: Rig,
    up: Up,
    *,
    tolerance_m: float,
    cell_m: float,
) -> Ground:
    """Fit the floor to background points (N, 3) with normals (N, 3), master frame, spaced by
    ``cell_m``: the lowest large plane that faces up, below the cameras, with little under it.

    Every point with its normal is a hypothesis (so one point gives a plane); the best is refined
    by iterated weighted least squares. A platform may be larger than the floor that is seen
    around it: the lowest plane parallel to it that is large enough is the floor.
    """
    cone = up.cone_deg
    facing = normals @ up.direction >= np.cos(np.radians(cone) + np.arccos(FLOOR_COSINE))
    highest = np.median(rig.master_from_colour[:, :3, 3] @ up.direction)
    candidates = np.flatnonzero(facing & (points @ up.direction < highest))
    if not len(candidates):
        return NO_GROUND
    rng = np.random.default_rng(0)
    judging = min(len(points), FLOOR_HYPOTHESIS_POINTS)
    sample = points[rng.choice(len(points), judging, replace=False)]
    tried = rng.choice(candidates, min(len(candidates), FLOOR_HYPOTHESES), replace=False)
    near_up = normals[tried] @ up.direction >= np.cos(np.radians(cone))
    tried = tried[near_up]
    if not len(tried):
        return NO_GROUND
    height = (sample @ normals[tried].T) - (points[tried] * normals[tried]).sum(1)
    inside = (np.abs(height) < FLOOR_HYPOTHESIS_TOLERANCE_M).sum(0)
    below = (height < -BELOW_FLOOR_M).sum(0)
    best = tried[np.argmax(inside - BELOW_FLOOR_COST * below)]
    fitted = _refined(
        points[candidates], normals[candidates], points[best], normals[best], tolerance_m
    )
    if fitted.inliers * cell_m**2 < MIN_FLOOR_AREA_M2:
        return NO_GROUND
    return _lowest(points[candidates], normals[candidates], fitted, tolerance_m, cell_m)


def _lowest(
    points: np.ndarray, normals: np.ndarray, ground: Ground, tolerance_m: float, cell_m: float
) -> Ground:
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
        parallel = degrees_between(lower.normal, ground.normal) <= LOWER_FLOOR_DEG
        deep = (lower.point - ground.point) @ ground.normal < -BELOW_FLOOR_M
        if lower.inliers * cell_m**2 < MIN_FLOOR_AREA_M2 or not (parallel and deep):
            break
        if _covered(points, lower, ground, tolerance_m) > MAX_COVERED_SHARE:
            break
        ground = lower
    if ground is upper:
        return ground
    above = float((upper.point - ground.point) @ ground.normal)
    note = f"a larger level surface lies {above:.2f} m above the floor (a platform, or a table)"
    return replace(ground, note=note)


def _covered(points: np.ndarray, lower: Ground, upper: Ground, tolerance_m: float) -> float:
    """Share of the lower plane, by cells, over which the upper one was seen: no camera looks
    through a platform, but one that is misplaced shows the same floor a second time."""
    across = np.linalg.svd(upper.normal[None])[2][1:]

    def cells(plane: Ground) -> set[tuple[int, ...]]:
        on = np.abs((points - plane.point) @ plane.normal) < tolerance_m
        flat = np.floor(points[on] @ across.T / COVER_CELL_M).astype(int)
        return set(map(tuple, flat.tolist()))

    below = cells(lower)
    return len(below & cells(upper)) / max(1, len(below))


def _refined(
    points: np.ndarray,
    normals: np.ndarray,
    point: np.ndarray,
    normal: np.ndarray,
    tolerance_m: float,
) -> Ground:
    """Weighted total least squares, the gate closing from 6 cm to the tolerance."""
    gates = np.geomspace(max(FLOOR_FIRST_GATE_M, tolerance_m), tolerance_m, FLOOR_REFINE_STEPS)
    for gate in gates:
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
    return Ground(point, normal, rms, int(inlier.sum()), "fitted")


def annotated_ground(
    floor: np.ndarray, points: np.ndarray, up: Up, *, tolerance_m: float
) -> Ground:
    """The plane through annotated floor points (M, 3), M >= 3, master frame; ``points`` (N, 3) of
    the background are only counted.

    Raises UserError, to be prefixed with the sequence, where the points lie on one line.
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
    return Ground(point, normal, rms, int(inlier.sum()), "annotated")


def stated_ground(up: np.ndarray, floor: np.ndarray) -> Ground:
    """The floor as the user states it: ``up`` (3,) unit, and a point of it, master frame."""
    return Ground(floor, up, float("nan"), 0, "stated")


def zup_from_master(ground: Ground, rig: Rig, up_hint: Up) -> np.ndarray:
    """Transform (4, 4) to z up with the floor at z = 0 under the ring's middle; y is where the
    master looks. Without a floor: up by ``up_hint``, and z = 0 at the master camera."""
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
