"""Distances of many points to a mesh that moves or bends, limited to a largest distance.

The largest distance is called ``reach``. Embree's tree
(:mod:`intercap_core.geometry.rigid.distance`) has to be built for every shape of the mesh and
searches without a limit. The tree of this module keeps the order of its faces for all shapes and
stops at the reach. If most points are beyond it, it takes a third of the time.

The tree is a perfect binary tree of axis-aligned boxes, with ``levels`` levels below the root. Node
0 is the root, and nodes 2 i + 1 and 2 i + 2 are the children of node i. Each leaf has an equal
share of the faces, in an order that keeps neighbours together: of F faces and L = 2^levels leaves,
leaf k has the faces F k / L to F (k + 1) / L of the order. The tree therefore needs no pointers,
and one pass over the nodes updates the boxes of a moving mesh.
"""

from __future__ import annotations

import numba
import numpy as np

from intercap_core.geometry.rigid.surface_searches import (
    hit,
    nearest,
    oppose,
    signed_distances,
)


class SurfaceTree:
    """The order of a mesh's faces, determined once on one shape of the mesh.

    Searches in very different shapes are correct but slower.

    Attributes:
        closed: every edge belongs to an even number of faces.

    Args:
        vertices: (V, 3) metres.
        faces: (F, 3), F > 0.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        faces = np.asarray(faces, np.int64)
        centroids = np.asarray(vertices, np.float32)[faces].mean(axis=1)
        self._levels = max(0, int(np.ceil(np.log2(len(faces) / 4))))  # at most four a leaf
        self._corners = faces[_ordered(centroids, self._levels)].astype(np.int32)
        self.closed = _closed(faces)

    def shaped(self, vertices: np.ndarray) -> ShapedSurface:
        """Return the surface of the mesh with vertices (V, 3), metres."""
        placed = np.ascontiguousarray(vertices, np.float32)
        triangles, boxes = _fitted(placed, self._corners, self._levels)
        return ShapedSurface(triangles, boxes, self._levels)


class ShapedSurface:
    """One shape of a :class:`SurfaceTree`'s mesh."""

    def __init__(self, triangles: np.ndarray, boxes: np.ndarray, levels: int) -> None:
        self._triangles, self._boxes, self._levels = triangles, boxes, levels

    def distance(self, points: np.ndarray, reach: float) -> np.ndarray:
        """Return the distance (N,) of points (N, 3) to the surface, metres, 0 to ``reach``.

        Computed in float32 with errors up to 1e-6 of the coordinates' size. Fastest if consecutive
        points are close.
        """
        queries, most = np.ascontiguousarray(points, np.float32), np.float32(reach * reach)
        squared = nearest(queries, self._triangles, self._boxes, self._levels, most)
        return np.where(squared < most, np.sqrt(squared.astype(np.float64)), reach)

    def signed_distance(self, points: np.ndarray, reach: float, deepest: float) -> np.ndarray:
        """Return the signed distance (N,) of points (N, 3) to a closed mesh, metres.

        Negative inside, at most ``reach``, at least -``deepest``. Inside is where a ray crosses the
        surface an odd number of times, so the overlap of two parts of a self-intersecting mesh
        counts as outside. Points that are not finite are at ``reach``.
        """
        queries = np.ascontiguousarray(points, np.float32)
        return signed_distances(
            queries, self._triangles, self._boxes, self._levels, float(reach), float(deepest)
        )

    def opposed(
        self, points: np.ndarray, normals: np.ndarray, signed: np.ndarray, reach: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find the nearest point of this surface that faces each point of another surface.

        The nearest point of the surface faces the other surface if the signed distance decreases
        along the normal. Otherwise only faces within ``reach`` whose normal opposes ``normals`` are
        searched, in front of the point, or behind a point that is inside of the surface. Behind it
        the normals differ by 120 degrees or more, unlike those at the sides of a penetrating part.

        Args:
            points: (N, 3) of the other surface, metres.
            normals: (N, 3) unit normals there; (0, 0, 0) if the other surface has no outside.
            signed: (N,) signed distances of ``points`` to this surface.
            reach: of the second search, metres.

        Returns:
            (N,) int8: 2 = the nearest point, 1 = another point, 0 = none.
            (N,) its distance, metres, inf if there is none.
            (N, 3) the point, NaN if there is none.
        """
        return oppose(
            np.ascontiguousarray(points, np.float32),
            np.ascontiguousarray(normals, np.float32),
            np.ascontiguousarray(signed, np.float64),
            self._triangles,
            self._boxes,
            self._levels,
            float(reach),
        )

    def blocks(self, starts: np.ndarray, ends: np.ndarray, blocked: np.ndarray) -> None:
        """Set ``blocked`` (N,) bool of segments ``starts`` to ``ends`` (N, 3) that hit the mesh.

        Entries that are already set are skipped.
        """
        blocked |= self._hits(starts, ends, np.where(blocked, 0.0, np.inf), first=False) <= 1

    def first_hit(self, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Return where segments ``starts`` to ``ends`` (N, 3) first hit the mesh, from either side.

        (N,) shares of the segments' lengths, inf for a segment that does not hit it.
        """
        return self._hits(starts, ends, np.full(len(starts), np.inf), first=True)

    def _hits(
        self, starts: np.ndarray, ends: np.ndarray, shares: np.ndarray, *, first: bool
    ) -> np.ndarray:
        hit(
            np.ascontiguousarray(starts, np.float64),
            np.ascontiguousarray(ends, np.float64),
            self._triangles,
            self._boxes,
            self._levels,
            first,
            shares,
        )
        return shares


def _closed(faces: np.ndarray) -> bool:
    """Return whether every edge of faces (F, 3) belongs to an even number of faces."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    numbers = edges[:, 0] * (int(faces.max()) + 1) + edges[:, 1]
    return not (np.unique(numbers, return_counts=True)[1] % 2).any()


@numba.njit(cache=True, nogil=True)
def _ordered(centroids, levels):
    """Return faces (F,) int32 in the order of the leaves of a tree of ``levels`` splits.

    Each split halves a node's faces at the median of their centroids (F, 3) along the longest side.
    """
    count = len(centroids)
    order = np.arange(count).astype(np.int32)
    for level in range(levels):
        for node in range(1 << level):
            start, end = (count * node) >> level, (count * (node + 1)) >> level
            part = order[start:end].copy()
            longest, axis = np.float32(-1), 0
            for k in range(3):
                low, high = np.float32(np.inf), np.float32(-np.inf)
                for face in part:
                    low, high = min(low, centroids[face, k]), max(high, centroids[face, k])
                if high - low > longest:
                    longest, axis = high - low, k
            along = np.empty(len(part), np.float32)
            for i in range(len(part)):
                along[i] = centroids[part[i], axis]
            order[start:end] = part[np.argsort(along, kind="mergesort")]
    return order


@numba.njit(cache=True, nogil=True)
def _fitted(vertices, corners, levels):
    """Return the triangles and the boxes of all nodes, of one shape of the mesh.

    Args:
        vertices: (V, 3) float32.
        corners: (F, 3) vertex indices of the faces, in the order of the leaves.
        levels: of the tree.

    Returns:
        (F, 3, 3) corners of the faces.
        (N, 6) smallest, then largest coordinates of each node.
    """
    count, leaves = len(corners), 1 << levels
    triangles = np.empty((count, 3, 3), np.float32)
    boxes = np.empty((2 * leaves - 1, 6), np.float32)
    for leaf in range(leaves):
        box = boxes[leaves - 1 + leaf]
        box[:3], box[3:] = np.inf, -np.inf
        for at in range((count * leaf) >> levels, (count * (leaf + 1)) >> levels):
            for c in range(3):
                for k in range(3):
                    value = vertices[corners[at, c], k]
                    triangles[at, c, k] = value
                    box[k], box[3 + k] = min(box[k], value), max(box[3 + k], value)
    for node in range(leaves - 2, -1, -1):
        for k in range(3):
            boxes[node, k] = min(boxes[2 * node + 1, k], boxes[2 * node + 2, k])
            boxes[node, 3 + k] = max(boxes[2 * node + 1, 3 + k], boxes[2 * node + 2, 3 + k])
    return triangles, boxes
