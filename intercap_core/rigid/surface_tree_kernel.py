"""The nearest point of a triangle mesh, compiled: a perfect binary tree of boxes over its faces.

Node 0 is the root, 2 i + 1 and 2 i + 2 are the children of node i, and the last level's nodes, the
leaves, share the faces evenly, in an order that keeps neighbours together. So the tree has no
pointers, and boxes of a mesh that moves are made anew in one pass over it.
"""

from __future__ import annotations

import numba
import numpy as np

LEAF_FACES = 4  # at most, on the tree's last level


@numba.njit(cache=True, nogil=True)
def ordered(centroids, levels):
    """Faces (F,) int32 in the order of the leaves of a tree of ``levels`` splits: each node's are
    halved at the median of their centroids (F, 3) along the longest side."""
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
def fitted(vertices, corners, levels):
    """Corners (F, 3, 3) of the faces ``corners`` (F, 3) in the leaves' order, and the boxes (N, 6)
    of all nodes: least and largest coordinates."""
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


@numba.njit(cache=True, nogil=True)
def nearest(points, triangles, boxes, levels, reach_sq):
    """Squared distance (M,) of points (M, 3) to the mesh, at most ``reach_sq``. Points that follow
    each other had better be neighbours: each search starts from the face that was found last."""
    leaves, count = 1 << levels, len(triangles)
    found = np.empty(len(points), np.float32)
    stack = np.empty(levels + 2, np.int32)
    reach = np.empty(levels + 2, np.float32)
    last = 0
    for m in range(len(points)):
        x, y, z = points[m, 0], points[m, 1], points[m, 2]
        best = min(_to_triangle(x, y, z, triangles[last]), reach_sq)
        size = 1
        stack[0], reach[0] = 0, _to_box(x, y, z, boxes[0])
        while size:
            size -= 1
            if reach[size] >= best:
                continue
            node = stack[size]
            while node < leaves - 1:
                left, right = 2 * node + 1, 2 * node + 2
                a, b = _to_box(x, y, z, boxes[left]), _to_box(x, y, z, boxes[right])
                if a > b:
                    left, right, a, b = right, left, b, a
                if b < best:
                    stack[size], reach[size] = right, b
                    size += 1
                if a >= best:
                    node = -1
                    break
                node = left
            if node < 0:
                continue
            leaf = node - leaves + 1
            for at in range((count * leaf) >> levels, (count * (leaf + 1)) >> levels):
                distance = _to_triangle(x, y, z, triangles[at])
                if distance < best:
                    best, last = distance, at
        found[m] = best
    return found


@numba.njit(inline="always")
def _to_box(x, y, z, box):
    """Squared distance of a point to a box, 0 inside."""
    a = max(box[0] - x, x - box[3], np.float32(0))
    b = max(box[1] - y, y - box[4], np.float32(0))
    c = max(box[2] - z, z - box[5], np.float32(0))
    return a * a + b * b + c * c


@numba.njit(inline="always")
def _to_triangle(x, y, z, corners):
    """Squared distance of a point to a triangle (3, 3) (Ericson, Real-Time Collision Detection,
    5.1.5: by the region of the triangle's plane that the point projects to)."""
    ax, ay, az = corners[0, 0], corners[0, 1], corners[0, 2]
    ux, uy, uz = corners[1, 0] - ax, corners[1, 1] - ay, corners[1, 2] - az
    vx, vy, vz = corners[2, 0] - ax, corners[2, 1] - ay, corners[2, 2] - az
    px, py, pz = x - ax, y - ay, z - az
    uu, uv, vv = (
        ux * ux + uy * uy + uz * uz,
        ux * vx + uy * vy + uz * vz,
        vx * vx + vy * vy + vz * vz,
    )
    d1, d2 = ux * px + uy * py + uz * pz, vx * px + vy * py + vz * pz
    d3, d4, d5, d6 = d1 - uu, d2 - uv, d1 - uv, d2 - vv
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    zero, one = np.float32(0), np.float32(1)
    if d1 <= 0 and d2 <= 0:
        s, t = zero, zero
    elif d3 >= 0 and d4 <= d3:
        s, t = one, zero
    elif d6 >= 0 and d5 <= d6:
        s, t = zero, one
    elif vc <= 0 and d1 >= 0 and d3 <= 0:
        s, t = d1 / (d1 - d3), zero
    elif vb <= 0 and d2 >= 0 and d6 <= 0:
        s, t = zero, d2 / (d2 - d6)
    elif va <= 0 and d4 >= d3 and d5 >= d6:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        s = one - t
    else:
        scale = one / (va + vb + vc)
        s, t = vb * scale, vc * scale
    qx, qy, qz = px - s * ux - t * vx, py - s * uy - t * vy, pz - s * uz - t * vz
    return qx * qx + qy * qy + qz * qz
