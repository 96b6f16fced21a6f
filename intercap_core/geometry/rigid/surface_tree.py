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

_ROUNDING = 1e-6  # error of distances in single precision, metres
_ON_SURFACE = 1e-4  # distance below which a face's normal replaces the direction to it, metres
# Least cosine between a normal and the direction to a point that the surface faces. The normal of a
# vertex is the mean of faces that differ, so a point nearer to its plane may be behind one. Tuned:
# of 0 to 0.5, it has the largest F1 of contact by vertex on four recordings of the studio.
_FACING = 0.3


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
        squared = _nearest(queries, self._triangles, self._boxes, self._levels, most)
        return np.where(squared < most, np.sqrt(squared.astype(np.float64)), reach)

    def signed_distance(self, points: np.ndarray, reach: float, deepest: float) -> np.ndarray:
        """Return the signed distance (N,) of points (N, 3) to a closed mesh, metres.

        Negative inside, at most ``reach``, at least -``deepest``. Inside is where a ray crosses the
        surface an odd number of times, so the overlap of two parts of a self-intersecting mesh
        counts as outside. Points that are not finite are at ``reach``.
        """
        queries = np.ascontiguousarray(points, np.float32)
        return _signed(
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
        count = len(points)
        kind, away = np.zeros(count, np.int8), np.full(count, np.inf)
        found = np.full((count, 3), np.nan)
        _oppose(
            np.ascontiguousarray(points, np.float32),
            np.ascontiguousarray(normals, np.float32),
            np.ascontiguousarray(signed, np.float64),
            self._triangles,
            self._boxes,
            self._levels,
            float(reach),
            (kind, away, found),
        )
        return kind, away, found

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
        _hit(
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


@numba.njit(cache=True, nogil=True)
def _nearest(points, triangles, boxes, levels, reach_sq):
    """Return the squared distance (M,) of points (M, 3) to the mesh, at most ``reach_sq``.

    Each search starts at the nearest face of the previous point, so consecutive points should be
    close.
    """
    squared = np.empty(len(points), np.float32)
    stack, reach = np.empty(levels + 2, np.int32), np.empty(levels + 2, np.float32)
    last = 0
    for m in range(len(points)):
        x, y, z = points[m, 0], points[m, 1], points[m, 2]
        squared[m], last = _search(
            x, y, z, triangles, boxes, levels, np.float32(reach_sq), last, stack, reach
        )
    return squared


@numba.njit(cache=True, nogil=True)
def _signed(points, triangles, boxes, levels, reach, deepest):
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
    last, within = 0, False
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
def _hit(starts, ends, triangles, boxes, levels, first, shares):
    """Set ``shares`` (M,) of the segments ``starts`` to ``ends`` (M, 3) that hit the mesh.

    A share is the length up to the first hit, or without ``first`` to any hit, by that of the
    segment. Hits count from either side, and finite entries are skipped. The face that was hit last
    is tried first, so consecutive segments should be close. Then the tree is traversed, without the
    nodes whose boxes the segment misses (slab test).
    """
    leaves, count = 1 << levels, len(triangles)
    stack = np.empty(levels + 2, np.int32)
    last = 0
    for m in range(len(starts)):
        if shares[m] < np.inf:
            continue
        x, y, z = starts[m, 0], starts[m, 1], starts[m, 2]
        u, v, w = ends[m, 0] - x, ends[m, 1] - y, ends[m, 2] - z
        share = _meets(x, y, z, u, v, w, triangles, last)
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
                found = _meets(x, y, z, u, v, w, triangles, at)
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
def _meets(x, y, z, u, v, w, triangles, at):
    """Return the share of the segment from (x, y, z) by (u, v, w) before it hits one of triangles
    (F, 3, 3), inf if it does not (Moeller and Trumbore 1997)."""
    ax, ay, az = triangles[at, 0, 0], triangles[at, 0, 1], triangles[at, 0, 2]
    bx, by, bz = triangles[at, 1, 0] - ax, triangles[at, 1, 1] - ay, triangles[at, 1, 2] - az
    cx, cy, cz = triangles[at, 2, 0] - ax, triangles[at, 2, 1] - ay, triangles[at, 2, 2] - az
    px, py, pz = v * cz - w * cy, w * cx - u * cz, u * cy - v * cx
    volume = bx * px + by * py + bz * pz
    if volume == 0:
        return np.inf
    tx, ty, tz = x - ax, y - ay, z - az
    s = (tx * px + ty * py + tz * pz) / volume
    if not 0 <= s <= 1:
        return np.inf
    qx, qy, qz = ty * bz - tz * by, tz * bx - tx * bz, tx * by - ty * bx
    t = (u * qx + v * qy + w * qz) / volume
    if t < 0 or s + t > 1:
        return np.inf
    along = (cx * qx + cy * qy + cz * qz) / volume
    return along if 0 <= along <= 1 else np.inf


@numba.njit(cache=True, nogil=True)
def _search(x, y, z, triangles, boxes, levels, most, last, stack, reach):
    """Return the squared distance of a point to the mesh, at most ``most``, and its nearest face.

    Branch and bound: the nearer child is visited first, and a node is skipped if its box is farther
    than the nearest face so far. The search is exact. It starts with the distance to face ``last``.
    ``stack`` and ``reach`` are scratch: the nodes that remain, and the squared distances of their
    boxes.
    """
    leaves, count = 1 << levels, len(triangles)
    best = min(_to_triangle(x, y, z, triangles, last), most)
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
            distance = _to_triangle(x, y, z, triangles, at)
            if distance < best:
                best, last = distance, at
    return best, last


@numba.njit(cache=True, nogil=True)
def _oppose(points, normals, signed, triangles, boxes, levels, reach, result):
    """Find the opposed points of :meth:`ShapedSurface.opposed` by its arguments.

    Args:
        result: kinds (N,), distances (N,) and points (N, 3), which are written.
    """
    kind, away, found = result
    stack, ahead = np.empty(levels + 2, np.int32), np.empty(levels + 2, np.float32)
    last, most = 0, np.float32(np.inf)
    for m in range(len(points)):
        x, y, z = points[m, 0], points[m, 1], points[m, 2]
        nx, ny, nz = normals[m, 0], normals[m, 1], normals[m, 2]
        square, last = _search(x, y, z, triangles, boxes, levels, most, last, stack, ahead)
        dx, dy, dz = _from_triangle(x, y, z, triangles, last)
        if square < _ON_SURFACE * _ON_SURFACE:
            ux, uy, uz = _normal(triangles, last)
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
                ux, uy, uz = _normal(triangles, at)
                opposed = nx * ux + ny * uy + nz * uz
                if opposed >= 0:
                    continue
                dx, dy, dz = _from_triangle(x, y, z, triangles, at)
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


@numba.njit(inline="always")
def _normal(triangles, at):
    """Return the normal of one of triangles (F, 3, 3), whose length is twice the area."""
    ux, uy, uz = (
        triangles[at, 1, 0] - triangles[at, 0, 0],
        triangles[at, 1, 1] - triangles[at, 0, 1],
        triangles[at, 1, 2] - triangles[at, 0, 2],
    )
    vx, vy, vz = (
        triangles[at, 2, 0] - triangles[at, 0, 0],
        triangles[at, 2, 1] - triangles[at, 0, 1],
        triangles[at, 2, 2] - triangles[at, 0, 2],
    )
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


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
            odd ^= _crosses(x, y, z, triangles[at])
    return odd


@numba.njit(cache=True, nogil=True)
def _crosses(x, y, z, corners):
    """Return whether the ray from (x, y, z) along +z crosses a triangle (3, 3).

    Computed in double precision: (x, y) must be on the same side of all three projected edges, and
    the triangle's height there above z. If (x, y) is on the line of an edge, it is treated as moved
    by an infinitesimal (e, e^2). The two faces at an edge then give consistent answers (simulation
    of simplicity, Edelsbrunner and Mucke 1990).
    """
    total, height, sign = 0.0, 0.0, 0
    for k in range(3):
        a, b, c = corners[k], corners[(k + 1) % 3], corners[(k + 2) % 3]
        # both faces of an edge use the same direction of it
        turned = a[0] > b[0] or (a[0] == b[0] and a[1] > b[1])
        if turned:
            a, b = b, a
        ax, ay = np.float64(a[0]), np.float64(a[1])
        ux, uy = np.float64(b[0]) - ax, np.float64(b[1]) - ay
        area = ux * (np.float64(y) - ay) - uy * (np.float64(x) - ax)
        side = area
        if side == 0:
            side = -uy if uy != 0 else ux
        if turned:
            area, side = -area, -side
        own_sign = 1 if side > 0 else -1
        if side == 0 or (sign and own_sign != sign):  # an edge of no length, or outside of it
            return False
        sign = own_sign
        total += area
        height += area * np.float64(c[2])
    return total != 0 and height / total > z


@numba.njit(inline="always")
def _to_box(x, y, z, boxes, node):
    """Return the squared distance of a point to a node's box, 0 inside."""
    a = max(boxes[node, 0] - x, x - boxes[node, 3], np.float32(0))
    b = max(boxes[node, 1] - y, y - boxes[node, 4], np.float32(0))
    c = max(boxes[node, 2] - z, z - boxes[node, 5], np.float32(0))
    return a * a + b * b + c * c


@numba.njit(inline="always")
def _to_triangle(x, y, z, triangles, at):
    """Return the squared distance of a point to one of triangles (F, 3, 3)."""
    dx, dy, dz = _from_triangle(x, y, z, triangles, at)
    return dx * dx + dy * dy + dz * dz


@numba.njit(inline="always")
def _from_triangle(x, y, z, triangles, at):
    """Return the vector to a point from the nearest point of one of triangles (F, 3, 3).

    It depends on the region of the triangle's plane that the point projects to: a corner, an edge
    or the inside (Ericson, Real-Time Collision Detection, 5.1.5).
    """
    ax, ay, az = triangles[at, 0, 0], triangles[at, 0, 1], triangles[at, 0, 2]
    ux, uy, uz = triangles[at, 1, 0] - ax, triangles[at, 1, 1] - ay, triangles[at, 1, 2] - az
    vx, vy, vz = triangles[at, 2, 0] - ax, triangles[at, 2, 1] - ay, triangles[at, 2, 2] - az
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
    return px - s * ux - t * vx, py - s * uy - t * vy, pz - s * uz - t * vz
