"""False background removed: free space seen by another camera, and traces of the person.

A thing that stands in one place for most of a recording becomes background for a camera that never
measures anything behind it. Where the background of another camera lies farther on the same line of
sight, that camera has seen free space there (as in space carving), so the first one's background
cannot be part of the static scene. A person who stands still leaves false background in small
patches that lie inside the body for many moments.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.person.segmentation.constants import (
    BEHIND_AROUND_PX,
    BEHIND_M,
    BEHIND_PER_DEPTH,
    MIN_HOLE_PX,
    MIN_SURFACE_PX,
    SMOOTH_MM,
    TRACE_MARGINS,
    TRACE_SHARE,
)
from intercap_core.person.segmentation.foreground import DepthBackground, DepthView
from intercap_core.person.segmentation.person_volume import outside

_UNKNOWN = np.uint16(0)


def without_free_space(
    views: list[DepthView],
    backgrounds: list[DepthBackground],
    low: np.ndarray,
    high: np.ndarray,
) -> list[DepthBackground]:
    """The backgrounds without pixels whose points lie in free space of another camera.

    Only points in the box ``low`` to ``high`` (3,), metres, z up, are tested. A pixel becomes
    unknown where the point lies clearly before the other background, in patches of several pixels.
    """
    nearest = [
        cv2.erode(background.depth, np.ones((BEHIND_AROUND_PX, BEHIND_AROUND_PX), np.uint8))
        for background in backgrounds
    ]
    result = []
    for number, (view, background) in enumerate(zip(views, backgrounds, strict=True)):
        index = np.flatnonzero(background.depth)
        points, _ = view.points(background.depth, index)
        inside = ((points > low) & (points < high)).all(1)
        index, points = index[inside], points[inside]
        gone: np.ndarray = np.zeros(background.depth.shape, np.uint8)
        for other, far in enumerate(nearest):
            if other != number:
                gone.ravel()[index[_occludes_background(views[other], far, points)]] = 1
        block = np.ones((MIN_HOLE_PX, MIN_HOLE_PX), np.uint8)
        closed = cv2.morphologyEx(gone, cv2.MORPH_CLOSE, block)
        whole = cv2.morphologyEx(closed, cv2.MORPH_OPEN, block)
        result.append(_with_unknown(background, whole > 0))
    return result


def without_person_traces(
    view: DepthView, background: DepthBackground, bodies: list[np.ndarray]
) -> DepthBackground:
    """The background without small patches that lay inside the person for much of the time.

    ``bodies``: bones (B, 9) of :func:`.person_volume.bones_of` at some moments, view's frame.
    """
    depth = background.depth
    block = np.ones((3, 3), np.uint8)
    nearest = cv2.erode(depth.astype(np.float32), block)
    farthest = cv2.dilate(depth.astype(np.float32), block)
    smooth = ((nearest > 0) & (farthest - nearest < SMOOTH_MM)).view(np.uint8)
    _, label, stats, _ = cv2.connectedComponentsWithStats(smooth, connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= MIN_SURFACE_PX
    large[0] = False
    surface = cv2.dilate(large[label].view(np.uint8), block) > 0
    index = np.flatnonzero((depth > 0) & ~surface & (depth <= background.reach))
    points, _ = view.points(depth, index)
    inside = np.zeros(len(index))
    for bones in bodies:
        inside += outside(points, bones) < TRACE_MARGINS
    trace = np.zeros(depth.shape, bool)
    trace.ravel()[index[inside > TRACE_SHARE * len(bodies)]] = True
    return _with_unknown(background, trace)


def _with_unknown(background: DepthBackground, gone: np.ndarray) -> DepthBackground:
    taken = gone & (background.depth > 0)
    depth = np.where(taken, _UNKNOWN, background.depth)
    limit = np.where(taken, background.reach, background.limit)
    return replace(background, depth=depth, limit=limit)


def _occludes_background(view: DepthView, nearest: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether points (N, 3) lie clearly nearer than the background ``nearest`` (H, W) mm of a view:
    (N,) bool."""
    lens = view.camera.depth
    assert lens is not None
    local = apply(invert(view.target_from_depth), points)
    seen = lens.sees(local)
    column, row = np.rint(np.where(seen[:, None], lens.project(local), 0)).astype(int).T
    column, row = np.clip(column, 0, lens.width - 1), np.clip(row, 0, lens.height - 1)
    behind = nearest[row, column] * np.float32(1e-3) - view.bias_m
    z = local[:, 2]
    return seen & (nearest[row, column] > 0) & (behind > z + BEHIND_M + BEHIND_PER_DEPTH * z)
