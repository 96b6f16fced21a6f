"""Which patch of the object's surface every pixel shows, compiled."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def patch_of(point, normal, size):
    """Number of the patch that a surface point (3,) with a unit normal (3,) lies in: a cell of a
    grid of ``size`` metres, and the axis that the surface faces most."""
    facing = 0
    for axis in range(1, 3):
        if abs(normal[axis]) > abs(normal[facing]):
            facing = axis
    side = 2 * facing + (1 if normal[facing] > 0 else 0)
    number = 0
    for axis in range(3):
        number = number * 1024 + int(np.floor(point[axis] / size)) + 512
    return 6 * number + side


@numba.njit(cache=True, nogil=True)
def patches_of(points, normals, size):
    """:func:`patch_of` of points (N, 3): (N,) int64."""
    found = np.empty(len(points), np.int64)
    for i in range(len(points)):
        found[i] = patch_of(points[i], normals[i], size)
    return found


@numba.njit(cache=True, nogil=True)
def seen_patches(
    depth,
    face,
    x0,
    y0,
    mask,
    mx,
    my,
    rays,
    picture,
    light,
    object_from_camera,
    face_normals,
    size,
    steep,
):
    """Patches (n,) of the pixels that show the object, their faces (n,) and colours (n, 3).

    Of a rendering (h, w), ``depth`` and ``face``, whose first pixel is (x0, y0) of the image; they
    and their neighbours lie in the candidate's ``mask``, first pixel (mx, my). ``picture`` (H, W,
    3) uint8 BGR, ``light`` (256,) the logarithms of its levels, NaN where too dark or saturated;
    surfaces with a cosine to the ray below ``steep`` are left out. A colour is a brightness and the
    ratios of red and blue to green, in logarithms.
    """
    height, width = face.shape
    found = np.empty(height * width, np.int64)
    faces = np.empty(height * width, np.int64)
    colours = np.empty((height * width, 3))
    point = np.empty(3)
    count = 0
    for v in range(1, height - 1):
        for u in range(1, width - 1):
            f = face[v, u]
            if f < 0:
                continue
            blue = light[picture[y0 + v, x0 + u, 0]]
            green = light[picture[y0 + v, x0 + u, 1]]
            red = light[picture[y0 + v, x0 + u, 2]]
            if np.isnan(blue + green + red):
                continue
            inside = True
            for a, b in ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)):
                j, i = v + a + y0 - my, u + b + x0 - mx
                if face[v + a, u + b] < 0 or not (
                    0 <= j < mask.shape[0] and 0 <= i < mask.shape[1] and mask[j, i]
                ):
                    inside = False
            if not inside:
                continue
            z = depth[v, u]
            x, y = rays[y0 + v, x0 + u, 0] * z, rays[y0 + v, x0 + u, 1] * z
            across, length = 0.0, 0.0
            for axis in range(3):
                along = (
                    object_from_camera[axis, 0] * x
                    + object_from_camera[axis, 1] * y
                    + object_from_camera[axis, 2] * z
                )
                point[axis] = along + object_from_camera[axis, 3]
                across -= along * face_normals[f, axis]
                length += along * along
            if across < steep * np.sqrt(length):
                continue
            found[count], faces[count] = patch_of(point, face_normals[f], size), f
            colours[count, 0] = (blue + green + red) / 3
            colours[count, 1], colours[count, 2] = red - green, blue - green
            count += 1
    return found[:count], faces[:count], colours[:count]
