"""Kernels that traverse the tree of :mod:`.surface_tree`.

Arguments that all of them share:

- ``triangles``: (F, 3, 3) float32 corners of the faces, in the order of the leaves;
- ``boxes``: (N, 6) float32, smallest and then largest coordinates of each node;
- ``levels``: number of levels below the root.
"""

from __future__ import annotations

import numba
import numpy as np

from intercap_core.geometry.rigid.triangle_kernels import (
    from_nearest,
    normal_of,
    ray_crosses,
    segment_hit,
    squared_distance,
)

# Kernels start at face np.int64(0): for the literal 0, numba compiles the functions that they call
# a second time.
_ROUNDING = 1e-6  # error of distances in single precision, metres
_ON_SURFACE = 1e-4  # distance below which a face's normal replaces the direction to it, metres
# Least cosine between a normal and the direction to a point that the surface faces. The normal of a
# vertex is the mean of faces that differ, so a point nearer to its plane may be behind one. Tuned:
# of 0 to 0.5, it has the largest F1 of contact by vertex on four recordings of the studio.
_FACING = 0.3


@numba.njit(cache=True, nogil=True)
def nearest(points, triangles, boxes, levels, reach_sq):
    """Return the squared distance (M,) of points (M, 3) to the mesh, at most ``reach_sq``.

    Each search starts at the nearest face of the previous point, so consecutive points should be
    close.
    """
    squared = np.empty(len(points), np.float32)
    stack, reach = np.empty(levels + 2, np.int32), np.empty(levels + 2, np.float32)
    last = np.int64(0)
    for m in range(len(points)):
        x, y, z = points[m, 0], points[m, 1], points[m, 2]
        squared[m], last = _search(
            x, y, z, triangles, boxes, levels, np.float32(reach_sq), last, stack, reach
        )
    return squared


@numba.njit(cache=True, nogil=True)
def signed_distances(points, triangles, boxes, levels, reach, deepest):
    """Return the signed distance (M,), metres, of points (M, 3) float32 to a closed mesh.

    It is negative inside, at most ``reach``, and at least -``deepest``; for points that are not
    finite it is ``reach``. A point is inside if a ray crosses the mesh an odd number of times. Most
    rays are not needed: the ball around a point whose radius is its distance contains no surface,
    so all of it is on one side. A point is on the same side as a previous point if it is within
    that point's ball or its own ball contains that point. A ray is cast only for other points.
    Outside of the mesh, a point that lies deeper than ``reach`` in a previous ball needs no search,
    nor does one that is farther than ``reach`` from the mesh's box.
    """
    signed = np.empty(len(points), np.float64)
    stack, ahead = np.empty(levels + 2, np.int32), np.empty(levels + 2, np.float32)
    last, within = np.int64(0), False
    # centre and radius of a ball whose side, ``within``, is known
    cx, cy, cz, clear = np.inf, np.inf, np.inf, -np.inf
    reach_sq, deepest_sq = np.float32(reach * reach), np.float32(deepest * deepest)
    for m in range(len(points)):
        x, y, z = points[m, 0], points[m, 1], points[m, 2]
        finite = np.isfinite(x) and np.isfinite(y) and np.isfinite(z)
        if not (finite and _to_box(x, y, z, boxes, 0) < reach_sq):
            signed[m] = reach
            continue
        off = np.sqrt((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2)
        if not within and off < clear - reach - _ROUNDING:
            signed[m] = reach
            continue
        square, last = _search(x, y, z, triangles, boxes, levels, deepest_sq, last, stack, ahead)
        distance = np.sqrt(np.float64(square)) if square < deepest_sq else deepest
        if not off < max(distance, clear) - _ROUNDING:
            within = _odd(x, y, z, triangles, boxes, levels, stack)
            clear = -np.inf
        if distance > clear - off:  # this point's ball leaves more room around it
            cx, cy, cz, clear = np.float64(x), np.float64(y), np.float64(z), distance
        signed[m] = -distance if within else min(distance, reach)
    return signed


@numba.njit(cache=True, nogil=True)
def hit(starts, ends, triangles, boxes, levels, first, shares):
    """Set ``shares`` (M,) of the segments ``starts`` to ``ends`` (M, 3) that hit the mesh.

    A share is the length up to the first hit, or without ``first`` to any hit, by that of the
    segment. Hits count from either side, and finite entries are skipped. The face that was hit last
    is tried first, so consecutive segments should be close. Then the tree is traversed, without the
    nodes whose boxes the segment misses (slab test).
    """
    leaves, count = 1 << levels, len(triangles)
    stack = np.empty(levels + 2, np.int32)
    last: int | np.int64 = np.int64(0)
    for m in range(len(starts)):
        if shares[m] < np.inf:
            continue
        x, y, z = starts[m, 0], starts[m, 1], starts[m, 2]
        u, v, w = ends[m, 0] - x, ends[m, 1] - y, ends[m, 2] - z
        share = segment_hit(x, y, z, u, v, w, triangles, last)
        if share < np.inf and not first:
            shares[m] = share
            continue
        a, b, c = _inverse(u), _inverse(v), _inverse(w)
        size, stack[0] = 1, 0
        while size:
            size -= 1
            node = stack[size]
            near, far = 0.0, min(1.0, share)  # shares of the segment within the box
            for k in range(3):
                o, over = (x, a) if k == 0 else ((y, b) if k == 1 else (z, c))
                entry, leave = (boxes[node, k] - o) * over, (boxes[node, 3 + k] - o) * over
                near, far = max(near, min(entry, leave)), min(far, max(entry, leave))
            if near > far + _ROUNDING:
                continue
            if node < leaves - 1:
                stack[size], stack[size + 1] = 2 * node + 2, 2 * node + 1
                size += 2
                continue
            leaf = node - leaves + 1
            for at in range((count * leaf) >> levels, (count * (leaf + 1)) >> levels):
                found = segment_hit(x, y, z, u, v, w, triangles, at)
                if found < share:
                    share, last = found, at
                    if not first:
                        size = 0
                        break
        shares[m] = share


@numba.njit(inline="always")
def _inverse(value):
    """Return 1 over a component of a segment, finite if that is 0."""
    return 1.0 / value if abs(value) > 1e-12 else 1e12


@numba.njit(cache=True, nogil=True)
def _search(x, y, z, triangles, boxes, levels, most, last, stack, reach):
    """Return the squared distance of a point to the mesh, at most ``most``, and its nearest face.

    Branch and bound: the nearer child is visited first, and a node is skipped if its box is farther
    than the nearest face so far. The search is exact. It starts with the distance to face ``last``.
    ``stack`` and ``reach`` are scratch: the nodes that remain, and the squared distances of their
    boxes.
    """
    leaves, count = 1 << levels, len(triangles)
    best = min(squared_distance(x, y, z, triangles, last), most)
    size = 1
    stack[0], reach[0] = 0, _to_box(x, y, z, boxes, 0)
    while size:
        size -= 1
        if reach[size] >= best:
            continue
        node = stack[size]
        while node < leaves - 1:
            left, right = 2 * node + 1, 2 * node + 2
            a, b = _to_box(x, y, z, boxes, left), _to_box(x, y, z, boxes, right)
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
            distance = squared_distance(x, y, z, triangles, at)
            if distance < best:
                best, last = distance, at
    return best, last


@numba.njit(cache=True, nogil=True)
def oppose(points, normals, signed, triangles, boxes, levels, reach):
    """Kernel of :meth:`.ShapedSurface.opposed`."""
    count = len(points)
    kind, away = np.zeros(count, np.int8), np.full(count, np.inf)
    found = np.full((count, 3), np.nan)
    stack, ahead = np.empty(levels + 2, np.int32), np.empty(levels + 2, np.float32)
    last, most = np.int64(0), np.float32(np.inf)
    for m in range(len(points)):
        x, y, z = points[m, 0], points[m, 1], points[m, 2]
        nx, ny, nz = normals[m, 0], normals[m, 1], normals[m, 2]
        square, last = _search(x, y, z, triangles, boxes, levels, most, last, stack, ahead)
        dx, dy, dz = from_nearest(x, y, z, triangles, last)
        if square < _ON_SURFACE * _ON_SURFACE:
            ux, uy, uz = normal_of(triangles, last)
            towards, length = nx * ux + ny * uy + nz * uz, np.sqrt(ux * ux + uy * uy + uz * uz)
        else:
            towards, length = nx * dx + ny * dy + nz * dz, np.sqrt(square)
            towards *= 1 if signed[m] >= 0 else -1
        if towards < -_FACING * length or nx == ny == nz == 0:
            kind[m], away[m] = 2, np.sqrt(np.float64(square))
            found[m, 0], found[m, 1], found[m, 2] = x - dx, y - dy, z - dz
            continue
        front = np.float32(reach * reach)
        behind = front if signed[m] < 0 else np.float32(0)
        size, stack[0] = 1, 0
        leaves, count = 1 << levels, len(triangles)
        while size:
            size -= 1
            node = stack[size]
            box_sq, box = _to_box(x, y, z, boxes, node), boxes[node]
            if box_sq >= max(front, behind):
                continue
            # the point faces nothing in the box
            if box_sq >= behind and (
                max(nx * (box[0] - x), nx * (box[3] - x))
                + max(ny * (box[1] - y), ny * (box[4] - y))
                + max(nz * (box[2] - z), nz * (box[5] - z))
            ) < 0.999 * _FACING * np.sqrt(box_sq):
                continue
            if node < leaves - 1:
                stack[size], stack[size + 1] = 2 * node + 2, 2 * node + 1
                size += 2
                continue
            leaf = node - leaves + 1
            for at in range((count * leaf) >> levels, (count * (leaf + 1)) >> levels):
                ux, uy, uz = normal_of(triangles, at)
                opposed = nx * ux + ny * uy + nz * uz
                if opposed >= 0:
                    continue
                dx, dy, dz = from_nearest(x, y, z, triangles, at)
                square = dx * dx + dy * dy + dz * dz
                length, towards = np.sqrt(ux * ux + uy * uy + uz * uz), nx * dx + ny * dy + nz * dz
                if towards < 0:
                    most_sq = front if towards < -_FACING * np.sqrt(square) else np.float32(0)
                else:
                    most_sq = behind if opposed < -0.5 * length else np.float32(0)
                if square < most_sq:
                    front, behind = min(front, square), min(behind, square)
                    kind[m], away[m] = 1, np.sqrt(np.float64(square))
                    found[m, 0], found[m, 1], found[m, 2] = x - dx, y - dy, z - dz
    return kind, away, found


@numba.njit(cache=True, nogil=True)
def _odd(x, y, z, triangles, boxes, levels, stack):
    """Return whether the ray from (x, y, z) along +z crosses the mesh an odd number of times."""
    leaves, count = 1 << levels, len(triangles)
    odd = False
    size, stack[0] = 1, 0
    while size:
        size -= 1
        node = stack[size]
        box = boxes[node]
        if not (box[0] <= x <= box[3] and box[1] <= y <= box[4] and z <= box[5]):
            continue
        if node < leaves - 1:
            stack[size], stack[size + 1] = 2 * node + 2, 2 * node + 1
            size += 2
            continue
        leaf = node - leaves + 1
        for at in range((count * leaf) >> levels, (count * (leaf + 1)) >> levels):
            odd ^= ray_crosses(x, y, z, triangles[at])
    return odd


@numba.njit(inline="always")
def _to_box(x, y, z, boxes, node):
    """Return the squared distance of a point to a node's box, 0 inside."""
    a = max(boxes[node, 0] - x, x - boxes[node, 3], np.float32(0))
    b = max(boxes[node, 1] - y, y - boxes[node, 4], np.float32(0))
    c = max(boxes[node, 2] - z, z - boxes[node, 5], np.float32(0))
    return a * a + b * b + c * c
