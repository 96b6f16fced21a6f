"""Correspondences of E_D (equation 4) and E_P_self (equation 5), compiled, and their normals.

Equal to the plain versions there to rounding. Nearest neighbours are searched in spatial groups: a
group whose bound is farther than the best match so far is skipped. All arrays are of one floating
type.
"""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def vertex_normals(vertices, faces, starts, around, out):
    """Area-weighted unit normals (B,V,3) into ``out`` of vertices (B,V,3).

    ``around`` lists the faces (F,3) at each vertex, those of v from ``starts[v]`` to
    ``starts[v + 1]``; a vertex without any gets zero.
    """
    cross = np.empty((len(faces), 3), vertices.dtype)
    for b in range(len(vertices)):
        posed = vertices[b]
        for f in range(len(faces)):
            i, j, k = faces[f]
            ax, ay, az = posed[i, 0], posed[i, 1], posed[i, 2]
            ux, uy, uz = posed[j, 0] - ax, posed[j, 1] - ay, posed[j, 2] - az
            vx, vy, vz = posed[k, 0] - ax, posed[k, 1] - ay, posed[k, 2] - az
            cross[f, 0] = uy * vz - uz * vy
            cross[f, 1] = uz * vx - ux * vz
            cross[f, 2] = ux * vy - uy * vx
        for v in range(len(starts) - 1):
            x = y = z = cross[0, 0] * 0
            for at in range(starts[v], starts[v + 1]):
                f = around[at]
                x += cross[f, 0]
                y += cross[f, 1]
                z += cross[f, 2]
            length = np.sqrt(x * x + y * y + z * z)
            if length > 0:
                x, y, z = x / length, y / length, z / length
            out[b, v, 0], out[b, v, 1], out[b, v, 2] = x, y, z


@numba.njit(cache=True, nogil=True)
def match(
    points,
    point_normals,
    vertices,
    normals,
    samples,
    patch,
    order,
    starts,
    length,
    reach,
    aside,
    turned,
):
    """Sample (M,), signed distance (M,) and whether it counts (M,), as :func:`.body_cloud.match`.

    points and point_normals (M,3); ``order`` (S,) lists the samples group by group, from
    ``starts[g]`` to ``starts[g + 1]``. ``length`` metres a radian between normals; a match counts
    within ``reach`` metres along the normal, ``aside`` metres beside it, and where the cosine
    between the normals is over ``turned``.
    """
    groups, kind = len(starts) - 1, vertices.dtype
    own, centre = np.empty((6, len(order)), kind), np.zeros((6, groups), kind)
    radius, to_group = np.zeros(groups, kind), np.empty(groups, kind)
    longest = 0
    for g in range(groups):
        first, last = starts[g], starts[g + 1]
        longest = max(longest, last - first)
        for at in range(first, last):
            v = samples[order[at]]
            for d in range(3):
                own[d, at] = vertices[v, d]
                own[3 + d, at] = length * normals[v, d]
        for d in range(6):
            centre[d, g] = own[d, first:last].mean()
        for at in range(first, last):
            radius[g] = max(radius[g], _square(own, at, centre[:, g]))
        radius[g] = np.sqrt(radius[g])
    apart, here = np.empty(longest, kind), np.empty(6, kind)
    sample = np.empty(len(points), np.int64)
    distance = np.empty(len(points), kind)
    valid = np.zeros(len(points), np.bool_)
    best = 0  # place in the order; the last point's is a good first guess for the next one
    for m in range(len(points)):
        for d in range(3):
            here[d] = points[m, d]
            here[3 + d] = length * point_normals[m, d]
        least = _square(own, best, here)
        bound = np.sqrt(least)
        _squares(centre, 0, groups, here, to_group)
        for g in range(groups):
            limit = bound + radius[g]
            if to_group[g] >= limit * limit:
                continue
            first = starts[g]
            size = starts[g + 1] - first
            _squares(own, first, size, here, apart)
            for at in range(size):
                if apart[at] < least:
                    least, best = apart[at], first + at
            bound = np.sqrt(least)
        sample[m] = order[best]
        nearest, gx, gy, gz = _nearest_of_patch(points[m], vertices, patch[sample[m]])
        nx, ny, nz = normals[nearest, 0], normals[nearest, 1], normals[nearest, 2]
        height = nx * gx + ny * gy + nz * gz
        distance[m] = height
        sx, sy, sz = gx - height * nx, gy - height * ny, gz - height * nz
        valid[m] = (
            nx * point_normals[m, 0] + ny * point_normals[m, 1] + nz * point_normals[m, 2] > turned
            and abs(height) < reach
            and np.sqrt(sx * sx + sy * sy + sz * sz) < aside
        )
    return sample, distance, valid


@numba.njit(cache=True, nogil=True)
def _square(values, at, here):
    """Squared distance of column ``at`` of (6,N) from ``here`` (6,)."""
    total = here[0] * 0
    for d in range(6):
        gap = values[d, at] - here[d]
        total += gap * gap
    return total


@numba.njit(cache=True, nogil=True)
def _squares(values, first, count, here, out):
    """The same of ``count`` columns from ``first`` on, into ``out``."""
    h0, h1, h2, h3, h4, h5 = here[0], here[1], here[2], here[3], here[4], here[5]
    last = first + count
    a, b, c = values[0, first:last], values[1, first:last], values[2, first:last]
    d, e, f = values[3, first:last], values[4, first:last], values[5, first:last]
    for at in range(count):
        x, y, z = a[at] - h0, b[at] - h1, c[at] - h2
        p, q, r = d[at] - h3, e[at] - h4, f[at] - h5
        out[at] = x * x + y * y + z * z + p * p + q * q + r * r


@numba.njit(cache=True, nogil=True)
def _nearest_of_patch(point, vertices, patch):
    """The vertex of ``patch`` nearest to a point (3,), and the gap from it to the point."""
    px, py, pz = point[0], point[1], point[2]
    best, gx, gy, gz = patch[0], px * 0, px * 0, px * 0
    least = px * 0 + np.inf
    for v in patch:
        x, y, z = px - vertices[v, 0], py - vertices[v, 1], pz - vertices[v, 2]
        square = x * x + y * y + z * z
        if square < least:
            least, best, gx, gy, gz = square, v, x, y, z
    return best, gx, gy, gz


@numba.njit(cache=True, nogil=True)
def find(
    parts,
    margin,
    vertices,
    normals,
    samples,
    patch,
    part,
    patch_part,
    hand,
    apart,
    deepest,
    sideways,
):
    """Vertices (K,) of samples inside another part and of the surface there, as
    :func:`.body_self.find`.

    The arrays are those of :class:`.body_self.SelfContact`, ``parts`` their number; ``margin``
    metres outside counts as inside.
    """
    count, kind = len(samples), vertices.dtype
    order, starts = _by_part(part, parts)
    where = np.empty((count, 3), kind)  # in that order
    low, high = np.full((parts, 3), np.inf, kind), np.full((parts, 3), -np.inf, kind)
    for at in range(count):
        i = order[at]
        for d in range(3):
            x = vertices[samples[i], d]
            where[at, d] = x
            low[part[i], d] = min(low[part[i], d], x)
            high[part[i], d] = max(high[part[i], d], x)
    nearest = np.full((2, count), -1)  # by whether it is on the same hand
    for i in range(count):
        here = vertices[samples[i]]
        if not _in_a_box(here, part[i], low, high, margin):
            continue
        least = np.full(2, np.inf)
        for p in range(parts):
            first, last = starts[p], starts[p + 1]
            if p == part[i] or first == last:
                continue
            same_hand = int(hand[i] >= 0 and hand[order[first]] == hand[i])
            if _to_box(here, low[p], high[p]) >= least[same_hand]:
                continue
            for at in range(first, last):
                x, y, z = where[at, 0] - here[0], where[at, 1] - here[1], where[at, 2] - here[2]
                square = x * x + y * y + z * z
                if square < least[same_hand] and apart[i, order[at]]:
                    least[same_hand], nearest[same_hand, i] = square, order[at]
    inner, outer = np.empty(2 * count, np.int64), np.empty(2 * count, np.int64)
    found = 0
    for same_hand in range(2):
        for i in range(count):
            j = nearest[same_hand, i]
            if j < 0:
                continue
            v, at = samples[i], -1
            least_gap = vertices[0, 0] * 0 + np.inf
            for k in range(patch.shape[1]):
                if patch_part[j, k] == part[j]:
                    w = patch[j, k]
                    x, y, z = (
                        vertices[v, 0] - vertices[w, 0],
                        vertices[v, 1] - vertices[w, 1],
                        vertices[v, 2] - vertices[w, 2],
                    )
                    square = x * x + y * y + z * z
                    if square < least_gap:
                        least_gap, at, gx, gy, gz = square, w, x, y, z
            if at < 0:
                continue
            nx, ny, nz = normals[at, 0], normals[at, 1], normals[at, 2]
            height = nx * gx + ny * gy + nz * gz
            sx, sy, sz = gx - height * nx, gy - height * ny, gz - height * nz
            if not (-deepest[j] < height < margin):
                continue
            if not np.sqrt(sx * sx + sy * sy + sz * sz) < sideways[j]:
                continue
            # normals agree where two fingers join: no collision
            if same_hand and (normals[v, 0] * nx + normals[v, 1] * ny + normals[v, 2] * nz >= 0):
                continue
            inner[found], outer[found] = v, at
            found += 1
    return inner[:found].copy(), outer[:found].copy()


@numba.njit(cache=True, nogil=True)
def _by_part(part, parts):
    """Samples part by part, in their order, and where each part starts and the last ends."""
    order, starts = np.empty(len(part), np.int64), np.zeros(parts + 1, np.int64)
    for p in part:
        starts[p + 1] += 1
    for p in range(parts):
        starts[p + 1] += starts[p]
    place = starts.copy()
    for i in range(len(part)):
        order[place[part[i]]] = i
        place[part[i]] += 1
    return order, starts


@numba.njit(cache=True, nogil=True)
def _in_a_box(here, own, low, high, margin):
    """Whether a point (3,) lies in the box (parts,3) of another part than its own."""
    for p in range(len(low)):
        if p != own and (
            here[0] > low[p, 0] - margin and here[0] < high[p, 0] + margin
            and here[1] > low[p, 1] - margin and here[1] < high[p, 1] + margin
            and here[2] > low[p, 2] - margin and here[2] < high[p, 2] + margin
        ):  # fmt: skip
            return True
    return False


@numba.njit(cache=True, nogil=True)
def _to_box(here, low, high):
    """Squared distance of a point (3,) from a box, 0 inside."""
    total = here[0] * 0
    for d in range(3):
        gap = max(low[d] - here[d], here[d] - high[d])
        if gap > 0:
            total += gap * gap
    return total
