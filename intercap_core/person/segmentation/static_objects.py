"""Objects that never move: components of the static scene above the floor, near the person's path.

While they do not move, a chair or a mug on a table cannot be distinguished from furniture. Each
connected component of the background near the person is therefore a candidate. Objects on a level
surface (a table) are separated from it by height. Components are computed on a voxel grid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from scipy.spatial import cKDTree

from intercap_core.person.segmentation.foreground import DepthBackground, DepthView, in_box

CELL_M = 0.02  # side of the cells of a surface; a Kinect's points 4 m away are 8 mm apart
_BITS = 21  # bits of each coordinate in a cell's integer key


def components(points: np.ndarray, cell_m: float, min_points: int) -> list[np.ndarray]:
    """Connected components with at least ``min_points`` points, largest number of cells first.

    Points in the same or in adjacent cells (26-neighbourhood) belong to one component. Returns
    ascending indices into ``points`` (N, 3), metres, for each component.
    """
    if not len(points):
        return []
    occupied, inverse = np.unique(_keys(points, cell_m), return_inverse=True)
    label = _label_cells(occupied)
    component = label[inverse]  # (N,)
    sizes = np.bincount(component)
    ends = np.cumsum(sizes)
    members = np.argsort(component, kind="stable")
    largest_first = np.argsort(-np.bincount(label), kind="stable")
    large = largest_first[sizes[largest_first] >= min_points]
    return [members[ends[k] - sizes[k] : ends[k]] for k in large]


class OccupiedCells:
    """Cells with at least ``min_points`` of the points (N, 3), and cells that share a face with
    one."""

    def __init__(self, points: np.ndarray, cell_m: float, min_points: int) -> None:
        self._cell_m = cell_m
        keys, counts = np.unique(_keys(points, cell_m), return_counts=True)
        keys = keys[counts >= min_points]
        steps = [sign * (1 << axis * _BITS) for axis in range(3) for sign in (1, -1)]
        self._keys = np.unique(np.concatenate([keys, *(keys + step for step in steps)]))

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Mask (M,) of the points (M, 3) in these cells."""
        if not len(self._keys):
            return np.zeros(len(points), bool)
        keys = _keys(points, self._cell_m)
        at = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        return self._keys[at] == keys


def _keys(points: np.ndarray, cell_m: float) -> np.ndarray:
    """Integer key (N,) int64 of each point's cell: 21 bits for each of x, y and z.

    The key of a neighbouring cell differs by the same constant everywhere.
    """
    cells = np.floor(points * np.float32(1 / cell_m)).astype(np.int64) + (1 << (_BITS - 1))
    return (cells[:, 0] << (2 * _BITS)) | (cells[:, 1] << _BITS) | cells[:, 2]


@numba.njit(cache=True)
def _label_cells(keys: np.ndarray) -> np.ndarray:
    """Component (M,) of each cell, numbered in the order of first cells. ``keys``: (M,)
    ascending."""
    parent = np.arange(len(keys))  # a forest; the root of a component is its first cell
    # the 13 neighbours with smaller keys suffice: adjacency is symmetric
    for neighbour in range(13):
        x, y, z = neighbour // 9 - 1, neighbour // 3 % 3 - 1, neighbour % 3 - 1
        step = (x << 2 * _BITS) + (y << _BITS) + z
        other = 0
        for cell in range(len(keys)):
            while keys[other] < keys[cell] + step:
                other += 1
            if keys[other] == keys[cell] + step:
                one, two = _root(parent, cell), _root(parent, other)
                parent[max(one, two)] = min(one, two)
    label, count = np.empty_like(parent), 0
    for cell in range(len(keys)):
        if parent[cell] == cell:
            label[cell], count = count, count + 1
        else:
            label[cell] = label[parent[cell]]
    return label


@numba.njit(cache=True)
def _root(parent: np.ndarray, cell: int) -> int:
    """Root of the tree of a cell; shortens the path to it."""
    while parent[cell] != cell:
        parent[cell] = parent[parent[cell]]
        cell = parent[cell]
    return cell


@dataclass(frozen=True, eq=False)
class StaticObject:
    """A component of the static scene."""

    extent_m: float
    """Diagonal of its bounding box, metres."""
    away_m: float
    """Smallest distance to the person's path, metres."""
    on_top: bool
    """Stands on another component."""
    carries: bool
    """Has another component on it."""
    pixels: list[np.ndarray]
    """Flat pixel indices that show the object in the depth background of each view."""
    cells: OccupiedCells
    """Cells with its points."""


def find_static_objects(
    views: list[DepthView],
    backgrounds: list[DepthBackground],
    low: np.ndarray,
    high: np.ndarray,
    joints: np.ndarray,
) -> tuple[list[StaticObject], OccupiedCells]:
    """Find components of the background in the box ``low`` to ``high`` (3,), z up, metres.

    An object's bounding box has a diagonal below 2.2 m, and some of its points are closer than
    35 cm to the person's path.

    ``joints``: (N, 3) keypoints of the person at all times, same frame.

    Returns:
        At most eight possible objects, the closest to the person's path first.
        Cells in which any view measures the static scene.
    """
    parts, owner, index = [], [], []
    for number, (view, background) in enumerate(zip(views, backgrounds, strict=True)):
        flat = np.flatnonzero(background.depth)
        points, _ = view.points(background.depth, flat)
        inside = in_box(points, low, high)
        parts.append(points[inside])
        index.append(flat[inside])
        owner.append(np.full(int(inside.sum()), number, np.int32))
    points = np.concatenate(parts) if parts else np.zeros((0, 3), np.float32)
    pixel = np.concatenate(index) if index else np.zeros(0, np.int64)
    view_of = np.concatenate(owner) if owner else np.zeros(0, np.int32)
    # the person's path, on a grid of 10 cm
    walked = np.unique(np.round(joints / 0.10), axis=0) * 0.10
    objects: list[StaticObject] = []

    def occupied(own: np.ndarray) -> OccupiedCells:
        """Cells of the points ``own`` (N, 3); a single point may be a wrong measurement."""
        return OccupiedCells(own, CELL_M, 2)

    def connected(chosen: np.ndarray) -> list[np.ndarray]:
        """Components of the points with indices ``chosen``: their indices into ``points``.

        Cells are 2.5 cm wide, and a component has at least 60 points; tuned on the studio.
        """
        return [chosen[own] for own in components(points[chosen], 0.025, 60)]

    def add(members: np.ndarray, on_top: bool, carries: bool) -> None:
        """Append the component of points ``members`` to ``objects`` if size and distance fit."""
        own = points[members]
        size, away = box_diagonal(own), np.inf
        if len(walked):
            sample = own[:: max(1, len(own) // 2000)]
            away = float(cKDTree(walked).query(sample)[0].min())
        # largest size of an object that one person handles, and reach, metres; tuned on the studio
        if size < 2.2 and away < 0.35:
            pixels = [pixel[members[view_of[members] == v]] for v in range(len(views))]
            objects.append(StaticObject(size, away, on_top, carries, pixels, occupied(own)))

    for members in connected(np.arange(len(points))):
        above = connected(_above_level(points, members))
        add(members, False, bool(above))
        for standing in above:
            add(standing, True, False)
    objects.sort(key=lambda item: item.away_m)
    return objects[:8], occupied(points)


def _above_level(points: np.ndarray, members: np.ndarray) -> np.ndarray:
    """Members of a component above its highest level surface; none without a level surface.

    A level surface is a layer of 2 cm with more than 12 % of the component's points.

    ``members``: indices into ``points`` (N, 3), z up.
    """
    height = points[members, 2]
    bottom = float(height.min())
    thickness = 0.02  # of a level surface, metres; tuned on the studio
    counts = np.bincount(((height - bottom) / thickness).astype(int))
    level = np.flatnonzero(counts > 0.12 * len(members))  # share of the points; tuned
    if not len(level):
        return members[:0]
    low = bottom + level[-1] * thickness
    layer = height[(height >= low) & (height < low + thickness)]
    return members[height > float(np.median(layer)) + 0.012]  # noise of the depth; tuned


def box_diagonal(points: np.ndarray) -> float:
    """Diagonal, metres, of the box between the 2nd and 98th percentiles of points (N, 3)."""
    low, high = np.percentile(points, (2, 98), axis=0)
    return float(np.linalg.norm(high - low))
