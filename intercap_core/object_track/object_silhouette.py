"""Silhouette term of E_O: lambda_segm || (R_S - S) * S ||^2 of equation 1.

R_S is the rendered mask, S the detected mask; lambda_segm is in
:mod:`intercap_core.object_track.view_fit`. The term is one-sided as in the paper: only mask pixels
that the render misses count, so occlusion by a hand costs nothing. Each such pixel of the mask's
contour pulls the nearest rim pixel of the render. Beyond the paper, the optional background term is
the reverse: rim pixels of the render over known background are pulled to the nearest contour pixel
of the mask.

The residual is the distance r = |u(X) - u'| of the projection of a rim point X from the pixel u'
that it should reach, in pixels. Its derivative by motions of the object (:mod:`.object_depth`) is
taken along the line between the two.
"""

from __future__ import annotations

import numba
import numpy as np

from intercap_core.geometry.camera.projection_kernels import (
    project_point,
    project_point_with_jacobian,
)
from intercap_core.object_track.object_depth import add_row


@numba.njit(cache=True, nogil=True)
def rim_pixels(mask):
    """List the pixels of a mask (h, w) that touch its outside, row by row.

    The mask is assumed to continue beyond the window: a silhouette that the image's edge cuts off
    has no contour there.

    Returns:
        pixels: (R, 2) x, y.
        starts: (h + 1,) row y holds the pixels starts[y] to starts[y + 1].
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
    """Find the pixel of :func:`rim_pixels` nearest to (x, y), the first of equals; exact.

    Rows are searched outwards from row y, until their distance exceeds the best one. Returns the
    pixel's index, or -1 if none is nearer than ``limit`` pixels.
    """
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
    face, corner, inside, person, window, contour, mask_rim, mask_starts, background, limit, least
):
    """Match rim pixels of the render with contour pixels of the mask.

    Args:
        face: (h, w) face number of the render, -1 outside.
        corner: first pixel (x, y) of the render in the image.
        inside: (H, W) mask of the candidate in the patch.
        person: (H, W) mask of people outside of the candidate.
        window: first pixel (x, y) of the patch in the image; the patch contains the render.
        contour: (K, 2) contour pixels of the mask that no person cuts off, in the patch.
        mask_rim, mask_starts: all rim pixels of the mask (:func:`rim_pixels`).
        background: whether rim pixels of the render outside of mask and people are matched too.
        limit: largest distance of a match, pixels.
        least: if the render's rim has fewer pixels, nothing is matched.

    Returns:
        at, target: (N, 2) rim pixels of the render and the mask pixels they should reach, image.
        missed: number of the first matches, which come from mask pixels that the render misses.
        rim_size: number of pixels of the render's rim.
    """
    height, width = inside.shape
    dx, dy = corner[0] - window[0], corner[1] - window[1]
    drawn = np.zeros((height, width), np.bool_)
    for v in range(face.shape[0]):
        for u in range(face.shape[1]):
            drawn[v + dy, u + dx] = face[v, u] >= 0
    edge, starts = rim_pixels(drawn)
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
                at[count], target[count] = edge[index], contour[i]
                count += 1
    missed = count
    if background:
        for i in range(edge.shape[0]):
            x, y = edge[i, 0], edge[i, 1]
            if not inside[y, x] and not person[y, x]:
                index = nearest(mask_rim, mask_starts, x, y, limit)
                if index >= 0:
                    at[count], target[count] = edge[i], mask_rim[index]
                    count += 1
    for i in range(count):
        for axis in range(2):
            at[i, axis] += window[axis]
            target[i, axis] += window[axis]
    return at[:count], target[:count], missed, edge.shape[0]


@numba.njit(cache=True, nogil=True)
def sees_past(at, depth, corner, rays, depth_from_colour, lens, measured, place, free_m):
    """Test whether measured depth confirms background at rim pixels of the render, (N,) bool.

    False if the measurement is nearer than the rim point (an occluder) or at its depth (the object,
    although the mask does not show it). True if it is farther, or without a measurement.

    Args:
        at: (N, 2) rim pixels of the colour image.
        depth: (h, w) depth of the render, whose first pixel is ``corner`` of the image.
        rays: (H, W, 2) of the colour lens.
        depth_from_colour: (4, 4).
        lens: (13,) parameters of the depth lens.
        measured: window of the depth image whose first pixel is ``place``.
        free_m: a point measured this much behind the render is background, metres.
    """
    clear = np.ones(at.shape[0], np.bool_)
    for i in range(at.shape[0]):
        x, y, z = _on_ray(at[i], depth, corner, rays)
        px, py, pz = transform_point(depth_from_colour, x, y, z)
        u, v = project_point(px, py, pz, lens)
        column, row = int(np.rint(u)) - place[0], int(np.rint(v)) - place[1]
        if 0 <= column < measured.shape[1] and 0 <= row < measured.shape[0]:
            clear[i] = not (0 < measured[row, column] < pz + free_m)
    return clear


@numba.njit(cache=True, nogil=True)
def normal_equations(
    at, target, depth, corner, rays, parameters, master_from_colour, origin, scale
):
    """Sum the silhouette term: J'WJ (6, 6), J'Wr (6,) and the residuals (N,) in pixels.

    Columns as in :func:`.object_depth.normal_equations`.

    Args:
        at, target: (N, 2) matches of :func:`correspondences`.
        depth: (h, w) depth of the render, whose first pixel is ``corner`` of the image.
        rays, parameters: (H, W, 2) and (13,) of the colour lens.
        master_from_colour: (4, 4).
        origin: (3,) translation of the object, master frame.
        scale: Geman-McClure scale, pixels.
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
        mx, my, mz = transform_point(master_from_colour, x, y, z)
        ox, oy, oz = mx - origin[0], my - origin[1], mz - origin[2]
        row[0], row[1], row[2] = oy * az - oz * ay, oz * ax - ox * az, ox * ay - oy * ax
        row[3], row[4], row[5] = ax, ay, az
        robust = scale * scale / (scale * scale + residual * residual)
        weight = robust * robust
        add_row(hessian, gradient, row, residual, weight)
    return hessian, gradient, residuals


@numba.njit(cache=True, nogil=True)
def _on_ray(pixel, depth, corner, rays):
    """Return the rendered point under a pixel (2,) of the image, camera frame."""
    x, y = pixel[0], pixel[1]
    z = np.float64(depth[y - corner[1], x - corner[0]])
    return rays[y, x, 0] * z, rays[y, x, 1] * z, z


@numba.njit(cache=True, nogil=True)
def transform_point(transform, x, y, z):
    """Apply a transform (4, 4) to a point."""
    return (
        transform[0, 0] * x + transform[0, 1] * y + transform[0, 2] * z + transform[0, 3],
        transform[1, 0] * x + transform[1, 1] * y + transform[1, 2] * z + transform[1, 3],
        transform[2, 0] * x + transform[2, 1] * y + transform[2, 2] * z + transform[2, 3],
    )
