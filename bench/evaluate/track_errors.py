"""Errors of the artefact of stage ``object_track`` against truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from intercap_core import artefacts
from intercap_core.evaluation import motion, object_pose
from intercap_core.evaluation.known import Figures
from intercap_core.evaluation.object_errors import ObjectErrors
from intercap_core.evaluation.tracks import read_object
from intercap_core.evaluation.truth import match_times, object_errors
from intercap_core.geometry.camera.transforms import rotation_log
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.symmetry import SymmetryGroup
from intercap_core.schemas import OBJECT_TRACK, SCENE, TRUTH


def measure(scene: Path, object_track: Path, truth: Path, mesh: ObjectMesh) -> ObjectErrors:
    """Compare the artefact of stage ``object_track`` with the truth of its recording.

    Errors are infinite if the object was found in no frame. Raises UserError if an artefact
    cannot be read or the truth is of another recording.
    """
    track = read_object(object_track, "object_track")
    with artefacts.read(object_track, OBJECT_TRACK) as found:
        sequence = str(found.attributes["sequence"])
    with artefacts.read(scene, SCENE) as found, artefacts.read(truth, TRUTH) as true:
        fps = float(found.attributes["fps"])
        at = match_times(truth, true["times"], found["times"], fps)
        rotation, translation = true["rotation"][at], true["translation"][at]
        views = true["object_views"][at]
    errors = object_errors(rotation, translation, track, mesh, fps)
    true_centre = object_pose.posed_point(rotation, translation, mesh.centre_of_mass)
    normalised_turn = None
    add = worst = np.full(len(at), np.inf)
    if track.known:
        points = mesh.vertices[:: -(-len(mesh.vertices) // 500)]  # at most 500
        poses = (track.rotation, track.translation, rotation, translation)
        add = add_s(points, *poses) / mesh.diameter
        worst = mssd(points, *poses, mesh) / mesh.diameter
        if track.covariance is not None:
            normalised_turn = normalised_rotation_error(
                track.rotation, rotation, track.covariance, mesh.symmetry
            )
    return ObjectErrors(
        sequence=sequence,
        object_=mesh.name,
        fps=fps,
        translation=errors["object_translation"],
        rotation=errors["object_rotation"],
        turn=errors["object_turn"],
        centre=errors["object_centre"],
        true_centre=true_centre,
        views=views,
        moves=motion.moving(rotation, true_centre, fps),
        flagged=track.flagged,
        add_s=add,
        mssd=worst,
        normalised=errors.get("object_normalised"),
        normalised_turn=normalised_turn,
    )


def add_s(
    points: np.ndarray,
    rotation: np.ndarray,
    translation: np.ndarray,
    true_rotation: np.ndarray,
    true_translation: np.ndarray,
) -> np.ndarray:
    """ADD-S (T,), metres: mean distance of the true surface points from the nearest estimated
    point.

    Hinterstoisser et al., ACCV 2012. The ``points`` (N, 3), object frame, are moved by the poses,
    rotations (T, 3, 3) and translations (T, 3).
    """
    found = points @ np.swapaxes(rotation, 1, 2) + translation[:, None]
    true = points @ np.swapaxes(true_rotation, 1, 2) + true_translation[:, None]
    return np.array([cKDTree(f).query(t)[0].mean() for f, t in zip(found, true, strict=True)])


def mssd(
    points: np.ndarray,
    rotation: np.ndarray,
    translation: np.ndarray,
    true_rotation: np.ndarray,
    true_translation: np.ndarray,
    mesh: ObjectMesh,
) -> np.ndarray:
    """Maximum symmetry-aware surface distance (MSSD) (T,), metres.

    The maximal distance of corresponding points, minimised over the symmetry group (Hodan et al.,
    BOP challenge 2020). For a sphere it is the distance of the origins. Arguments as in
    :func:`add_s`.
    """
    if mesh.symmetry.sphere:
        return np.linalg.norm(translation - true_translation, axis=1)
    found = points @ np.swapaxes(rotation, 1, 2) + translation[:, None]
    best = np.full(len(found), np.inf)
    for element in mesh.symmetry.elements():
        moved = points @ element[:3, :3].T + element[:3, 3]
        true = moved @ np.swapaxes(true_rotation, 1, 2) + true_translation[:, None]
        best = np.minimum(best, np.linalg.norm(found - true, axis=2).max(1))
    return best


def by_views(recordings: Sequence[ObjectErrors]) -> dict[str, Figures]:
    """The main figures by the number of cameras that truly see the object: "0-1", "2", ... "6+"."""
    views, lost = (np.concatenate([getattr(r, k) for r in recordings]) for k in ("views", "lost"))
    shift, turn = (
        np.concatenate([getattr(r, k) for r in recordings]) for k in ("translation", "rotation")
    )
    found = {}
    for low, high in ((0, 1), (2, 2), (3, 3), (4, 4), (5, 5), (6, 99)):
        here = (views >= low) & (views <= high)
        if here.any():
            name = str(low) if low == high else f"{low}+" if high > 90 else f"{low}-{high}"
            found[name] = {
                "frames": float(here.sum()),
                "translation_median_mm": 1e3 * float(np.median(shift[here])),
                "rotation_median_deg": float(np.median(turn[here])),
                "lost_share": float(lost[here].mean()),
            }
    return found


def normalised_rotation_error(
    rotation: np.ndarray, true_rotation: np.ndarray, covariance: np.ndarray, symmetry: SymmetryGroup
) -> np.ndarray:
    """Mahalanobis length (T,) of the rotation error, divided by its expected median.

    The error is that to the nearest equivalent true rotation. Principal axes with a stated
    deviation above 30 degrees are undetermined and excluded; NaN if all are.

    Args:
        rotation, true_rotation: (T, 3, 3).
        covariance: (T, 6, 6), see :func:`normalised_translation_error`.
        symmetry: rotations that leave the object unchanged.
    """
    from scipy.stats import chi  # takes a second to import, which most processes do not need

    truly = symmetry.nearest_equivalent(true_rotation, rotation)
    error = rotation_log(rotation @ np.swapaxes(truly, 1, 2))
    result = np.full(len(error), np.nan)
    for t, block in enumerate(covariance[:, :3, :3]):
        if not np.isfinite(block).all():
            continue
        variance, axes = np.linalg.eigh(block)
        known = (variance > 0) & (variance < np.radians(30.0) ** 2)
        if known.any():
            length = np.sqrt(((error[t] @ axes[:, known]) ** 2 / variance[known]).sum())
            result[t] = length / chi(int(known.sum())).median()
    return result
