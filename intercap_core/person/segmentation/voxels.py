"""Points joined to components where they lie together, on a grid of cells."""

from __future__ import annotations

import numba
import numpy as np

_BITS = 21  # of a cell's coordinate in its key


def connected(points: np.ndarray, cell_m: float) -> tuple[np.ndarray, int]:
    """The component of each point (N,) int32 and how many there are.

    Points (N, 3), metres, of cells that touch, if only at a corner, are one component. Components
    are numbered by size, the one with most cells first.
    """
    if not len(points):
        return np.zeros(0, np.int32), 0
    occupied, inverse = np.unique(_keys(points, cell_m), return_inverse=True)
    root = _roots(occupied)
    _, label, size = np.unique(root, return_inverse=True, return_counts=True)
    order = np.argsort(-size, kind="stable")
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    return rank[label][inverse], len(order)


def components(points: np.ndarray, cell_m: float, min_points: int) -> list[np.ndarray]:
    """Indices of the points (N, 3) of each component of at least so many, ascending.

    The component with most cells comes first.
    """
    label, count = connected(points, cell_m)
    if not count:
        return []
    order = np.argsort(label, kind="stable")
    sizes = np.bincount(label, minlength=count)
    ends = np.cumsum(sizes)
    large = np.flatnonzero(sizes >= min_points)
    return [order[ends[k] - sizes[k] : ends[k]] for k in large]


class Occupied:
    """The cells that points (N, 3) of a surface lie in, and those that share a face with them."""

    def __init__(self, points: np.ndarray, cell_m: float, min_points: int) -> None:
        self._cell_m = cell_m
        keys, counts = np.unique(_keys(points, cell_m), return_counts=True)
        keys = keys[counts >= min_points]
        steps = [sign * (1 << axis * _BITS) for axis in range(3) for sign in (1, -1)]
        self._keys = np.unique(np.concatenate([keys, *(keys + step for step in steps)]))

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Whether each of the points (M, 3) lies in one of the cells: (M,) bool."""
        if not len(self._keys):
            return np.zeros(len(points), bool)
        keys = _keys(points, self._cell_m)
        at = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        return self._keys[at] == keys


def _keys(points: np.ndarray, cell_m: float) -> np.ndarray:
    """One number (N,) int64 a cell; the same step of it leads to the same neighbour everywhere."""
    cells = np.floor(points * np.float32(1 / cell_m)).astype(np.int64) + (1 << (_BITS - 1))
    return (cells[:, 0] << (2 * _BITS)) | (cells[:, 1] << _BITS) | cells[:, 2]


@numba.njit(cache=True)
def _roots(keys: np.ndarray) -> np.ndarray:
    """Index (M,) of the first cell of each cell's component; ``keys`` (M,) ascending."""
    parent = np.arange(len(keys))
    # of the 26 neighbours those that come before: the rest find this cell from their side
    for dx in range(-1, 1):
        for dy in range(-1, 2):
            for dz in range(-1, 2):
                step = dx * (1 << 2 * _BITS) + dy * (1 << _BITS) + dz
                if step >= 0:
                    continue
                j = 0
                for i in range(len(keys)):
                    wanted = keys[i] + step
                    while j < len(keys) and keys[j] < wanted:
                        j += 1
                    if j < len(keys) and keys[j] == wanted:
                        a, b = i, j
                        while parent[a] != a:
                            parent[a] = parent[parent[a]]
                            a = parent[a]
                        while parent[b] != b:
                            parent[b] = parent[parent[b]]
                            b = parent[b]
                        if a < b:
                            parent[b] = a
                        elif b < a:
                            parent[a] = b
    for i in range(len(keys)):
        a = i
        while parent[a] != a:
            a = parent[a]
        parent[i] = a
    return parent
