"""What moves before the background, as surfaces with the speed at which each point moves.

The person and the object stand where no furniture does, in the middle of the ring, and are seen
from all sides: they tie cameras together that share no background. Since they move, they also
tell *when* each camera exposed: between two cameras a surface is displaced by its speed along the
normal times the difference of their exposures.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Rig
from intercap_core.scene.background import Background
from intercap_core.scene.constants import (
    BEFORE_BACKGROUND_MM,
    BEFORE_BACKGROUND_SHARE,
    MOVING_CELL_M,
    MOVING_MAX_DEPTH_M,
    MOVING_MOMENTS,
    MOVING_SEARCH_M,
    MOVING_SEARCHES,
    NEIGHBOUR_PIXEL_STEP,
)
from intercap_core.scene.surface import Surface, surface_of


def moving_surfaces(
    frames: Frames, rig: Rig, image_of: np.ndarray, backgrounds: list[Background | None]
) -> list[dict[int, Surface]]:
    """The moving surfaces of up to :data:`MOVING_MOMENTS` sets, by camera index, depth frame.

    ``rig`` has the lenses; ``image_of`` (T, C): the set whose image of a camera shows each set's
    moment, -1 = none. Surfaces whose speed cannot be told, for want of a set before or after, are
    left out.
    """
    depth_image = _with_depth(frames, image_of)
    whole = np.zeros(depth_image.shape, bool)  # (T, C) with the sets before and after
    whole[1:-1] = (depth_image[:-2] >= 0) & (depth_image[1:-1] >= 0) & (depth_image[2:] >= 0)
    usable = np.flatnonzero(whole.sum(1) >= 2)
    if len(usable) > MOVING_MOMENTS:
        usable = usable[np.linspace(0, len(usable) - 1, MOVING_MOMENTS).round().astype(int)]
    found = []
    for t in usable:
        at_once = {}
        for c in np.flatnonzero(whole[t]):
            background, lens = backgrounds[c], rig[int(c)].depth
            if background is None or lens is None:
                continue
            images = [frames.depth(int(depth_image[k, c]), int(c)) for k in (t - 1, t, t + 1)]
            gaps = frames.time_s[[t, t + 1]] - frames.time_s[[t - 1, t]]
            surface = _moving(images, background, lens, gaps)
            if len(surface):
                at_once[int(c)] = surface
        if len(at_once) >= 2:
            found.append(at_once)
    return found


def _with_depth(frames: Frames, image_of: np.ndarray) -> np.ndarray:
    """``image_of`` (T, C), -1 where that image has no depth."""
    available = frames.depth_available
    has = available[np.maximum(image_of, 0), np.arange(image_of.shape[1])]
    return np.where((image_of >= 0) & has, image_of, -1)


def _moving(
    images: list[np.ndarray | None], background: Background, lens: Intrinsics, gaps: np.ndarray
) -> Surface:
    """The surface of the middle one of three depth images, ``gaps`` (2,) seconds apart."""
    before, now, after = (_foreground(image, background) for image in images)
    surface = surface_of(
        now, lens, window=_box(now), cell_m=MOVING_CELL_M, max_depth_m=MOVING_MAX_DEPTH_M
    )
    if not len(surface):
        return surface
    earlier = _along_normals(surface, _points(before, lens))
    later = _along_normals(surface, _points(after, lens))
    speed = (later - earlier) / gaps.sum()
    return replace(surface, speed=speed).subset(np.flatnonzero(np.isfinite(speed)))


def _foreground(image: np.ndarray | None, background: Background) -> np.ndarray:
    """The depth image (H, W) uint16 mm where it is in front of the background, 0 elsewhere."""
    assert image is not None
    behind = background.depth
    limit = behind * (1 - BEFORE_BACKGROUND_SHARE) - BEFORE_BACKGROUND_MM
    return np.where((behind == 0) | (image < limit), image, 0).astype(np.uint16)


def _box(image: np.ndarray) -> tuple[slice, slice]:
    rows, columns = np.flatnonzero(image.any(1)), np.flatnonzero(image.any(0))
    if not len(rows):
        return slice(0, 1), slice(0, 1)
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def _points(image: np.ndarray, lens: Intrinsics) -> np.ndarray:
    thin = np.s_[::NEIGHBOUR_PIXEL_STEP, ::NEIGHBOUR_PIXEL_STEP]
    z = image[thin].astype(np.float64) * 1e-3
    keep = (z > 0) & (z < MOVING_MAX_DEPTH_M + 0.3)
    points = np.column_stack([lens.rays[thin][keep] * z[keep, None], z[keep]])
    return points[np.isfinite(points).all(1)]


def _along_normals(surface: Surface, points: np.ndarray) -> np.ndarray:
    """How far along its normal each point's surface has gone (N,), metres; NaN = not found.

    The nearest point is nearer than the one on the normal: it is sought again from where the last
    one puts the surface.
    """
    away, lost = np.zeros(len(surface)), np.zeros(len(surface), bool)
    if not len(points):
        return np.full(len(surface), np.nan)
    tree = cKDTree(points, balanced_tree=False)
    for _ in range(MOVING_SEARCHES):
        sought = surface.points + away[:, None] * surface.normals
        distance, nearest = tree.query(sought, distance_upper_bound=MOVING_SEARCH_M)
        lost |= ~np.isfinite(distance)
        offset = points[np.where(lost, 0, nearest)] - surface.points
        away = np.where(lost, 0.0, (offset * surface.normals).sum(1))
        lost |= np.abs(away) > MOVING_SEARCH_M
    return np.where(lost, np.nan, away)
