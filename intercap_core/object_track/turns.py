"""Rotations of an object: search grid, turns about its own axes, and near symmetries.

A near symmetry nearly maps the surface onto itself, such as a mug turned about its axis or a box by
half a turn. The tracker follows such turns as hypotheses (:mod:`.proposals`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.symmetry import SymmetryGroup
from intercap_core.geometry.solve.robust import geman_mcclure_weight

# Largest differences between fits of one pose. They are also the standard deviations of the motion
# of an object at rest, or in a hand whose joints are known.
SAME_POSE_M = 0.02  # metres; tuned
SAME_POSE_RAD = np.radians(10)  # radians; tuned
# A pose with a larger standard deviation is lost; poses that are farther apart are different. Fits
# from all poses within these distances lead to one pose.
UNSURE_M = 0.035  # metres; tuned on the studio
UNSURE_RAD = np.radians(15)  # radians; tuned on the studio
NEAR_TURN_CHANGED_SHARE = 0.3  # of the surface that near symmetries clearly displace; tuned


def find_near_symmetries(mesh: ObjectMesh, field: DistanceField) -> np.ndarray:
    """Find turns (N, 4, 4) of the object that hardly change it, the identity first.

    Angles in steps of 30 degrees about each of the object's axes are tried, with the best shift. If
    all angles about an axis displace less than ``NEAR_TURN_CHANGED_SHARE`` of the surface, all are
    returned; otherwise those that displace less than this and no more than the next angles.
    Elements of the symmetry group are left out. ``field`` is the mesh's distance field.
    """
    kept = [np.eye(4)]
    if mesh.symmetry.sphere:
        return np.array(kept)
    steps = 12  # tried angles per full turn about an axis
    # the first angle is small, to catch a slow slide along a near symmetry
    angles = np.array([np.pi / steps, *(2 * np.pi * np.arange(1, steps // 2 + 1) / steps)])
    axes = object_axes(mesh)
    rotations = Rotation.from_rotvec((axes[:, None] * angles[:, None]).reshape(-1, 3)).as_matrix()
    placed, shares = _align_turned(mesh, field, rotations)
    flips = []
    for about, (_, *share) in zip(
        placed.reshape(len(axes), -1, 4, 4), shares.reshape(len(axes), -1), strict=True
    ):
        # angles of 30 to 330 degrees: beyond 180 the inverses, which displace as much
        turns = [*about[1:], *(np.linalg.inv(turn) for turn in about[-2:0:-1])]
        changed = np.array([0.0, *share, *share[-2::-1]])  # of 0 to 330 degrees
        if changed.max() < NEAR_TURN_CHANGED_SHARE and mesh.symmetry.axis is None:
            kept += [about[0], np.linalg.inv(about[0]), *turns]
            continue
        least = (
            (changed <= np.roll(changed, 1))
            & (changed <= np.roll(changed, -1))
            & (changed < NEAR_TURN_CHANGED_SHARE)
        )
        flips += [turn for turn, is_least in zip(turns, least[1:], strict=True) if is_least]
    for turn in flips:
        known = np.array(kept)[:, :3, :3]
        if mesh.symmetry.rotation_error_deg(known, turn[:3, :3]).min() > 45:
            kept.append(turn)
    return np.array(kept)


def changed_share(mesh: ObjectMesh, field: DistanceField, motion: np.ndarray) -> float:
    """Return the share (0 to 1) of the surface that a motion (4, 4) moves clearly off the mesh."""
    moved = _surface(mesh) @ motion[:3, :3].T + motion[:3, 3]
    return float((field.distance(moved) > _far(mesh)).mean())


def _align_turned(
    mesh: ObjectMesh, field: DistanceField, rotations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Shift turned surfaces so that most of each falls onto the original surface.

    Robust point-to-plane ICP in the shift alone, in five steps. The scale shrinks from six times to
    once the distance of a clearly displaced point (:func:`_far`).

    Args:
        mesh, field: the object and its distance field.
        rotations: (N, 3, 3).

    Returns:
        The turns with their shifts (N, 4, 4), and the share (N,) of the surface that is displaced.
    """
    points, far = _surface(mesh), _far(mesh)
    turned = points @ rotations.transpose(0, 2, 1)
    shift = (points - turned).mean(1)
    for scale in far * np.geomspace(6.0, 1, 5):
        at = turned + shift[:, None]
        closest = field.closest(at.reshape(-1, 3))
        gap = closest.points.reshape(at.shape) - at
        normals = closest.normals.reshape(at.shape)
        weight = geman_mcclure_weight((gap**2).sum(-1), scale)[..., None]
        # point to plane; a little point to point, for directions that no plane constrains
        point_weight = 0.05
        little = point_weight * weight.sum(1)
        matrix = (normals * weight).transpose(0, 2, 1) @ normals + little[:, None] * np.eye(3)
        pull = (weight * (normals * (normals * gap).sum(-1, keepdims=True))).sum(1)
        pull += point_weight * (weight * gap).sum(1)
        shift = shift + np.linalg.solve(matrix, pull[..., None])[..., 0]
    distance = field.distance((turned + shift[:, None]).reshape(-1, 3)).reshape(len(rotations), -1)
    return rigid(rotations, shift), (distance > far).mean(1)


def _far(mesh: ObjectMesh) -> float:
    """Return the distance from the surface at which a point is clearly displaced, metres."""
    return max(0.003, 0.01 * mesh.diameter)


def _surface(mesh: ObjectMesh) -> np.ndarray:
    """Sample 200 points (N, 3) evenly on the surface."""
    count = 200
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).cumsum()
    rng = np.random.default_rng(0)
    at = (np.arange(count) + 0.5) / count * area[-1]
    face = np.searchsorted(area, at)
    u, v = rng.random((2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return a[face] + u * (b - a)[face] + v * (c - a)[face]


def axis_turns(mesh: ObjectMesh) -> np.ndarray:
    """Return turns (N, 4, 4) of the object about its own axes by multiples of 30 degrees.

    They turn about the middle of its box, where a turned silhouette covers the old one best. Turns
    of the symmetry group are left out.
    """
    centre = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
    turns = []
    for axis in object_axes(mesh):
        for angle in 2 * np.pi * np.arange(1, 12) / 12:
            turn = np.eye(4)
            turn[:3, :3] = Rotation.from_rotvec(angle * axis).as_matrix()
            turn[:3, 3] = centre - turn[:3, :3] @ centre
            if not same_pose(mesh, turn, np.eye(4)):
                turns.append(turn)
    return np.array(turns).reshape(-1, 4, 4)


def object_axes(mesh: ObjectMesh) -> np.ndarray:
    """Return unit vectors (N, 3): the axes of the object's frame and its other principal axes."""
    _, principal = np.linalg.eigh(np.cov(mesh.vertices.T))
    # a handle tilts the principal axes by some degrees; within 10 they count as the frame's
    new = np.abs(principal).max(0) < float(np.cos(np.radians(10)))
    return np.concatenate([np.eye(3), principal[:, new]], 1).T


def rotation_grid(symmetry: SymmetryGroup, up: np.ndarray | None) -> np.ndarray:
    """Return rotations (N, 3, 3) that cover SO(3) modulo the symmetry group.

    Those of a trivial group are 40 degrees apart, inside the fit's basin. If the vertical ``up``
    (3,) is known, standing poses 15 degrees apart come first.
    """
    if symmetry.sphere:
        return np.eye(3)[None]
    grid = _super_fibonacci(240)
    if up is not None:
        turns = np.outer(2 * np.pi * np.arange(24) / 24, (0, 0, 1))
        grid = np.concatenate([_standing(up) @ Rotation.from_rotvec(turns).as_matrix(), grid])
    # of rotations that the group makes equivalent to a few degrees, keep the first
    kept: list[np.ndarray] = []
    spacing = 12.0 if symmetry.axis is None else 24.0
    for rotation in grid:
        if (
            symmetry.trivial
            or not kept
            or symmetry.rotation_error_deg(np.array(kept), rotation).min() > spacing
        ):
            kept.append(rotation)
    return np.array(kept)


def same_pose(
    mesh: ObjectMesh,
    a: np.ndarray,
    b: np.ndarray,
    limits: tuple[float, float] = (SAME_POSE_M, SAME_POSE_RAD),
) -> bool:
    """Return whether two poses (4, 4) are equal up to symmetry and ``limits`` (m, rad)."""
    angle = float(np.radians(mesh.symmetry.rotation_error_deg(a[:3, :3], b[:3, :3])))
    shift = float(np.linalg.norm(mesh.centre_at(a) - mesh.centre_at(b)))
    return shift < limits[0] and angle < limits[1]


def distinct_poses(
    mesh: ObjectMesh,
    poses: Sequence[np.ndarray] | np.ndarray,
    limits: tuple[float, float] = (SAME_POSE_M, SAME_POSE_RAD),
    count: int | None = None,
) -> list[int]:
    """Return indices of the first ``count`` poses (4, 4) that differ from all returned before."""
    kept: list[int] = []
    for k, pose in enumerate(poses):
        if len(kept) == count:
            break
        if not any(same_pose(mesh, pose, poses[other], limits) for other in kept):
            kept.append(k)
    return kept


def _super_fibonacci(count: int) -> np.ndarray:
    """Spread ``count`` rotations evenly (Alexa, Super-Fibonacci Spirals, CVPR 2022)."""
    phi, psi = np.sqrt(2.0), 1.533751168755204288118041
    s = np.arange(count) + 0.5
    r, big_r = np.sqrt(s / count), np.sqrt(1 - s / count)
    alpha, beta = 2 * np.pi * s / phi, 2 * np.pi * s / psi
    quaternions = np.stack(
        [r * np.sin(alpha), r * np.cos(alpha), big_r * np.sin(beta), big_r * np.cos(beta)], 1
    )
    return Rotation.from_quat(quaternions).as_matrix()


def _standing(up: np.ndarray) -> np.ndarray:
    """Return a rotation (3, 3) that takes the object's z axis to ``up``."""
    z = up / np.linalg.norm(up)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], 1)
