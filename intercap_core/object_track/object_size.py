"""Checks before tracking: whether the detector knows the object's class, and whether the mesh has
the size of the detected object.

A mesh in decimetres, or one scaled by mistake, passes every check of the file alone. Where depth
lies under a candidate's mask, the mask's extent in pixels is one in metres.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from intercap_core.formats.detections.read import Detections
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.masks import Runs
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply
from intercap_core.object_track.constants import (
    LABELS_TOLD,
    SIZE_CHECK_MIN_MASKS,
    SIZE_CHECK_MIN_POINTS,
    SIZE_CHECK_SETS,
    SIZE_CHECK_STRIDE,
    SIZE_DOUBTFUL_RATIO,
    SIZE_LARGEST_PERCENTILE,
    SIZE_SMALLEST_PERCENTILE,
)


def label_doubt(detections: Detections, labels: tuple[str, ...]) -> str | None:
    """Say in words that candidates have labels and none has one of ``labels``; else None.

    The detector's classes may be numbered in another way. Labels may be wrong, so the object is
    searched for all the same.
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
    more = f" and {len(often) - LABELS_TOLD} more" if len(often) > LABELS_TOLD else ""
    told = ", ".join(f"{label} ({counts[label]})" for label in often[:LABELS_TOLD])
    return (
        f"no candidate has one of its labels ({', '.join(labels)}), found {told}{more}; add the "
        "label to objects.yaml, or set detections.category_names"
    )


def size_doubt(
    frames: Frames, detections: Detections, rig: Rig, diameter_m: float, labels: tuple[str, ...]
) -> str | None:
    """Say in words that the mesh is several times larger or smaller than the object appears.

    ``diameter_m`` is the mesh's. None where it fits, where no candidate has one of ``labels`` or
    where too few lie on measured depth.
    """
    extents = [
        extent
        for t in np.unique(
            np.linspace(0, frames.num_sets - 1, SIZE_CHECK_SETS).round().astype(int)
        ).tolist()
        for c in range(len(rig))
        for extent in _extents(frames, detections, rig[c], t, c, labels)
    ]
    if len(extents) < SIZE_CHECK_MIN_MASKS:
        return None
    largest, smallest = np.percentile(extents, [SIZE_LARGEST_PERCENTILE, SIZE_SMALLEST_PERCENTILE])
    if smallest <= SIZE_DOUBTFUL_RATIO * diameter_m and diameter_m <= SIZE_DOUBTFUL_RATIO * largest:
        return None
    typical = float(np.median(extents))
    word = "large" if diameter_m > typical else "small"
    ratio = max(diameter_m / typical, typical / diameter_m)
    return (
        f"the mesh is {diameter_m:.3g} m across, and what is labelled {' or '.join(labels)} "
        f"measures {typical:.2g} m ({len(extents)} masks on depth): {ratio:.2g} times too {word}; "
        "check the mesh's unit, or the labels"
    )


def _extents(
    frames: Frames,
    detections: Detections,
    camera: Camera,
    t: int,
    c: int,
    labels: tuple[str, ...],
) -> list[float]:
    """Diagonals, metres, of the candidates of one image that lie on measured depth."""
    candidates = [one for one in detections.candidates(t, c) if one.label in labels]
    if not candidates or camera.depth is None or camera.colour_from_depth is None:
        return []
    depth = frames.depth(t, c)
    if depth is None:
        return []
    z = depth[::SIZE_CHECK_STRIDE, ::SIZE_CHECK_STRIDE] * np.float32(1e-3)
    rays = camera.depth.rays[::SIZE_CHECK_STRIDE, ::SIZE_CHECK_STRIDE]
    valid = (z > 0) & np.isfinite(rays[..., 0])
    local = np.column_stack([rays[valid] * z[valid][:, None], z[valid]])
    points = apply(camera.colour_from_depth, local)
    pixels = np.rint(camera.colour.project(points)).astype(np.int64)
    found = []
    for candidate in candidates:
        runs: Runs = candidate.runs
        under = runs.sample(pixels[:, 0], pixels[:, 1])
        if under.sum() >= SIZE_CHECK_MIN_POINTS:
            _, _, width, height = runs.box
            away = float(np.median(points[under, 2]))
            found.append(
                float(np.hypot(width / camera.colour.fx, height / camera.colour.fy)) * away
            )
    return found
