"""Orientation of a nearly symmetric object among its near symmetries, decided over all frames.

A mug looks much the same with its handle elsewhere, a box from its back. One frame may not show the
difference, a hand may occlude it for a second, and the tracker then drifts to another rotation
unnoticed. Which turns are hard to tell apart follows from the mesh: those that bring its surface
nearly back onto itself. Every few frames all of them are compared with the images, and dynamic
programming (Viterbi 1967) finds the sequence of turns that explains all frames best while the
object turns no faster than objects do; it may change freely only where the track was lost.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.object_track.constants import (
    NEAR_TURN_CHANGED_SHARE,
    NEAR_TURN_DISTINCT_DEG,
    NEAR_TURN_FAR_M,
    NEAR_TURN_FAR_SHARE,
    NEAR_TURN_FINE_RAD,
    NEAR_TURN_ICP_START,
    NEAR_TURN_ICP_STEPS,
    NEAR_TURN_POINT_WEIGHT,
    NEAR_TURN_POINTS,
    NEAR_TURN_STEPS,
)
from intercap_core.object_track.search import own_axes
from intercap_core.rigid.distance import DistanceField
from intercap_core.rigid.mesh import ObjectMesh
from intercap_core.solve.robust import geman_mcclure_weight


def near_turns(mesh: ObjectMesh, field: DistanceField) -> np.ndarray:
    """Turns (N, 4, 4) of the object that hardly change it, the identity first.

    All angles about an axis of near symmetry, and single angles where the surface comes back to
    itself; elements of the symmetry group left out. ``field`` is the mesh's distance field.
    """
    found = [np.eye(4)]
    if mesh.symmetry.sphere:
        return found[0][None]
    points = _surface(mesh)
    far = max(NEAR_TURN_FAR_M, NEAR_TURN_FAR_SHARE * mesh.diameter)
    angles = 2 * np.pi * np.arange(NEAR_TURN_STEPS) / NEAR_TURN_STEPS
    flips = []
    for axis in own_axes(mesh):
        half = [
            _placed(field, points, _about(axis, a), far) for a in angles[: NEAR_TURN_STEPS // 2 + 1]
        ]
        # the inverse rotation moves the surface as far
        placed = half + [(np.linalg.inv(turn), share) for turn, share in half[-2:0:-1]]
        moved = np.array([share for _, share in placed])
        if moved.max() < NEAR_TURN_CHANGED_SHARE and mesh.symmetry.axis is None:
            fine, _ = _placed(field, points, _about(axis, NEAR_TURN_FINE_RAD), far)
            found += [fine, np.linalg.inv(fine)]
            found += [turn for turn, _ in placed[1:]]
            continue
        least = (
            (moved <= np.roll(moved, 1))
            & (moved <= np.roll(moved, -1))
            & (moved < NEAR_TURN_CHANGED_SHARE)
        )
        flips += [placed[i][0] for i in range(1, NEAR_TURN_STEPS) if least[i]]
    kept = found
    for turn in flips:
        known = np.array(kept)[:, :3, :3]
        if mesh.symmetry.rotation_error_deg(known, turn[:3, :3]).min() > NEAR_TURN_DISTINCT_DEG:
            kept.append(turn)
    return np.array(kept)


def changed_share(mesh: ObjectMesh, field: DistanceField, motion: np.ndarray) -> float:
    """Share of the surface that a motion (4, 4) of the object brings clearly off the surface."""
    moved = _surface(mesh) @ motion[:3, :3].T + motion[:3, 3]
    far = max(NEAR_TURN_FAR_M, NEAR_TURN_FAR_SHARE * mesh.diameter)
    return float((field.distance(moved) > far).mean())


def _about(axis: np.ndarray, angle: float) -> np.ndarray:
    return Rotation.from_rotvec(angle * axis).as_matrix()


def _placed(
    field: DistanceField, points: np.ndarray, rotation: np.ndarray, far: float
) -> tuple[np.ndarray, float]:
    """The turn (4, 4) by ``rotation`` shifted so that most of the surface falls onto itself, and
    the share of ``points`` (N, 3) that stay farther than ``far``."""
    turned = points @ rotation.T
    shift = points.mean(0) - turned.mean(0)
    for scale in far * np.geomspace(NEAR_TURN_ICP_START, 1, NEAR_TURN_ICP_STEPS):
        at = turned + shift
        closest = field.closest(at)
        gap = closest.points - at
        weight = geman_mcclure_weight((gap**2).sum(1), scale)
        weighted = closest.normals * weight[:, None]
        # point to plane, a little to the point where no plane holds it
        matrix = weighted.T @ closest.normals + NEAR_TURN_POINT_WEIGHT * weight.sum() * np.eye(3)
        pull = weighted.T @ (closest.normals * gap).sum(1) + NEAR_TURN_POINT_WEIGHT * weight @ gap
        shift = shift + np.linalg.solve(matrix, pull)
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = rotation, shift
    return turn, float((field.distance(turned + shift) > far).mean())


def _surface(mesh: ObjectMesh) -> np.ndarray:
    """Points (N, 3) spread evenly over the surface."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).cumsum()
    rng = np.random.default_rng(0)
    at = (np.arange(NEAR_TURN_POINTS) + 0.5) / NEAR_TURN_POINTS * area[-1]
    face = np.searchsorted(area, at)
    u, v = rng.random((2, NEAR_TURN_POINTS, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return a[face] + u * (b - a)[face] + v * (c - a)[face]
