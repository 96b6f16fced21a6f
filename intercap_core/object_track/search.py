"""Find the object's pose in a frame set with nothing to start from.

Candidates of different views are joined where they lie together; rotations from a grid over SO(3)
modulo the symmetry group are aligned to what they show, points or silhouettes; the best are
rendered and compared with every view, and the best of those are fitted.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.formats.detections.instance import PERSON_LABEL
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import Renderer
from intercap_core.geometry.rigid.symmetry import SymmetryGroup
from intercap_core.object_track.alignment import align
from intercap_core.object_track.constants import (
    ASSESS_MIN_OVERLAP,
    FULL_SEARCH,
    GRID_ROTATIONS,
    GRID_SPACING_DEG,
    HOPELESS_LOG_RATIO,
    NEAR_SEARCH,
    OWN_TURN_STEPS,
    SAME_AXIS_COSINE,
    SAME_POSE_DEG,
    SAME_POSE_M,
    SEARCH_GOOD_LOG_RATIO,
    SEARCH_MIN_OVERLAP,
    SEEN_LOG_RATIO,
    TRUSTED_PLACE,
    TURNS_FITTED,
    UPRIGHT_TURNS,
)
from intercap_core.object_track.fit import Fit, assess_all, fit_pose
from intercap_core.object_track.groups import centre_of, find_groups
from intercap_core.object_track.motion import about
from intercap_core.object_track.view import View


def search(
    mesh: ObjectMesh,
    field: DistanceField,
    views: list[View],
    *,
    labels: tuple[str, ...],
    up: np.ndarray | None,
    min_overlap: float,
    background_term: bool,
    place_prior: Callable[[np.ndarray], float] | None = None,
    rotations: np.ndarray | None = None,
    motion: tuple[np.ndarray, np.ndarray] | None = None,
    renderer: Renderer | None = None,
) -> list[Fit]:
    """Fitted hypotheses of the pose, the likeliest first; none where nothing is detected.

    ``field`` is the mesh's distance field; ``labels`` are the detector classes that the object may
    be given (empty: any but a person); ``up`` (3,) is the vertical in the master frame, to try the
    standing poses more finely; ``place_prior`` says of a place (3,) how likely what is there is the
    object, 0 to 1; ``rotations`` (N, 3, 3) are tried alone where they are known roughly;
    ``motion`` is a twist (6,) of the object in a second, see :func:`.fit.fit_pose`, and the point
    (3,) that moves by it; ``renderer`` draws, None = the CPU.
    """

    def fitted(starts: list[Fit], best: float = SEEN_LOG_RATIO) -> list[Fit]:
        """Fits from the starts, the likeliest first, those left out that are hopeless beside the
        ``best`` known."""
        fits: list[Fit] = []
        for start in starts:
            best = max([best, *(fit.log_ratio for fit in fits)])
            if start.log_ratio > best - HOPELESS_LOG_RATIO:
                fits.append(
                    fit_pose(
                        mesh,
                        views,
                        start.pose,
                        prior=None,
                        min_overlap=min(min_overlap, SEARCH_MIN_OVERLAP),
                        background_term=background_term,
                        labels=labels,
                        twist=start.twist,
                        renderer=renderer,
                    )
                )
        return fits

    def compared(poses: np.ndarray) -> list[Fit]:
        found = assess_all(
            mesh,
            views,
            poses,
            min_overlap=ASSESS_MIN_OVERLAP,
            labels=labels,
            twists=None
            if motion is None
            else np.array([about(*motion, pose[:3, 3]) for pose in poses]),
            renderer=renderer,
        )
        return sorted(found, key=lambda fit: -fit.log_ratio)

    known = rotations is not None
    number_compared, number_fitted = NEAR_SEARCH if known else FULL_SEARCH
    if rotations is None:
        rotations = rotation_grid(mesh.symmetry, up)
    found: list[Fit] = []
    for group in find_groups(mesh, views, labels, place_prior):
        poses = align(mesh, field, group, views, rotations)
        here = fitted(compared(_distinct(mesh, poses, number_compared))[:number_fitted])
        found += here
        trusted = place_prior is None or place_prior(centre_of(group)) > TRUSTED_PLACE
        if trusted and any(fit.log_ratio > SEARCH_GOOD_LOG_RATIO for fit in here):
            break
    found.sort(key=lambda fit: -fit.log_ratio)
    if found and not known and not mesh.symmetry.sphere:
        # a mug looks much the same with its handle elsewhere, a box from its back
        turned = compared(found[0].pose @ own_turns(mesh, OWN_TURN_STEPS))[:TURNS_FITTED]
        found += fitted(turned, found[0].log_ratio)
        found.sort(key=lambda fit: -fit.log_ratio)
    kept: list[Fit] = []
    for fit in found:
        if not any(same_pose(mesh, fit.pose, other.pose) for other in kept):
            kept.append(fit)
    return kept


def own_turns(mesh: ObjectMesh, steps: int) -> np.ndarray:
    """Turns (N, 4, 4) of the object about the axes of its frame and its principal axes.

    ``steps`` angles a full turn; those that the symmetry group holds anyway are left out. They
    turn about the middle of its box, where a turned silhouette covers the old one best.
    """
    centre = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
    found = []
    for axis in own_axes(mesh):
        for angle in 2 * np.pi * np.arange(1, steps) / steps:
            turn = np.eye(4)
            turn[:3, :3] = Rotation.from_rotvec(angle * axis).as_matrix()
            turn[:3, 3] = centre - turn[:3, :3] @ centre
            if not same_pose(mesh, turn, np.eye(4)):
                found.append(turn)
    return np.array(found).reshape(-1, 4, 4)


def own_axes(mesh: ObjectMesh) -> np.ndarray:
    """Unit vectors (N, 3): the axes of the object's frame and its principal axes if others."""
    _, principal = np.linalg.eigh(np.cov(mesh.vertices.T))
    new = np.abs(principal).max(0) < SAME_AXIS_COSINE  # a mug's handle tilts them
    return np.concatenate([np.eye(3), principal[:, new]], 1).T


def rank_frames(labels_by_view: list[list[list[str]]], labels: tuple[str, ...]) -> list[int]:
    """Frames in the order in which to search them.

    ``labels_by_view`` [T][C][candidates] are the candidates' labels. Frames in which more views
    hold a likely label come first; among equals those far from the ones taken already.
    """
    count = len(labels_by_view)
    support = np.array(
        [
            sum(
                any((label in labels) if labels else (label != PERSON_LABEL) for label in view)
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


def rotation_grid(symmetry: SymmetryGroup, up: np.ndarray | None) -> np.ndarray:
    """Rotations (N, 3, 3) that cover SO(3) modulo the group, and the upright ones."""
    if symmetry.sphere:
        return np.eye(3)[None]
    spread = 2 if symmetry.axis is not None else 1
    grid = _super_fibonacci(GRID_ROTATIONS)
    if up is not None:
        turns = Rotation.from_rotvec(
            np.outer(2 * np.pi * np.arange(UPRIGHT_TURNS) / UPRIGHT_TURNS, (0, 0, 1))
        ).as_matrix()
        grid = np.concatenate([_standing(up) @ turns, grid])
    # one of each set of equivalent rotations: those nearest to what was kept already
    kept: list[np.ndarray] = []
    spacing = GRID_SPACING_DEG * spread
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
    limits: tuple[float, float] = (SAME_POSE_M, SAME_POSE_DEG),
) -> bool:
    """Whether two poses (4, 4) are one, up to symmetry and a difference of ``limits``, metres and
    degrees."""
    angle = float(mesh.symmetry.rotation_error_deg(a[:3, :3], b[:3, :3]))
    shift = float(np.linalg.norm(mesh.centre_at(a) - mesh.centre_at(b)))
    return shift < limits[0] and angle < limits[1]


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


def _distinct(mesh: ObjectMesh, poses: np.ndarray, count: int) -> np.ndarray:
    """The first ``count`` of the poses (N, 4, 4) that are not the same as one before."""
    kept: list[np.ndarray] = []
    for pose in poses:
        if not any(same_pose(mesh, pose, other) for other in kept):
            kept.append(pose)
            if len(kept) == count:
                break
    return np.array(kept)
