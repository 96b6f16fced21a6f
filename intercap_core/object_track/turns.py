"""Near symmetries: turns of an object that are hard to tell apart, found on its mesh.

A mug looks much the same with its handle elsewhere, a box from its back. Such turns bring the
surface nearly back onto itself; the tracker follows them as hypotheses (:mod:`.proposals`).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.solve.robust import geman_mcclure_weight
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


def near_turns(mesh: ObjectMesh, field: DistanceField) -> np.ndarray:
    """Turns (N, 4, 4) of the object that hardly change it, the identity first.

    All angles about an axis of near symmetry, and single angles where the surface comes back to
    itself; elements of the symmetry group left out. ``field`` is the mesh's distance field.
    """
    found = [np.eye(4)]
    if mesh.symmetry.sphere:
        return found[0][None]
    half = NEAR_TURN_STEPS // 2
    angles = np.array([NEAR_TURN_FINE_RAD, *(2 * np.pi * np.arange(1, half + 1) / NEAR_TURN_STEPS)])
    axes = own_axes(mesh)
    rotations = Rotation.from_rotvec((axes[:, None] * angles[:, None]).reshape(-1, 3)).as_matrix()
    placed, shares = _placed(mesh, field, rotations)
    flips = []
    for about, (_, *share) in zip(
        placed.reshape(len(axes), -1, 4, 4), shares.reshape(len(axes), -1), strict=True
    ):
        # the inverse rotation moves the surface as far
        turns = [*about[1:], *(np.linalg.inv(turn) for turn in about[-2:0:-1])]
        changed = np.array([0.0, *share, *share[-2::-1]])
        if changed.max() < NEAR_TURN_CHANGED_SHARE and mesh.symmetry.axis is None:
            found += [about[0], np.linalg.inv(about[0]), *turns]
            continue
        least = (
            (changed <= np.roll(changed, 1))
            & (changed <= np.roll(changed, -1))
            & (changed < NEAR_TURN_CHANGED_SHARE)
        )
        flips += [turn for turn, is_least in zip(turns, least[1:], strict=True) if is_least]
    kept = found
    for turn in flips:
        known = np.array(kept)[:, :3, :3]
        if mesh.symmetry.rotation_error_deg(known, turn[:3, :3]).min() > NEAR_TURN_DISTINCT_DEG:
            kept.append(turn)
    return np.array(kept)


def changed_share(mesh: ObjectMesh, field: DistanceField, motion: np.ndarray) -> float:
    """Share of the surface that a motion (4, 4) of the object brings clearly off the surface."""
    moved = _surface(mesh) @ motion[:3, :3].T + motion[:3, 3]
    return float((field.distance(moved) > _far(mesh)).mean())


def _placed(
    mesh: ObjectMesh, field: DistanceField, rotations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The turns (N, 4, 4) by ``rotations`` (N, 3, 3), shifted so that most of the surface falls
    onto itself, and the share (N,) of it that stays far."""
    points, far = _surface(mesh), _far(mesh)
    turned = points @ rotations.transpose(0, 2, 1)
    shift = (points - turned).mean(1)
    for scale in far * np.geomspace(NEAR_TURN_ICP_START, 1, NEAR_TURN_ICP_STEPS):
        at = turned + shift[:, None]
        closest = field.closest(at.reshape(-1, 3))
        gap = closest.points.reshape(at.shape) - at
        normals = closest.normals.reshape(at.shape)
        weight = geman_mcclure_weight((gap**2).sum(-1), scale)[..., None]
        # point to plane, a little to the point where no plane holds it
        little = NEAR_TURN_POINT_WEIGHT * weight.sum(1)
        matrix = (normals * weight).transpose(0, 2, 1) @ normals + little[:, None] * np.eye(3)
        pull = (weight * (normals * (normals * gap).sum(-1, keepdims=True))).sum(1)
        pull += NEAR_TURN_POINT_WEIGHT * (weight * gap).sum(1)
        shift = shift + np.linalg.solve(matrix, pull[..., None])[..., 0]
    distance = field.distance((turned + shift[:, None]).reshape(-1, 3)).reshape(len(rotations), -1)
    return rigid(rotations, shift), (distance > far).mean(1)


def _far(mesh: ObjectMesh) -> float:
    """Distance from the surface from which a point is noticed, metres."""
    return max(NEAR_TURN_FAR_M, NEAR_TURN_FAR_SHARE * mesh.diameter)


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
