"""Find the object's pose in a frame set with nothing to start from.

Candidates of different views are joined where their measured points lie together; rotations from a
grid over SO(3) modulo the symmetry group are aligned to the joined cloud by batched point-to-plane
ICP; the best are rendered and compared with every view, and the best of those are fitted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.camera.transforms import apply
from intercap_core.rigid.distance import DistanceField
from intercap_core.rigid.mesh import ObjectMesh
from intercap_core.rigid.symmetry import SymmetryGroup
from intercap_core.tracking.evidence import Candidate, View
from intercap_core.tracking.fit import Fit, assess, fit_pose

GRID = 240  # rotations of a trivial group: about 40 degrees apart, inside the fit's basin
UPRIGHT = 24  # turns about the vertical of the standing pose, 15 degrees apart
CLOUD_POINTS = 150
ICP_STEPS = 6
ICP_SCALES_M = (0.08, 0.015)
COMPARED = 16  # poses rendered after ICP
FITTED = 6  # poses fitted after rendering
MAX_GROUPS = 3
GOOD_ENOUGH = 0.55  # confidence above which less likely groups are not searched
NEAR_TURNS = 12  # turns about each axis of the best pose that are compared with it
TURNS_FITTED = 4
SAME_AXIS_COSINE = float(np.cos(np.radians(10)))
STANDING_BONUS = 0.03  # of confidence
STANDING_COSINE = float(np.cos(np.radians(12)))
MIN_POINTS = 15  # of a candidate's cloud
SAME_POSE_M, SAME_POSE_DEG = 0.02, 12.0
PERSON_LABELS = frozenset({"person"})


@dataclass(frozen=True)
class _Cluster:
    """One candidate's measured points (N, 3), master frame, and its image's index."""

    view: int
    candidate: Candidate
    points: np.ndarray
    centre: np.ndarray
    likely: bool


def search(
    mesh: ObjectMesh,
    views: list[View],
    *,
    labels: tuple[str, ...],
    up: np.ndarray | None,
    min_overlap: float,
    background_term: bool,
    near: np.ndarray | None = None,
) -> list[Fit]:
    """Fitted hypotheses of the pose, the most plausible first; none where nothing is detected.

    ``labels`` are the detector classes that the object may be given (empty: any but a person);
    ``up`` (3,) is the vertical in the master frame, to try the standing poses more finely;
    ``near`` (3,) prefers candidates near a place where the object was seen.
    """
    groups = _join(mesh, _clusters(views, mesh.diameter, labels), near)
    field = DistanceField(mesh.vertices, mesh.faces, watertight=mesh.watertight, threads=1)
    rotations = rotation_grid(mesh.symmetry, up)
    found: list[Fit] = []
    for group in groups:
        if found and max(fit.confidence for fit in found) > GOOD_ENOUGH:
            break
        cloud = _thinned(group)
        eyes = _eyes(group, views, cloud)
        poses, residual = _align(mesh, field, cloud, eyes, rotations)
        compared = []
        for index in _distinct(mesh, poses, np.argsort(residual, kind="stable"), COMPARED):
            start = assess(mesh, views, poses[index], min_overlap=0.1, labels=labels)
            compared.append(start)
        compared.sort(key=lambda fit: -fit.confidence)
        found += [
            fit_pose(
                mesh,
                views,
                start.pose,
                prior=None,
                min_overlap=min(min_overlap, 0.2),
                background_term=background_term,
                labels=labels,
            )
            for start in compared[:FITTED]
        ]
    found.sort(key=lambda fit: -plausibility(fit, up))
    if found and not mesh.symmetry.sphere:
        found += _turned(mesh, views, found[0], labels, min_overlap, background_term)
        found.sort(key=lambda fit: -plausibility(fit, up))
    kept: list[Fit] = []
    for fit in found:
        if not any(same_pose(mesh, fit.pose, other.pose) for other in kept):
            kept.append(fit)
    return kept


def _turned(
    mesh: ObjectMesh,
    views: list[View],
    best: Fit,
    labels: tuple[str, ...],
    min_overlap: float,
    background_term: bool,
) -> list[Fit]:
    """Fits from the best pose turned about the object's axes: nearly symmetric objects.

    A mug looks much the same with its handle elsewhere, a box from its back.
    """
    compared = [
        assess(mesh, views, best.pose @ turn, min_overlap=0.1, labels=labels)
        for turn in own_turns(mesh, NEAR_TURNS)
    ]
    compared.sort(key=lambda fit: -fit.score)
    return [
        fit_pose(
            mesh,
            views,
            start.pose,
            prior=None,
            min_overlap=min(min_overlap, 0.2),
            background_term=background_term,
            labels=labels,
        )
        for start in compared[:TURNS_FITTED]
    ]


def own_turns(mesh: ObjectMesh, steps: int) -> np.ndarray:
    """Turns (N, 4, 4) of the object about the axes of its frame and its principal axes.

    ``steps`` angles a full turn; those that the symmetry group holds anyway are left out. They
    turn about the middle of its box, where a turned silhouette covers the old one best.
    """
    _, principal = np.linalg.eigh(np.cov(mesh.vertices.T))
    new = np.abs(principal).max(0) < SAME_AXIS_COSINE  # a mug's handle tilts them
    axes = np.concatenate([np.eye(3), principal[:, new]], 1)
    centre = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
    found = []
    for axis in axes.T:
        for angle in 2 * np.pi * np.arange(1, steps) / steps:
            turn = np.eye(4)
            turn[:3, :3] = Rotation.from_rotvec(angle * axis).as_matrix()
            turn[:3, 3] = centre - turn[:3, :3] @ centre
            if not same_pose(mesh, turn, np.eye(4)):
                found.append(turn)
    return np.array(found)


def rank_frames(labels_by_view: list[list[list[str]]], labels: tuple[str, ...]) -> list[int]:
    """Frames in the order in which to search them.

    ``labels_by_view`` [T][C][candidates] are the candidates' labels. Frames in which more views
    hold a likely label come first; among equals those far from the ones taken already.
    """
    count = len(labels_by_view)
    support = np.array(
        [
            sum(
                any((label in labels) if labels else (label not in PERSON_LABELS) for label in view)
                for view in frame
            )
            for frame in labels_by_view
        ],
        float,
    )
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


def plausibility(fit: Fit, up: np.ndarray | None) -> float:
    """A fit's confidence, and a little more where the object stands as it does when let go.

    Decides between poses that the images hardly tell apart: a mug is seldom upside down.
    """
    if up is None:
        return fit.confidence
    upright = float(fit.pose[:3, 2] @ up) / float(np.linalg.norm(up))
    return fit.confidence + (STANDING_BONUS if upright > STANDING_COSINE else 0.0)


def rotation_grid(symmetry: SymmetryGroup, up: np.ndarray | None) -> np.ndarray:
    """Rotations (N, 3, 3) that cover SO(3) modulo the group, and the upright ones."""
    if symmetry.sphere:
        return np.eye(3)[None]
    spread = 2 if symmetry.axis is not None else 1
    grid = _super_fibonacci(GRID)
    if up is not None:
        turns = Rotation.from_rotvec(
            np.outer(2 * np.pi * np.arange(UPRIGHT) / UPRIGHT, (0, 0, 1))
        ).as_matrix()
        grid = np.concatenate([_standing(up) @ turns, grid])
    # one of each set of equivalent rotations: those nearest to what was kept already
    kept: list[np.ndarray] = []
    spacing = 12.0 * spread
    for rotation in grid:
        if (
            symmetry.trivial
            or not kept
            or symmetry.rotation_error_deg(np.array(kept), rotation).min() > spacing
        ):
            kept.append(rotation)
    return np.array(kept)


def same_pose(mesh: ObjectMesh, a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two poses (4, 4) are one, up to symmetry and a small difference."""
    angle = float(mesh.symmetry.rotation_error_deg(a[:3, :3], b[:3, :3]))
    centre = mesh.centre_of_mass
    shift = (a[:3, :3] @ centre + a[:3, 3]) - (b[:3, :3] @ centre + b[:3, 3])
    return angle < SAME_POSE_DEG and float(np.linalg.norm(shift)) < SAME_POSE_M


def _super_fibonacci(count: int) -> np.ndarray:
    """Evenly spread rotations (count, 3, 3): Alexa, Super-Fibonacci Spirals, CVPR 2022."""
    phi, psi = np.sqrt(2.0), 1.533751168755204288118041
    s = np.arange(count) + 0.5
    r, big_r = np.sqrt(s / count), np.sqrt(1 - s / count)
    alpha, beta = 2 * np.pi * s / phi, 2 * np.pi * s / psi
    quaternions = np.stack(
        [r * np.sin(alpha), r * np.cos(alpha), big_r * np.sin(beta), big_r * np.cos(beta)], 1
    )
    return Rotation.from_quat(quaternions).as_matrix()


def _standing(up: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) that takes the object's z axis to ``up``."""
    z = up / np.linalg.norm(up)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], 1)


def _clusters(views: list[View], diameter: float, labels: tuple[str, ...]) -> list[_Cluster]:
    """The measured points of every candidate that could be the object."""
    found = []
    for number, view in enumerate(views):
        geometry = view.geometry
        if view.depth is None or geometry.depth_lens is None:
            continue
        candidates = [c for c in view.candidates if c.label not in PERSON_LABELS and c.mask.area]
        if not candidates:
            continue
        stride = max(1, 2 // geometry.depth_step)
        depth = view.depth[::stride, ::stride]
        rays = geometry.depth_lens.rays[::stride, ::stride]
        valid = (depth > 0) & np.isfinite(rays[..., 0])
        depth, rays = depth[valid], rays[valid]
        local = np.column_stack([rays * depth[:, None], depth])
        camera = geometry.camera
        assert camera.colour_from_depth is not None
        pixel = np.rint(geometry.lens.project(apply(camera.colour_from_depth, local))).astype(int)
        for candidate in candidates:
            inside = np.flatnonzero(candidate.mask.sample(pixel[:, 0], pixel[:, 1]))
            if len(inside) < MIN_POINTS:
                continue
            z = depth[inside]
            inside = inside[np.abs(z - np.median(z)) < 0.75 * diameter]
            points = apply(camera.master_from_depth, local[inside]).astype(np.float64)
            centre = np.median(points, axis=0)
            spread = np.percentile(np.linalg.norm(points - centre, axis=1), 90)
            if len(points) < MIN_POINTS or spread > 0.75 * diameter:
                continue
            likely = not labels or candidate.label in labels
            found.append(_Cluster(number, candidate, points, centre, likely))
    return found


def _join(
    mesh: ObjectMesh, clusters: list[_Cluster], near: np.ndarray | None
) -> list[list[_Cluster]]:
    """Groups of clusters, at most one a view, that may be one object: the most likely first."""
    groups: list[tuple[float, list[_Cluster]]] = []
    for anchor in clusters:
        group = [anchor]
        for view in sorted({c.view for c in clusters} - {anchor.view}):
            others = [c for c in clusters if c.view == view]
            distances = [float(np.linalg.norm(c.centre - anchor.centre)) for c in others]
            nearest = int(np.argmin(distances))
            if distances[nearest] < 0.6 * mesh.diameter + 0.03:
                group.append(others[nearest])
        value = sum(1.0 if c.likely else 0.5 for c in group)
        if near is not None:
            value -= 2.0 * float(np.linalg.norm(anchor.centre - near))
        groups.append((value, group))
    groups.sort(key=lambda item: -item[0])
    kept: list[list[_Cluster]] = []
    for _, group in groups:
        if len(kept) == MAX_GROUPS:
            break
        members = {(c.view, c.candidate.index) for c in group}
        known = [{(c.view, c.candidate.index) for c in other} for other in kept]
        if all(len(members & other) <= 0.5 * len(members) for other in known):
            kept.append(group)
    return kept


def _thinned(group: list[_Cluster]) -> list[np.ndarray]:
    """The same number of points, at most, of each view's cluster."""
    share = CLOUD_POINTS // len(group)
    return [
        c.points[np.linspace(0, len(c.points) - 1, min(share, len(c.points))).astype(int)]
        for c in group
    ]


def _eyes(group: list[_Cluster], views: list[View], cloud: list[np.ndarray]) -> np.ndarray:
    """The camera centre (N, 3) that measured each point of the joined cloud."""
    centres = [views[c.view].geometry.camera.master_from_depth[:3, 3] for c in group]
    return np.concatenate(
        [np.broadcast_to(eye, part.shape) for eye, part in zip(centres, cloud, strict=True)]
    )


def _align(
    mesh: ObjectMesh,
    field: DistanceField,
    parts: list[np.ndarray],
    eyes: np.ndarray,
    rotations: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """ICP of all rotations at once: poses (N, 4, 4) and robust mean residual (N,) in metres."""
    cloud = np.concatenate(parts)
    count = len(rotations)
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    middle = (area[:, None] * (a + b + c) / 3).sum(0) / area.sum()
    # the mean of the views' means: a near view holds more points but not more of the object
    centre = np.mean([part.mean(0) for part in parts], axis=0)
    rotation = rotations.copy()
    translation = centre - rotation @ middle
    scales = np.geomspace(*ICP_SCALES_M, ICP_STEPS)
    residual = np.zeros(count)
    for scale in [*scales, scales[-1]]:
        local = np.einsum("nji,npj->npi", rotation, cloud[None] - translation[:, None])
        closest = field.closest(local.reshape(-1, 3))
        points = closest.points.reshape(count, -1, 3)
        normals = closest.normals.reshape(count, -1, 3)
        gap = local - points
        along = (gap * normals).sum(-1)
        distance = np.linalg.norm(gap, axis=-1)
        # a measured point cannot lie on a face that looks away from the camera
        to_eye = np.einsum("nji,npj->npi", rotation, (eyes - cloud)[None])
        facing = (to_eye * normals).sum(-1) > 0
        weight = (scale**2 / (scale**2 + distance**2)) ** 2 * np.where(facing, 1.0, 0.1)
        cost = np.where(facing, distance, np.maximum(distance, 0.01))
        residual = np.minimum(cost, 0.05).mean(1)
        jacobian = np.concatenate([np.cross(local, normals), normals], -1)
        weighted = jacobian * weight[..., None]
        hessian = np.einsum("npi,npj->nij", weighted, jacobian)
        gradient = np.einsum("npi,np->ni", weighted, along)
        hessian += 1e-3 * np.einsum("nii,ij->nij", hessian, np.eye(6)) + 1e-6 * np.eye(6)
        step = np.linalg.solve(hessian, gradient[..., None])[..., 0]
        limit = np.maximum(1.0, np.linalg.norm(step[:, :3], axis=1) / np.radians(15))
        limit = np.maximum(limit, np.linalg.norm(step[:, 3:], axis=1) / 0.05)
        step /= limit[:, None]
        # the step moves the object in its own frame: pose <- pose * exp(step)
        translation = translation + np.einsum("nij,nj->ni", rotation, step[:, 3:])
        rotation = rotation @ Rotation.from_rotvec(step[:, :3]).as_matrix()
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = rotation
    poses[:, :3, 3] = translation
    return poses, residual


def _distinct(mesh: ObjectMesh, poses: np.ndarray, order: np.ndarray, count: int) -> list[int]:
    """The first ``count`` poses of ``order`` that are not the same as one before."""
    kept: list[int] = []
    for index in order:
        if not any(same_pose(mesh, poses[index], poses[other]) for other in kept):
            kept.append(int(index))
            if len(kept) == count:
                break
    return kept
