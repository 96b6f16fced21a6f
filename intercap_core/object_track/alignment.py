"""Hundreds of poses aligned at once to what a group of candidates shows of the object.

Point-to-plane ICP to the measured points, and the reach of the silhouettes where views measure none
or few views leave many poses that fit the points. Robust (Geman-McClure), with a scale that shrinks
from the size of the search grid's error.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.solve.robust import geman_mcclure_weight
from intercap_core.object_track import outlines
from intercap_core.object_track.constants import (
    ALIGNED_POINTS,
    FACING_AWAY_MIN_M,
    FACING_AWAY_WEIGHT,
    ICP_COARSE_STEPS,
    ICP_DAMPING,
    ICP_KEPT,
    ICP_MAX_RESIDUAL_M,
    ICP_MAX_SHIFT_M,
    ICP_MAX_TURN_RAD,
    ICP_SCALES_M,
    ICP_STEPS,
    ICP_THINNED,
    OUTLINE_ALIGNED_VIEWS,
)
from intercap_core.object_track.groups import Group, centre_of
from intercap_core.object_track.view import View


def align(
    mesh: ObjectMesh,
    field: DistanceField,
    group: Group,
    views: list[View],
    rotations: np.ndarray,
) -> np.ndarray:
    """Poses (M, 4, 4), the best first, that rotations (N, 3, 3) lead to; hopeless ones are left out
    on the way (successive halving)."""
    cloud, eyes = _cloud(group, views)
    few = len(group) <= OUTLINE_ALIGNED_VIEWS
    shapes = [s.outline for s in group if (few or s.centre is None) and s.outline]
    hull = outlines.hull_vertices(mesh) if shapes else np.zeros((0, 3))
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    middle = (area[:, None] * (a + b + c) / 3).sum(0) / area.sum()
    rotation = rotations.copy()
    translation = centre_of(group) - rotation @ middle
    scales = [*np.geomspace(*ICP_SCALES_M, ICP_STEPS), ICP_SCALES_M[-1]]
    residual = np.zeros(len(rotation))
    for number, scale in enumerate(scales):
        few_points = slice(None, None, ICP_THINNED if number < ICP_COARSE_STEPS else 1)
        count = len(rotation)
        hessian, gradient = np.zeros((count, 6, 6)), np.zeros((count, 6))
        costs = []
        if len(cloud):
            cost, h, g = _to_points(
                field, cloud[few_points], eyes[few_points], rotation, translation, scale
            )
            hessian, gradient = hessian + h, gradient + g
            costs.append(cost)
        for shape in shapes:
            gap, jacobian = outlines.residuals(shape, hull, rotation, translation)
            weight = geman_mcclure_weight(gap**2, scale)
            weighted = jacobian * weight[..., None]
            hessian += np.einsum("ndi,ndj->nij", weighted, jacobian)
            gradient -= np.einsum("ndi,nd->ni", weighted, gap)
            costs.append(np.minimum(np.abs(gap[:, shape.known]), ICP_MAX_RESIDUAL_M))
        residual = np.concatenate(costs, 1).mean(1)
        hessian += ICP_DAMPING * np.einsum("nii,ij->nij", hessian, np.eye(6)) + 1e-6 * np.eye(6)
        step = np.linalg.solve(hessian, gradient[..., None])[..., 0]
        limit = np.maximum(1.0, np.linalg.norm(step[:, :3], axis=1) / ICP_MAX_TURN_RAD)
        limit = np.maximum(limit, np.linalg.norm(step[:, 3:], axis=1) / ICP_MAX_SHIFT_M)
        step /= limit[:, None]
        # the step moves the object in its own frame: pose <- pose * exp(step)
        translation = translation + np.einsum("nij,nj->ni", rotation, step[:, 3:])
        rotation = rotation @ Rotation.from_rotvec(step[:, :3]).as_matrix()
        order = np.argsort(residual, kind="stable")
        if number in ICP_KEPT:
            order = order[: ICP_KEPT[number]]
        rotation, translation = rotation[order], translation[order]
    return rigid(rotation, translation)


def _cloud(group: Group, views: list[View]) -> tuple[np.ndarray, np.ndarray]:
    """Points (P, 3), as many of each view that measures, and the camera centre of each (P, 3)."""
    measured = [s for s in group if len(s.points)]
    if not measured:
        return np.zeros((0, 3)), np.zeros((0, 3))
    share = ALIGNED_POINTS // len(measured)
    parts = [
        s.points[np.linspace(0, len(s.points) - 1, min(share, len(s.points))).astype(int)]
        for s in measured
    ]
    centres = [views[s.view].geometry.camera.master_from_depth[:3, 3] for s in measured]
    eyes = [np.broadcast_to(e, part.shape) for e, part in zip(centres, parts, strict=True)]
    return np.concatenate(parts), np.concatenate(eyes)


def _to_points(
    field: DistanceField,
    cloud: np.ndarray,
    eyes: np.ndarray,
    rotation: np.ndarray,
    translation: np.ndarray,
    scale: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cost (N, P) of each point, normal matrix (N, 6, 6) and gradient (N, 6)."""
    count = len(rotation)
    local = np.einsum("nji,npj->npi", rotation, cloud[None] - translation[:, None])
    closest = field.closest(local.reshape(-1, 3))
    points = closest.points.reshape(count, -1, 3)
    normals = closest.normals.reshape(count, -1, 3)
    gap = local - points
    along = (gap * normals).sum(-1)
    distance = np.linalg.norm(gap, axis=-1)
    # a measured point cannot lie on a back-facing triangle
    to_eye = np.einsum("nji,npj->npi", rotation, (eyes - cloud)[None])
    facing = (to_eye * normals).sum(-1) > 0
    weight = geman_mcclure_weight(distance**2, scale) * np.where(facing, 1.0, FACING_AWAY_WEIGHT)
    cost = np.minimum(
        np.where(facing, distance, np.maximum(distance, FACING_AWAY_MIN_M)), ICP_MAX_RESIDUAL_M
    )
    jacobian = np.concatenate([np.cross(local, normals), normals], -1)
    weighted = jacobian * weight[..., None]
    hessian = np.einsum("npi,npj->nij", weighted, jacobian)
    return cost, hessian, np.einsum("npi,np->ni", weighted, along)
