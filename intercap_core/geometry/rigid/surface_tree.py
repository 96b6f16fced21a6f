"""Distances to a mesh that moves or bends, of many points and up to a reach.

Where Embree's tree (:mod:`intercap_core.geometry.rigid.distance`) is made anew for every shape and
searches
as far as it must, this one keeps its faces' order and gives up at the reach, at a third of the time
where most points are out of it.
"""

from __future__ import annotations

import numpy as np

from intercap_core.geometry.rigid import surface_tree_kernel as kernel


class SurfaceTree:
    """The order of a mesh's faces, found once on one shape of it.

    ``vertices`` (V, 3) and ``faces`` (F, 3), F > 0; other shapes may differ at will, searches in
    them are merely slower.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        faces = np.asarray(faces, np.int64)
        centroids = np.asarray(vertices, np.float32)[faces].mean(axis=1)
        self._levels = max(0, int(np.ceil(np.log2(len(faces) / kernel.LEAF_FACES))))
        self._corners = faces[kernel.ordered(centroids, self._levels)].astype(np.int32)
        self.closed = _closed(faces)

    def shaped(self, vertices: np.ndarray) -> ShapedSurface:
        """The mesh with its vertices at (V, 3)."""
        placed = np.ascontiguousarray(vertices, np.float32)
        triangles, boxes = kernel.fitted(placed, self._corners, self._levels)
        return ShapedSurface(triangles, boxes, self._levels)


class ShapedSurface:
    """One shape of a :class:`SurfaceTree`'s mesh."""

    def __init__(self, triangles: np.ndarray, boxes: np.ndarray, levels: int) -> None:
        self._triangles, self._boxes, self._levels = triangles, boxes, levels

    def distance(self, points: np.ndarray, reach: float) -> np.ndarray:
        """Distance (N,) of points (N, 3) to the surface, metres, never negative, at most ``reach``.

        Computed in float32: errors up to 1e-6 of the coordinates' size. Fastest where points that
        follow each other are neighbours.
        """
        queries, most = np.ascontiguousarray(points, np.float32), np.float32(reach * reach)
        found = kernel.nearest(queries, self._triangles, self._boxes, self._levels, most)
        return np.where(found < most, np.sqrt(found.astype(np.float64)), reach)

    def signed_distance(self, points: np.ndarray, reach: float, deepest: float) -> np.ndarray:
        """Distance (N,) of points (N, 3) to the surface of a mesh that is closed, metres, negative
        inside: at most ``reach``, at least -``deepest``.

        Inside is where a ray crosses the surface an odd number of times, as in
        :mod:`intercap_core.geometry.rigid.distance`: what is inside two parts of a mesh that cuts
        itself counts as outside. Points that are no numbers are at ``reach``.
        """
        queries = np.ascontiguousarray(points, np.float32)
        return kernel.signed(
            queries, self._triangles, self._boxes, self._levels, float(reach), float(deepest)
        )

    def blocks(self, starts: np.ndarray, ends: np.ndarray, blocked: np.ndarray) -> None:
        """Set ``blocked`` (N,) bool where the way from ``starts`` to ``ends`` (N, 3) meets the
        surface; what is set already is not asked."""
        kernel.block(
            np.ascontiguousarray(starts, np.float64),
            np.ascontiguousarray(ends, np.float64),
            self._triangles,
            self._boxes,
            self._levels,
            blocked,
        )


def _closed(faces: np.ndarray) -> bool:
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    numbers = edges[:, 0] * (int(faces.max()) + 1) + edges[:, 1]
    return not (np.unique(numbers, return_counts=True)[1] % 2).any()
