"""Warnings about the mesh and the labels of the object, before and after tracking.

Before tracking: whether the detector knows the object's class, and whether the mesh has the size of
the detected object. A mesh in decimetres passes every check of the file alone. Depth under a
candidate's mask converts the mask's extent from pixels to metres. After tracking: whether the
images show this mesh, in this size, with this symmetry.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from intercap_core.formats.detections.read import Detections
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.clouds import depth_points
from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.turns import NEAR_TURN_CHANGED_SHARE, changed_share
from intercap_core.object_track.whole import FrameResult


def label_doubt(detections: Detections, labels: tuple[str, ...]) -> str | None:
    """Return a warning if candidates have labels but none of ``labels``, else None.

    The detector may number its classes in another way. Since labels may be wrong, the object is
    searched for nevertheless.
    """
    counts = Counter(
        candidate.label
        for t in range(detections.num_sets)
        for c in range(len(detections.camera_names))
        for candidate in detections.candidates(t, c)
        if candidate.label
    )
    if not labels or not counts or counts.keys() & {*labels}:
        return None
    often = sorted(counts, key=lambda label: (-counts[label], label))
    more = f" and {len(often) - 8} more" if len(often) > 8 else ""
    named = ", ".join(f"{label} ({counts[label]})" for label in often[:8])
    return (
        f"no candidate has one of its labels ({', '.join(labels)}), found {named}{more}; add the "
        "label to objects.yaml, or set detections.category_names"
    )


def size_doubt(
    frames: Frames, detections: Detections, diameter_m: float, labels: tuple[str, ...]
) -> str | None:
    """Return a warning if the mesh is several times larger or smaller than the detected object.

    Args:
        frames: the recording.
        detections: candidates of the recording.
        diameter_m: diameter of the mesh, metres.
        labels: detector classes of the object.

    Returns:
        The warning. None if the size fits, if no candidate has one of the labels, or if too few
        candidates lie on measured depth.
    """
    sets = np.linspace(0, frames.num_sets - 1, 6).round().astype(int)
    extents = [
        extent
        for t in np.unique(sets).tolist()
        for c in range(len(frames.rig))
        for extent in _extents(frames, detections, t, c, labels)
    ]
    if len(extents) < 5:
        return None
    # Masks are smaller if the object is seen end on or partly hidden, and larger if they cover the
    # person too. A wrong unit is a factor of ten.
    largest, smallest = np.percentile(extents, [90, 25])
    if smallest <= 4.0 * diameter_m and diameter_m <= 4.0 * largest:
        return None
    typical = float(np.median(extents))
    word = "large" if diameter_m > typical else "small"
    ratio = max(diameter_m / typical, typical / diameter_m)
    return (
        f"the mesh is {diameter_m:.3g} m across, and candidates labelled {' or '.join(labels)} "
        f"measure {typical:.2g} m ({len(extents)} masks on depth): {ratio:.2g} times too {word}; "
        "check the mesh's unit, or the labels"
    )


def _extents(
    frames: Frames, detections: Detections, t: int, c: int, labels: tuple[str, ...]
) -> list[float]:
    """Return the diagonals, metres, of the candidates of one image that lie on measured depth."""
    camera = frames.rig[c]
    candidates = [item for item in detections.candidates(t, c) if item.label in labels]
    if not candidates or camera.depth is None or camera.colour_from_depth is None:
        return []
    depth = frames.depth(t, c)
    if depth is None:
        return []
    every_third = np.arange(depth.size).reshape(depth.shape)[::3, ::3].ravel()
    points = apply(camera.colour_from_depth, depth_points(depth, camera, every_third).points)
    pixels = np.rint(camera.colour.project(points)).astype(np.int64)
    extents = []
    for candidate in candidates:
        under = candidate.runs.sample(pixels[:, 0], pixels[:, 1])
        if under.sum() >= 8:
            _, _, width, height = candidate.runs.box
            away = float(np.median(points[under, 2]))
            diagonal = float(np.hypot(width / camera.colour.fx, height / camera.colour.fy))
            extents.append(diagonal * away)
    return extents


def mesh_doubts(observer: Observer, frames: list[FrameResult]) -> list[str]:
    """Return warnings about the mesh by the final track of T ``frames``."""
    believed = [t for t, frame in enumerate(frames) if not (frame.lost or frame.carried)]
    doubts = []
    if believed:
        likely = float(np.median([frames[t].fit.log_ratio for t in believed]))
        # Measured on the studio: wrong meshes of similar size have 5 to 19 nats, right ones 40 to
        # 100, a cup at twice the noise 14.
        if likely < 10:
            doubts.append(
                "the images hardly support this mesh (median log-likelihood ratio "
                f"{likely:.0f}, expected at least 10); check that it is this object"
            )
    return doubts + _scale_doubt(observer, frames, believed) + symmetry_doubt(observer)


def symmetry_doubt(observer: Observer) -> list[str]:
    """Return a warning if a declared symmetry changes the mesh."""
    mesh = observer.mesh
    worst = max(
        (changed_share(mesh, observer.field, s) for s in mesh.symmetry.elements(8)[1:]), default=0.0
    )
    if mesh.symmetry.sphere or worst < NEAR_TURN_CHANGED_SHARE:
        return []
    return [
        f"its symmetry moves {worst:.0%} of the surface elsewhere; check 'symmetry' in objects.yaml"
    ]


def _scale_doubt(observer: Observer, frames: list[FrameResult], believed: list[int]) -> list[str]:
    """Return a warning if a larger or smaller mesh fits the surest frames clearly better."""
    surest = sorted(believed, key=lambda t: -frames[t].fit.log_ratio)[:6]
    if not surest:
        return []

    fits = {t: frames[t].fit for t in surest}

    def fitted_ratio(observer: Observer) -> float:
        again = [observer.fit(t, fit.pose, None, twist=fit.twist) for t, fit in fits.items()]
        return float(np.mean([fit.log_ratio for fit in again]))

    believed_ratio = float(np.mean([fit.log_ratio for fit in fits.values()]))
    gains = {}
    for scale in (0.9, 1.1):
        scaled = observer.with_mesh(scale_mesh(observer.mesh, scale))
        # A mesh that is 10 nats worse before its fit is not fitted: the size is right.
        assessed = [scaled.assess(t, fit.pose, fit.twist).log_ratio for t, fit in fits.items()]
        if np.mean(assessed) > believed_ratio - 10:
            gains[scale] = fitted_ratio(scaled) - fitted_ratio(observer)
    # Nats per frame, measured on the studio: a tenth costs most objects 20. Masks that are too
    # small in all views make a bottle look a tenth smaller by 6.
    if max(gains.values(), default=0.0) < 8:
        return []
    scale = max(gains, key=lambda scale: gains[scale])
    word = "larger" if scale > 1 else "smaller"
    return [
        f"the images fit a mesh {abs(scale - 1):.0%} {word} better (log-likelihood ratio larger by "
        f"{gains[scale]:.0f} per frame); check the mesh's size"
    ]


def scale_mesh(mesh: ObjectMesh, scale: float) -> ObjectMesh:
    """Scale the mesh about its centre of mass."""
    centre = mesh.centre_of_mass
    return replace(mesh, vertices=centre + scale * (mesh.vertices - centre))
