"""Silhouette term of E_O (equation 1, :mod:`.object_silhouette`) over a rendering, compiled.

The same residual and Jacobian as the plain version with robust weights, straight into the normal
equations; rims and nearest rim pixels without images in between.
"""

from __future__ import annotations

import numba
import numpy as np

from intercap_core.geometry.camera.projection_kernels import (
    project_point,
    project_point_with_jacobian,
)


@numba.njit(cache=True, nogil=True)
def rim(mask):
    """Pixels (R, 2) as x, y, row by row, of :func:`.object_silhouette.rim`; starts of rows (h + 1).

    Row y holds pixels starts[y] to starts[y + 1].
    """
    height, width = mask.shape
    pixels = np.empty((height * width, 2), np.int32)
    starts = np.zeros(height + 1, np.int32)
    count = 0
    for y in range(height):
        for x in range(width):
            if mask[y, x] and (
                (x > 0 and not mask[y, x - 1])
                or (x + 1 < width and not mask[y, x + 1])
                or (y > 0 and not mask[y - 1, x])
                or (y + 1 < height and not mask[y + 1, x])
            ):
                pixels[count, 0], pixels[count, 1] = x, y
                count += 1
        starts[y + 1] = count
    return pixels[:count].copy(), starts


@numba.njit(cache=True, nogil=True)
def nearest(pixels, starts, x, y, limit):
    """Index of the pixel of :func:`rim` that is nearest to (x, y), the first of equals; -1 where
    none is nearer than ``limit`` px."""
    height = starts.shape[0] - 1
    best, best_square = -1, limit * limit
    for away in range(height):
        if away * away >= best_square:
            break
        for side in range(2 if away else 1):
            row = y - away if side == 0 else y + away
            if row < 0 or row >= height:
                continue
            for index in range(starts[row], starts[row + 1]):
                dx = pixels[index, 0] - x
                square = dx * dx + away * away
                if square < best_square:
                    best, best_square = index, float(square)
                elif dx > 0:
                    break  # farther to the right only
    return best


@numba.njit(cache=True, nogil=True)
def correspondences(
    face,
    corner,
    inside,
    person,
    window,
    contour,
    mask_rim,
    mask_starts,
    background,
    limit,
    least,
):
    """Rim pixels of the render (N, 2), the pixels of the mask (N, 2) that each should reach, how
    many of them come from mask pixels that the render misses, and the size of the render's rim.

    The render's ``face`` (h, w) begins at pixel ``corner`` (x, y) of the image, the evidence at
    ``window`` (x, y), around it: ``inside`` and ``person`` (H, W), the mask's own ``contour``
    (K, 2) and all of its rim (:func:`rim`), in pixels of the window; what is returned are pixels
    x, y of the image. Correspondences end at ``limit`` px; there are none where the render's rim
    has fewer than ``least``. ``background``: also those of rim pixels outside mask and person,
    which the caller may discard.
    """
    height, width = inside.shape
    dx, dy = corner[0] - window[0], corner[1] - window[1]
    drawn = np.zeros((height, width), np.bool_)
    for v in range(face.shape[0]):
        for u in range(face.shape[1]):
            drawn[v + dy, u + dx] = face[v, u] >= 0
    edge, starts = rim(drawn)
    most = contour.shape[0] + edge.shape[0]
    at, target = np.empty((most, 2), np.int32), np.empty((most, 2), np.int32)
    count = 0
    if edge.shape[0] < least:
        return at[:0], target[:0], 0, edge.shape[0]
    for i in range(contour.shape[0]):
        x, y = contour[i, 0], contour[i, 1]
        if not drawn[y, x]:
            index = nearest(edge, starts, x, y, limit)
            if index >= 0:
                for axis in range(2):
                    at[count, axis] = edge[index, axis] + window[axis]
                    target[count, axis] = contour[i, axis] + window[axis]
                count += 1
    missed = count
    if background:
        for i in range(edge.shape[0]):
            x, y = edge[i, 0], edge[i, 1]
            if not inside[y, x] and not person[y, x]:
                index = nearest(mask_rim, mask_starts, x, y, limit)
                if index >= 0:
                    for axis in range(2):
                        at[count, axis] = edge[i, axis] + window[axis]
                        target[count, axis] = mask_rim[index, axis] + window[axis]
                    count += 1
    return at[:count], target[:count], missed, edge.shape[0]


@numba.njit(cache=True, nogil=True)
def sees_past(at, depth, corner, rays, depth_from_colour, lens, measured, place, free_m):
    """Whether the sensor looks past the object at rim pixels (N, 2) of the image: (N,) bool.

    ``depth`` (h, w) of the render, which begins at ``corner`` of the image of ``rays`` (H, W, 2);
    ``measured`` is a window of the depth image, from pixel ``place``, whose lens has the parameters
    ``lens`` (13,). A rim point that is measured nearer is hidden, one measured at its own depth,
    to ``free_m``, belongs to the object whatever the mask says; without a measurement the mask is
    believed.
    """
    clear = np.ones(at.shape[0], np.bool_)
    for i in range(at.shape[0]):
        x, y, z = _on_ray(at[i], depth, corner, rays)
        px, py, pz = _moved(depth_from_colour, x, y, z)
        u, v = project_point(px, py, pz, lens)
        column, row = int(np.rint(u)) - place[0], int(np.rint(v)) - place[1]
        if 0 <= column < measured.shape[1] and 0 <= row < measured.shape[0]:
            found = measured[row, column]
            clear[i] = not (0 < found < pz + free_m)
    return clear


@numba.njit(cache=True, nogil=True)
def normal_equations(
    at,
    target,
    depth,
    corner,
    rays,
    parameters,
    master_from_colour,
    origin,
    scale,
):
    """J'WJ (6, 6), J'Wr (6,) of equation 1's silhouette term and the residuals (N,), pixels.

    ``at``, ``target`` (N, 2) as of :func:`correspondences`; ``depth`` (h, w) of the render, which
    begins at ``corner`` of the image, whose ``rays`` (H, W, 2) and lens ``parameters`` (13,) are
    given; ``origin`` (3,) the object's translation, master frame. Geman-McClure weights of
    ``scale`` px. Columns as in :func:`.object_silhouette.residuals`.
    """
    hessian, gradient = np.zeros((6, 6)), np.zeros(6)
    residuals = np.empty(at.shape[0])
    row = np.empty(6)
    turn = master_from_colour
    for i in range(at.shape[0]):
        x, y, z = _on_ray(at[i], depth, corner, rays)
        u, v, ux, uy, uz, vx, vy, vz = project_point_with_jacobian(x, y, z, parameters)
        du, dv = u - target[i, 0], v - target[i, 1]
        residual = np.sqrt(du * du + dv * dv)
        residuals[i] = residual
        du, dv = du / max(residual, 1e-9), dv / max(residual, 1e-9)
        cx, cy, cz = du * ux + dv * vx, du * uy + dv * vy, du * uz + dv * vz
        ax = turn[0, 0] * cx + turn[0, 1] * cy + turn[0, 2] * cz
        ay = turn[1, 0] * cx + turn[1, 1] * cy + turn[1, 2] * cz
        az = turn[2, 0] * cx + turn[2, 1] * cy + turn[2, 2] * cz
        mx, my, mz = _moved(master_from_colour, x, y, z)
        ox, oy, oz = mx - origin[0], my - origin[1], mz - origin[2]
        row[0], row[1], row[2] = oy * az - oz * ay, oz * ax - ox * az, ox * ay - oy * ax
        row[3], row[4], row[5] = ax, ay, az
        robust = scale * scale / (scale * scale + residual * residual)
        weight = robust * robust
        for j in range(6):
            weighted = weight * row[j]
            gradient[j] += weighted * residual
            for k in range(j, 6):
                hessian[j, k] += weighted * row[k]
    for j in range(6):
        for k in range(j):
            hessian[j, k] = hessian[k, j]
    return hessian, gradient, residuals


@numba.njit(cache=True, nogil=True)
def _on_ray(pixel, depth, corner, rays):
    """The rendered point under a pixel (2,) of the image, camera frame."""
    x, y = pixel[0], pixel[1]
    z = np.float64(depth[y - corner[1], x - corner[0]])
    return rays[y, x, 0] * z, rays[y, x, 1] * z, z


@numba.njit(cache=True, nogil=True)
def _moved(transform, x, y, z):
    return (
        transform[0, 0] * x + transform[0, 1] * y + transform[0, 2] * z + transform[0, 3],
        transform[1, 0] * x + transform[1, 1] * y + transform[1, 2] * z + transform[1, 3],
        transform[2, 0] * x + transform[2, 1] * y + transform[2, 2] * z + transform[2, 3],
    )
