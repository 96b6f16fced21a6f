"""The floor: a plane through what all cameras see, or through annotated points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.camera.rig import Rig, ring_centre
from intercap_core.errors import UserError
from intercap_core.scene.constants import (
    BELOW_FLOOR_COST,
    BELOW_FLOOR_M,
    CAMERA_UP_CONE_DEG,
    FLOOR_COSINE,
    FLOOR_FIRST_GATE_M,
    FLOOR_HYPOTHESES,
    FLOOR_HYPOTHESIS_POINTS,
    FLOOR_HYPOTHESIS_TOLERANCE_M,
    FLOOR_REFINE_STEPS,
    FOOT_HEIGHT_M,
    FOOT_TOLERANCE_M,
    GRAVITY_CONE_DEG,
    MIN_ANNOTATED_SPREAD_M,
    MIN_FLOOR_AREA_M2,
    MIN_FOOT_SETS,
    MIN_FOOT_SPREAD_M,
)


@dataclass(frozen=True, eq=False)
class Ground:
    """``point`` (3,) and unit ``normal`` (3,), up, master frame; ``rms`` metres over the
    ``inliers`` points, or sets in which someone stands, within the tolerance; NaN and 0 where
    there is no floor."""

    point: np.ndarray
    normal: np.ndarray
    rms: float
    inliers: int
    source: str

    @property
    def found(self) -> bool:
        """Whether a floor is known."""
        return self.source != "none"


NO_GROUND = Ground(np.full(3, np.nan), np.full(3, np.nan), float("nan"), 0, "none")


def up_hint(rig: Rig, gravity: np.ndarray) -> tuple[np.ndarray, float]:
    """Roughly up (3,), master frame, and how far off it may be, degrees.

    ``gravity`` (C, 3) points down in each colour camera, NaN where not known; else the images'
    upward directions, whose tilts cancel around a ring.
    """
    measured = np.isfinite(gravity).all(1)
    rotations = rig.master_from_colour[:, :3, :3]
    if measured.any():
        down = np.einsum("cij,cj->ci", rotations[measured], gravity[measured])
        up = -np.median(down, axis=0)
        return up / np.linalg.norm(up), GRAVITY_CONE_DEG
    up = -rotations[:, :, 1].mean(0)
    return up / np.linalg.norm(up), CAMERA_UP_CONE_DEG


def fit_ground(
    points: np.ndarray,
    normals: np.ndarray,
    rig: Rig,
    gravity: np.ndarray,
    *,
    tolerance_m: float,
    cell_m: float,
) -> Ground:
    """Fit the floor to background points (N, 3) with normals (N, 3), master frame, spaced by
    ``cell_m``: the lowest large plane that faces up, below the cameras, with little under it.

    Every point with its normal is a hypothesis (so one point gives a plane); the best is refined
    by iterated weighted least squares.
    """
    up, cone = up_hint(rig, gravity)
    facing = normals @ up >= np.cos(np.radians(cone) + np.arccos(FLOOR_COSINE))
    highest = np.median(rig.master_from_colour[:, :3, 3] @ up)
    candidates = np.flatnonzero(facing & (points @ up < highest))
    if not len(candidates):
        return NO_GROUND
    rng = np.random.default_rng(0)
    judging = min(len(points), FLOOR_HYPOTHESIS_POINTS)
    sample = points[rng.choice(len(points), judging, replace=False)]
    tried = rng.choice(candidates, min(len(candidates), FLOOR_HYPOTHESES), replace=False)
    near_up = normals[tried] @ up >= np.cos(np.radians(cone))
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
    return fitted


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


def ground_of_feet(feet: np.ndarray, rig: Rig, gravity: np.ndarray) -> Ground:
    """The floor that someone stands on: from heels and toes (T, F, 3), NaN = not known.

    In each set the lowest of the feet stands, in most of them on the floor. Gravity gives the
    normal; where none is measured the feet do, as far as they have been apart: who walks along a
    line shows the tilt along it, and across it the cameras' own up stands. For scenes whose floor
    no camera measures; its height is as good as the keypoints, a centimetre or two.
    """
    up, _ = up_hint(rig, gravity)
    known = np.isfinite(feet[..., 0]).sum(1) >= 3
    if known.sum() < MIN_FOOT_SETS:
        return NO_GROUND
    height = np.where(np.isfinite(feet[..., 0]), feet @ up, np.inf)[known]
    standing = feet[known][np.arange(known.sum()), height.argmin(1)]
    inlier = np.abs(standing @ up - np.median(standing @ up)) < FOOT_TOLERANCE_M
    standing = standing[inlier]
    if len(standing) < MIN_FOOT_SETS:
        return NO_GROUND
    point, normal = np.median(standing, 0), up
    if not np.isfinite(gravity).all(1).any():
        point = standing.mean(0)
        _, spread, axes = np.linalg.svd(standing - point, full_matrices=False)
        along, across = spread[:2] / np.sqrt(len(standing))
        if along < MIN_FOOT_SPREAD_M:
            return NO_GROUND
        normal = axes[2] * np.sign(axes[2] @ up)
        if across < MIN_FOOT_SPREAD_M:
            normal = up - (up @ axes[0]) * axes[0]
            normal /= np.linalg.norm(normal)
    distance = (standing - point) @ normal
    point = point + (np.median(distance) - FOOT_HEIGHT_M) * normal
    rms = float(np.sqrt(np.mean((distance - np.median(distance)) ** 2)))
    return Ground(point, normal, rms, len(standing), "feet")


def annotated_ground(
    floor: np.ndarray, points: np.ndarray, rig: Rig, gravity: np.ndarray, *, tolerance_m: float
) -> Ground:
    """The plane through annotated floor points (M, 3), M >= 3, master frame; ``points`` (N, 3) of
    the background are only counted.

    Raises UserError, to be prefixed with the sequence, where the points lie on one line.
    """
    point = floor.mean(0)
    _, spread, axes = np.linalg.svd(floor - point, full_matrices=False)
    if spread[1] / np.sqrt(len(floor)) < MIN_ANNOTATED_SPREAD_M:
        raise UserError(
            f"annotation floor: its {len(floor)} points lie on one line within "
            f"{MIN_ANNOTATED_SPREAD_M * 1000:.0f} mm; pick points that span the floor"
        )
    normal = axes[2] * np.sign(axes[2] @ up_hint(rig, gravity)[0])
    distance = (points - point) @ normal
    inlier = np.abs(distance) < tolerance_m
    rms = float(np.sqrt(np.mean(distance[inlier] ** 2))) if inlier.any() else float("nan")
    return Ground(point, normal, rms, int(inlier.sum()), "annotated")


def zup_from_master(ground: Ground, rig: Rig, gravity: np.ndarray) -> np.ndarray:
    """Transform (4, 4) to z up with the floor at z = 0 under the ring's middle; y is where the
    master looks. Without a floor: up by :func:`up_hint`, and z = 0 at the master camera."""
    up, point = ground.normal, ground.point
    if not ground.found:
        up, point = up_hint(rig, gravity)[0], np.zeros(3)
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
