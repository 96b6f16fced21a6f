"""Search of the object's pose in a frame set without a start pose.

Candidates of different views are joined to groups. A grid of rotations over SO(3) modulo the
symmetry group is aligned to each group. The best poses are rendered and compared with every view,
and the best of those are fitted.

The alignment is point-to-plane ICP to the measured points for all rotations at once. Outlines of
masks are added for views without depth. They are added for all views of a group of at most two,
because many poses fit the points of so few views. Weights are Geman-McClure with a scale that
shrinks from the error of the grid to the noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.formats.detections.instance import PERSON_LABEL
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.solve.robust import geman_mcclure_weight
from intercap_core.object_track.fit import FittedPose, assess_all, fit_pose
from intercap_core.object_track.groups import (
    Group,
    find_groups,
    hull_vertices,
    locate_group,
    outline_residuals,
)
from intercap_core.object_track.likelihood import DECISIVE_LOG_RATIO, SEEN_LOG_RATIO
from intercap_core.object_track.motion import shift_twist
from intercap_core.object_track.turns import axis_turns, distinct_poses, rotation_grid
from intercap_core.object_track.view import FitContext, View

ICP_MAX_RESIDUAL_M = 0.05  # larger residuals of the alignment count as this; tuned on the studio
# A start that is this much worse than the best fit, nats, is not fitted: a fit gains up to 15 nats,
# measured on the studio (bottle to chair).
HOPELESS_LOG_RATIO = 15.0


def search_pose(
    context: FitContext,
    field: DistanceField,
    views: list[View],
    *,
    up: np.ndarray | None = None,
    place_prior: Callable[[np.ndarray], float] | None = None,
    rotations: np.ndarray | None = None,
    motion: tuple[np.ndarray, np.ndarray] | None = None,
) -> list[FittedPose]:
    """Search the pose of a frame set.

    Args:
        context: object and settings.
        field: distance field of the mesh.
        views: views of the frame set.
        up: (3,) vertical in the master frame: standing poses are tried more finely.
        place_prior: prior, 0 to 1, of a position (3,).
        rotations: (N, 3, 3) rotations to try; None = a grid of all.
        motion: twist (6,) of the object per second, and the point (3,) that moves by it.

    Returns:
        Fitted hypotheses, the likeliest first; empty if nothing is detected.
    """
    mesh = context.mesh
    fit_context = replace(context, min_overlap=min(context.min_overlap, 0.2))

    def fit_starts(starts: list[FittedPose], best: float = SEEN_LOG_RATIO) -> list[FittedPose]:
        """Fit the starts that are not hopeless compared with the ``best`` log-likelihood ratio."""
        fits: list[FittedPose] = []
        for start in starts:
            best = max([best, *(fit.log_ratio for fit in fits)])
            if start.log_ratio > best - HOPELESS_LOG_RATIO:
                fits.append(fit_pose(fit_context, views, start.pose, twist=start.twist))
        return fits

    def compare(poses: np.ndarray) -> list[FittedPose]:
        """Compare poses (N, 4, 4) with the views; the likeliest first."""
        twists = None
        if motion is not None:
            twists = np.array([shift_twist(*motion, pose[:3, 3]) for pose in poses])
        return sorted(assess_all(context, views, poses, twists), key=lambda fit: -fit.log_ratio)

    everywhere = rotations is None
    number_compared, number_fitted = (16, 3) if everywhere else (6, 2)
    if rotations is None:
        rotations = rotation_grid(mesh.symmetry, up)
    fits: list[FittedPose] = []
    for group in find_groups(mesh, views, context.labels, place_prior):
        poses = align(mesh, field, group, rotations)
        poses = poses[distinct_poses(mesh, poses, count=number_compared)]
        of_group = fit_starts(compare(poses)[:number_fitted])
        fits += of_group
        trusted = place_prior is None or place_prior(locate_group(group)) > 0.5
        if trusted and any(fit.log_ratio > DECISIVE_LOG_RATIO for fit in of_group):
            break
    fits.sort(key=lambda fit: -fit.log_ratio)
    if fits and everywhere and not mesh.symmetry.sphere:
        # a mug looks much the same with its handle elsewhere, a box from its back
        turned = compare(fits[0].pose @ axis_turns(mesh))[:3]
        fits += fit_starts(turned, fits[0].log_ratio)
        fits.sort(key=lambda fit: -fit.log_ratio)
    return [fits[k] for k in distinct_poses(mesh, [fit.pose for fit in fits])]


def rank_frames(labels_by_view: list[list[list[str]]], labels: tuple[str, ...]) -> list[int]:
    """Order the frames for searching.

    Frames in which more views have a candidate with a likely label come first. Among equal frames
    the next one is far from those already ordered.

    Args:
        labels_by_view: labels [T][C][candidates].
        labels: detector classes of the object.
    """
    count = len(labels_by_view)

    def is_likely(label: str) -> bool:
        return label in labels if labels else label != PERSON_LABEL

    support = np.array([sum(any(map(is_likely, v)) for v in frame) for frame in labels_by_view])
    order: list[int] = []
    distance = np.full(count, float(count))
    rest = np.ones(count, bool)
    while rest.any():
        value = np.where(rest, support + np.minimum(distance / max(count, 1), 0.5), -np.inf)
        frame = int(value.argmax())
        order.append(frame)
        rest[frame] = False
        distance = np.minimum(distance, np.abs(np.arange(count) - frame))
    return order


def align(
    mesh: ObjectMesh, field: DistanceField, group: Group, rotations: np.ndarray
) -> np.ndarray:
    """Align rotations (N, 3, 3) to a group of candidates (ICP with successive halving).

    All rotations start at the position of the group and take seven Gauss-Newton steps together, on
    points and outlines. The worst rotations are dropped after the second and the fourth step. Steps
    are in the object's frame. Returns poses (M, 4, 4), the best first.
    """
    cloud, eyes = _cloud(group)
    few = len(group) <= 2
    shapes = [s.outline for s in group if (few or s.centre is None) and s.outline]
    hull = hull_vertices(mesh) if shapes else np.zeros((0, 3))
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    middle = (area[:, None] * (a + b + c) / 3).sum(0) / area.sum()
    rotation = rotations.copy()
    translation = locate_group(group) - rotation @ middle
    # Geman-McClure scales, metres: from the error of the grid to the noise
    scales = [*np.geomspace(0.08, 0.015, 6), 0.015]
    survivors = {1: 96, 3: 48}  # number of rotations that continue after step 1 and step 3 (from 0)
    residual = np.zeros(len(rotation))
    for number, scale in enumerate(scales):
        few_points = slice(None, None, 3 if number < 2 else 1)
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
            gap, jacobian = outline_residuals(shape, hull, rotation, translation)
            weight = geman_mcclure_weight(gap**2, scale)
            weighted = jacobian * weight[..., None]
            hessian += np.einsum("ndi,ndj->nij", weighted, jacobian)
            gradient -= np.einsum("ndi,nd->ni", weighted, gap)
            costs.append(np.minimum(np.abs(gap[:, shape.known]), ICP_MAX_RESIDUAL_M))
        residual = np.concatenate(costs, 1).mean(1)
        hessian += 1e-3 * np.einsum("nii,ij->nij", hessian, np.eye(6)) + 1e-6 * np.eye(6)
        step = np.linalg.solve(hessian, gradient[..., None])[..., 0]
        # at most 15 degrees and 5 cm
        limit = np.maximum(1.0, np.linalg.norm(step[:, :3], axis=1) / np.radians(15))
        limit = np.maximum(limit, np.linalg.norm(step[:, 3:], axis=1) / 0.05)
        step /= limit[:, None]
        # the step moves the object in its own frame: pose <- pose * exp(step)
        translation = translation + np.einsum("nij,nj->ni", rotation, step[:, 3:])
        rotation = rotation @ Rotation.from_rotvec(step[:, :3]).as_matrix()
        order = np.argsort(residual, kind="stable")
        if number in survivors:
            order = order[: survivors[number]]
        rotation, translation = rotation[order], translation[order]
    return rigid(rotation, translation)


def _cloud(group: Group) -> tuple[np.ndarray, np.ndarray]:
    """Return up to 150 points (P, 3), as many of each view, and their cameras' centres (P, 3)."""
    measured = [s for s in group if len(s.points)]
    if not measured:
        return np.zeros((0, 3)), np.zeros((0, 3))
    share = 150 // len(measured)
    parts = [
        s.points[np.linspace(0, len(s.points) - 1, min(share, len(s.points))).astype(int)]
        for s in measured
    ]
    centres = [s.image.geometry.camera.master_from_depth[:3, 3] for s in measured]
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
    """Linearise the distances of P points from the surface at N poses, by steps in its own frame.

    Args:
        field: distance field of the mesh.
        cloud, eyes: (P, 3) points and the camera centre of each, master frame.
        rotation, translation: (N, 3, 3) and (N, 3) of master_from_object.
        scale: Geman-McClure scale, metres.

    Returns:
        The cost (N, P) of each point in metres, J'WJ (N, 6, 6), and -J'Wr (N, 6).
    """
    count = len(rotation)
    local = np.einsum("nji,npj->npi", rotation, cloud[None] - translation[:, None])
    closest = field.closest(local.reshape(-1, 3))
    points = closest.points.reshape(count, -1, 3)
    normals = closest.normals.reshape(count, -1, 3)
    gap = local - points
    along = (gap * normals).sum(-1)
    distance = np.linalg.norm(gap, axis=-1)
    to_eye = np.einsum("nji,npj->npi", rotation, (eyes - cloud)[None])
    # a measured point cannot lie on a face that looks away from the camera
    facing = (to_eye * normals).sum(-1) > 0
    weight = geman_mcclure_weight(distance**2, scale) * np.where(facing, 1.0, 0.1)
    cost = np.minimum(np.where(facing, distance, np.maximum(distance, 0.01)), ICP_MAX_RESIDUAL_M)
    jacobian = np.concatenate([np.cross(local, normals), normals], -1)
    weighted = jacobian * weight[..., None]
    hessian = np.einsum("npi,npj->nij", weighted, jacobian)
    return cost, hessian, np.einsum("npi,np->ni", weighted, along)
