"""Things that never move: components of the static scene above the floor, near the person's path.

A chair that is sat on, a mug left on its table: they cannot be told from furniture, so every
connected component of the background that the person comes near is a candidate. What stands on a
level surface (a table) is segmented from it by height.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.person.segmentation.constants import (
    ABOVE_M,
    LARGEST_M,
    LAYER_M,
    LEVEL_SHARE,
    MAX_DISTANCE_POINTS,
    MAX_STATIC_THINGS,
    MIN_STATIC_POINTS,
    STATIC_CELL_M,
    SURFACE_CELL_M,
    SURFACE_POINTS,
    VISITED_CELL_M,
    WITHIN_REACH_M,
)
from intercap_core.person.segmentation.foreground import DepthBackground, DepthView
from intercap_core.person.segmentation.voxels import Occupied, components


@dataclass(frozen=True, eq=False)
class Thing:
    """A component of the static scene.

    ``extent_m`` its size, ``away_m`` from the nearest place of the person; ``on_top``: it was taken
    off another one; ``carries``: it is one off which something was taken. ``pixels`` are the flat
    depth pixels of each view's background that show it, ``cells`` where it is.
    """

    extent_m: float
    away_m: float
    on_top: bool
    carries: bool
    pixels: list[np.ndarray]
    cells: Occupied


@dataclass(frozen=True, eq=False)
class StaticScene:
    """The things, and ``surface``: where the scene is known to be, whichever view tells."""

    things: list[Thing]
    surface: Occupied


def find_static_things(
    views: list[DepthView],
    backgrounds: list[DepthBackground],
    low: np.ndarray,
    high: np.ndarray,
    joints: np.ndarray,
) -> StaticScene:
    """Components of the solid background in the box ``low`` to ``high`` (3,), z up, metres.

    ``joints`` (N, 3) are places of the person's keypoints at any time, same frame.
    """
    parts, owner, index = [], [], []
    for number, (view, background) in enumerate(zip(views, backgrounds, strict=True)):
        flat = np.flatnonzero(background.depth)
        points, _ = view.points(background.depth, flat)
        inside = ((points > low) & (points < high)).all(1)
        parts.append(points[inside])
        index.append(flat[inside])
        owner.append(np.full(int(inside.sum()), number, np.int32))
    points = np.concatenate(parts) if parts else np.zeros((0, 3), np.float32)
    pixel = np.concatenate(index) if index else np.zeros(0, np.int64)
    view_of = np.concatenate(owner) if owner else np.zeros(0, np.int32)
    walked = np.unique(np.round(joints / VISITED_CELL_M), axis=0) * VISITED_CELL_M
    surface = Occupied(points, SURFACE_CELL_M, SURFACE_POINTS)
    things: list[Thing] = []

    def add(members: np.ndarray, on_top: bool, carries: bool) -> None:
        own = points[members]
        size, away = extent(own), _away(own, walked)
        if size < LARGEST_M and away < WITHIN_REACH_M:
            pixels = [pixel[members[view_of[members] == v]] for v in range(len(views))]
            cells = Occupied(own, SURFACE_CELL_M, SURFACE_POINTS)
            things.append(Thing(size, away, on_top, carries, pixels, cells))

    for members in components(points, STATIC_CELL_M, MIN_STATIC_POINTS):
        top = _above_level(points, members)
        above = [top[own] for own in components(points[top], STATIC_CELL_M, MIN_STATIC_POINTS)]
        add(members, False, bool(above))
        for standing in above:
            add(standing, True, False)
    things.sort(key=lambda thing: thing.away_m)
    return StaticScene(things[:MAX_STATIC_THINGS], surface)


def _away(points: np.ndarray, places: np.ndarray) -> float:
    """Smallest distance, metres, of points (N, 3) from places (M, 3)."""
    from scipy.spatial import cKDTree

    sample = points[:: max(1, len(points) // MAX_DISTANCE_POINTS)]
    return float(cKDTree(places).query(sample)[0].min()) if len(places) else np.inf


def _above_level(points: np.ndarray, members: np.ndarray) -> np.ndarray:
    """Members of a component above its highest large level surface; none without one."""
    height = points[members, 2]
    bottom = float(height.min())
    counts = np.bincount(((height - bottom) / LAYER_M).astype(int))
    level = np.flatnonzero(counts > LEVEL_SHARE * len(members))
    if not len(level):
        return members[:0]
    low = bottom + level[-1] * LAYER_M
    layer = height[(height >= low) & (height < low + LAYER_M)]
    return members[height > float(np.median(layer)) + ABOVE_M]


def extent(points: np.ndarray) -> float:
    """Length of the diagonal of the points' box (N, 3), the outermost two per cent left out."""
    low, high = np.percentile(points, (2, 98), axis=0)
    return float(np.linalg.norm(high - low))
