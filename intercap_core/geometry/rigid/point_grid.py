"""Exact nearest-neighbour search among many points on surfaces, by a grid of cubic cells.

Points are sorted by cell. A row is the cells along the last axis, which are consecutive in memory.
The cells of a row that a ball around the query intersects are therefore one loop over points.
"""

from __future__ import annotations

import numba
import numpy as np

# Size of a cell, metres: it contains some ten points of each of three depth cameras. Half or double
# is slower.
CELL_M = 0.02
MAX_CELLS = 1 << 21  # largest number of cells; for a larger extent, cells are enlarged


class PointGrid:
    """Search structure of ``points`` (N, 3), N > 0, metres, in single precision."""

    def __init__(self, points: np.ndarray, cell_m: float = CELL_M) -> None:
        self._cells = sort_into_cells(np.ascontiguousarray(points, np.float32), cell_m)

    def distance(self, queries: np.ndarray) -> np.ndarray:
        """Return the distance (M,) float64 of finite queries (M, 3) to the nearest point, metres.

        Errors are up to 1e-6 of the coordinates' size. Fastest if consecutive queries are close.
        """
        points = np.ascontiguousarray(queries, np.float32)
        return np.sqrt(_nearest(points, *self._cells).astype(np.float64))


@numba.njit(cache=True, nogil=True)
def sort_into_cells(points, cell):
    """Sort points (N, 3) float32, N > 0, into cells of at least ``cell`` metres.

    Returns:
        (3, N) coordinates in the order of cells.
        (cells + 1,) start of each cell, then N.
        (3,) corner of the first cell: the smallest coordinates.
        (3,) number of cells along each axis.
        Size of a cell, metres.
    """
    count = len(points)
    low, high = points[0].astype(np.float64), points[0].astype(np.float64)
    for n in range(count):
        for k in range(3):
            low[k], high[k] = min(low[k], points[n, k]), max(high[k], points[n, k])
    size = np.float64(cell)
    number = np.empty(3, np.int64)
    while True:
        cells = 1.0
        for k in range(3):
            number[k] = np.int64((high[k] - low[k]) / size) + 1
            cells *= number[k]
        if cells <= MAX_CELLS:
            break
        size *= 1.25
    inverse = 1 / size
    place = np.empty(count, np.int32)
    starts = np.zeros(number[0] * number[1] * number[2] + 1, np.int32)
    for n in range(count):
        i = min(np.int64((points[n, 0] - low[0]) * inverse), number[0] - 1)
        j = min(np.int64((points[n, 1] - low[1]) * inverse), number[1] - 1)
        k = min(np.int64((points[n, 2] - low[2]) * inverse), number[2] - 1)
        place[n] = (i * number[1] + j) * number[2] + k
        starts[place[n]] += 1
    end = 0
    for at in range(len(starts)):  # end of each cell, which the loop below decreases to its start
        end += starts[at]
        starts[at] = end
    placed = np.empty((3, count), np.float32)
    for n in range(count):
        starts[place[n]] -= 1
        at = starts[place[n]]
        for k in range(3):
            placed[k, at] = points[n, k]
    return placed, starts, low, number, size


@numba.njit(cache=True, nogil=True, fastmath={"nnan", "ninf", "nsz", "arcp"})
def _nearest(queries, points, starts, low, number, size):
    """Return the squared distance (M,) of finite queries (M, 3) float32 to the nearest point.

    The other arguments are results of :func:`sort_into_cells`. The first bound is the distance to
    the nearest point of the previous query. Layers of cells (first axis), and the rows of a layer
    (second axis), are visited outwards from the query's own layer and row, alternately on both
    sides. A layer or row farther than the nearest point so far is skipped. After three of them in
    succession, which include both sides, all that follow are farther too, so the search is exact.
    """
    xs, ys, zs = points[0], points[1], points[2]
    inverse = 1 / size
    squared = np.empty(len(queries), np.float32)
    last = 0
    for m in range(len(queries)):
        x, y, z = queries[m, 0], queries[m, 1], queries[m, 2]
        best = (x - xs[last]) ** 2 + (y - ys[last]) ** 2 + (z - zs[last]) ** 2
        gx, gy, gz = (x - low[0]) * inverse, (y - low[1]) * inverse, (z - low[2]) * inverse
        own_i = min(max(np.int64(np.floor(gx)), 0), number[0] - 1)
        own_j = min(max(np.int64(np.floor(gy)), 0), number[1] - 1)
        beyond_i = -1  # number of successive layers that are too far away, minus one
        for a in range(2 * number[0]):  # offsets 0, 1, -1, 2, -2, ... from the own layer
            i = own_i + ((a + 1) >> 1) * (1 if a & 1 else -1)
            off_x = max(i - gx, gx - i - 1, 0.0) * size
            if off_x * off_x >= best:
                beyond_i += 1
                if beyond_i > 1:
                    break
                continue
            if i < 0 or i >= number[0]:
                continue
            beyond_i = -1
            beyond_j = -1
            for b in range(2 * number[1]):
                j = own_j + ((b + 1) >> 1) * (1 if b & 1 else -1)
                off_y = max(j - gy, gy - j - 1, 0.0) * size
                rest = best - off_x * off_x - off_y * off_y
                if rest <= 0:
                    beyond_j += 1
                    if beyond_j > 1:
                        break
                    continue
                if j < 0 or j >= number[1]:
                    continue
                beyond_j = -1
                along = np.sqrt(rest) * inverse
                first = max(np.int64(np.floor(gz - along)), 0)
                stop = min(np.int64(np.floor(gz + along)), number[2] - 1)
                if first > stop:
                    continue
                row = (i * number[1] + j) * number[2]
                begin, end = starts[row + first], starts[row + stop + 1]
                closest = best
                for at in range(begin, end):
                    dx, dy, dz = x - xs[at], y - ys[at], z - zs[at]
                    closest = min(closest, dx * dx + dy * dy + dz * dz)
                if closest < best:
                    best = closest
                    for at in range(begin, end):
                        dx, dy, dz = x - xs[at], y - ys[at], z - zs[at]
                        if dx * dx + dy * dy + dz * dz <= closest:
                            last = at
                            break
        squared[m] = best
    return squared
