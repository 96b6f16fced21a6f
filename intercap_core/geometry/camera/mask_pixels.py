"""Search of the depth pixels that belong to a mask of the colour image.

Each depth pixel is projected into the colour image. It belongs to the mask if it falls on the mask
and is visible to the colour camera. It is hidden if a clearly nearer pixel falls close to it.
:mod:`intercap_core.geometry.camera.clouds` does the same for whole images; here it is done in
single precision, and only for pixels that can reach the mask.
"""

from __future__ import annotations

import numba
import numpy as np

from intercap_core.geometry.camera.clouds import CELL_SPACINGS, HIDDEN_BEHIND_M
from intercap_core.geometry.camera.masks import Runs
from intercap_core.geometry.camera.projection import MIN_DEPTH_M
from intercap_core.geometry.camera.projection_kernels import distort, project_point
from intercap_core.geometry.camera.rig import Camera

Window = tuple[slice, slice]

_HALF = np.float32(0.5)
_GRID = np.stack(np.meshgrid(*2 * [np.linspace(0, 1, 5)]), -1).reshape(-1, 2)


def mask_window(depth: np.ndarray, camera: Camera, mask: Runs) -> Window | None:
    """Return the rows and columns of the depth image (H, W) that can show the mask.

    None if there are none: the mask is empty, outside of the depth image, or there is no depth.

    A grid of 5 x 5 points of the mask's box is placed at three depths and projected into the depth
    image.
    """
    if mask.box[2] == 0 or camera.depth is None or camera.colour_from_depth is None:
        return None
    rays = camera.colour.unproject(mask.box[:2] + _GRID * mask.box[2:])
    low, high = _depth_range(
        rays, camera.colour_from_depth, tuple(camera.depth.parameters.tolist())
    )
    height, width = depth.shape
    margin = 6  # px of the depth image
    x0, y0 = np.floor(low).astype(int) - margin
    x1, y1 = np.ceil(high).astype(int) + margin
    rows = slice(max(int(y0), 0), min(int(y1), height))
    columns = slice(max(int(x0), 0), min(int(x1), width))
    return None if rows.start >= rows.stop or columns.start >= columns.stop else (rows, columns)


def mask_pixels(
    depth: np.ndarray,
    camera: Camera,
    mask: Runs,
    window: Window,
    *,
    background: np.ndarray | None = None,
    before_m: float = 0.0,
    every: int = 1,
) -> np.ndarray:
    """Return the flat indices (M,), ascending, of the depth pixels that belong to the mask.

    Args:
        depth: (H, W) mm.
        camera: camera with depth.
        mask: mask of the colour image; not empty.
        window: rows and columns that are searched.
        background: (H, W) depth of the empty room, mm, 0 = unknown. Only pixels in front of it
            count, and only they can hide others.
        before_m: distance by which a pixel must be nearer than the background, metres.
        every: only every n-th row and column is returned. All pixels can hide others.
    """
    assert camera.depth is not None and camera.colour_from_depth is not None
    colour, (rows, columns) = camera.colour, window
    spacing = max(colour.fx / camera.depth.fx, colour.fy / camera.depth.fy, 1.0)
    return _mask_pixels(
        depth,
        np.zeros((0, 0), np.uint16) if background is None else background,
        int(1000 * before_m),
        (rows.start, rows.stop),
        (columns.start, columns.stop),
        every,
        camera.depth.rays,
        camera.colour_from_depth.astype(np.float32),
        tuple(colour.parameters.astype(np.float32)),
        (colour.height, colour.width),
        mask.ends,
        mask.box,
        np.float32(CELL_SPACINGS * spacing),
        # depth that is aligned to the colour grid contains no pixel that the colour camera misses
        np.float32(np.inf if camera.aligned else HIDDEN_BEHIND_M),
    )


@numba.njit(cache=True, nogil=True)
def _mask_pixels(
    depth,
    background,
    before_mm,
    rows,
    columns,
    every,
    rays,
    pose,
    lens,
    size,
    ends,
    box,
    cell,
    hidden_m,
):
    """Compiled form of :func:`mask_pixels`; numbers that are not integers are float32.

    Two passes over the window. The first projects each pixel that counts, and stores the smallest
    depth in each cell of a coarse grid of the colour image (``nearest``). The second returns the
    pixels that fall on the mask, except those that are ``hidden_m`` behind the smallest depth in
    their own or a neighbouring cell (``front``).

    Args:
        depth: (H, W) uint16 mm.
        background: (H, W) mm, or empty.
        before_mm: a pixel counts if it is nearer than the background by more than this.
        rows, columns: first and end of the window.
        rays: (H, W, 2) of the depth lens.
        pose: (4, 4) colour_from_depth.
        lens: 13 parameters of the colour lens.
        size: height and width of the colour image.
        ends, box: runs of the mask, and its x, y, width, height.
        cell: side of a cell of the visibility test, colour pixels.
        hidden_m: a pixel this far behind another one in a neighbouring cell is hidden.
    """
    mask = decode_box(ends, box, size[0])
    cells_across, cells_down = int(size[1] / cell) + 1, int(size[0] / cell) + 1
    # cells around those that the mask touches
    left, top = max(int(box[0] / cell) - 2, 0), max(int(box[1] / cell) - 2, 0)
    right = min(int((box[0] + box[2]) / cell) + 3, cells_across)
    bottom = min(int((box[1] + box[3]) / cell) + 3, cells_down)
    nearest = np.full((bottom - top, right - left), np.float32(np.inf))
    height, width = rows[1] - rows[0], columns[1] - columns[0]
    u, v, z = (
        np.empty((height, width), np.float32),
        np.empty((height, width), np.float32),
        np.empty((height, width), np.float32),
    )
    counts = np.empty(width, np.bool_)  # whether a pixel counts
    for r in range(height):
        near = depth[rows[0] + r, columns[0] : columns[1]]
        if background.size:
            behind = background[rows[0] + r, columns[0] : columns[1]]
            for c in range(width):
                farther = np.int32(behind[c]) - np.int32(before_mm)
                counts[c] = (near[c] > 0) & ((behind[c] == 0) | (np.int32(near[c]) < farther))
        else:
            for c in range(width):
                counts[c] = near[c] > 0
        first, last = 0, width
        while first < last and not counts[first]:
            first += 1
        while first < last and not counts[last - 1]:
            last -= 1
        z[r, :first], z[r, last:] = 0, 0
        row = rays[rows[0] + r, columns[0] + first : columns[0] + last]
        # contiguous copies, without which the loop over pixels is not vectorised
        across, down = row[:, 0].copy(), row[:, 1].copy()
        at = slice(first, last)
        _project(near[at], counts[at], across, down, pose, lens, u[r, at], v[r, at], z[r, at])
        for c in range(first, last):
            if z[r, c] > 0:
                i = int(np.floor((v[r, c] + _HALF) / cell)) - top
                j = int(np.floor((u[r, c] + _HALF) / cell)) - left
                if 0 <= i < bottom - top and 0 <= j < right - left:
                    nearest[i, j] = min(nearest[i, j], z[r, c])
    front = _smallest_around(nearest)
    index = np.empty((-(-height // every)) * (-(-width // every)), np.int64)
    count = 0
    for r in range(0, height, every):
        for c in range(0, width, every):
            if not z[r, c] > 0:
                continue
            x, y = int(np.rint(u[r, c])) - box[0], int(np.rint(v[r, c])) - box[1]
            if not (0 <= x < box[2] and 0 <= y < box[3] and mask[x, y]):
                continue
            i = int(np.floor((v[r, c] + _HALF) / cell)) - top
            j = int(np.floor((u[r, c] + _HALF) / cell)) - left
            if not z[r, c] > front[i, j] + hidden_m:
                index[count] = (rows[0] + r) * depth.shape[1] + columns[0] + c
                count += 1
    return index[:count].copy()


@numba.njit(cache=True, nogil=True)
def _depth_range(rays, pose, lens):
    """Return the smallest and largest column and row, (2,) each, of rays in the depth image.

    ``rays`` (N, 3), colour frame, are cut at three depths; those that are not finite are skipped.
    pose: (4, 4) colour_from_depth; lens: (13,) of the depth camera.
    """
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for ray in rays:
        if not np.isfinite(ray).all():
            continue
        for z in (0.7, 2.0, 6.0):  # metres, near and far ends of a room
            x, y, z = (pose[:3, :3].T * (z * ray - pose[:3, 3])).sum(1)
            for k, at in enumerate(project_point(x, y, z, lens)):
                low[k], high[k] = min(low[k], at), max(high[k], at)
    return low, high


@numba.njit(cache=True, nogil=True)
def _smallest_around(values):
    """Return the minimum (h, w) over the 3 x 3 neighbours of each of ``values`` (h, w)."""
    height, width = values.shape
    result = values.copy()
    for i in range(height):
        for j in range(1, width):
            result[i, j] = min(result[i, j], values[i, j - 1])
        for j in range(width - 1):
            result[i, j] = min(result[i, j], values[i, j + 1])
    along = result.copy()
    for i in range(height):
        for k in range(max(i - 1, 0), min(i + 2, height)):
            for j in range(width):
                result[i, j] = min(result[i, j], along[k, j])
    return result


@numba.njit(cache=True, nogil=True)
def decode_box(ends, box, height):
    """Return the mask within its box, (w, h) bool: axis 0 is the column. ends, box: of `Runs`."""
    mask = np.zeros((box[2], box[3]), np.bool_)
    for run in range(1, len(ends), 2):
        start, end = ends[run - 1], ends[run]
        while start < end:  # one column at a time
            column, row = start // height, start % height
            count = min(end - start, height - row)
            first = row - box[1]
            mask[column - box[0], first : first + count] = True
            start += count
    return mask


@numba.njit(cache=True, nogil=True, error_model="numpy")  # divisions that fail are no exceptions
def _project(near, counts, across, down, pose, lens, u, v, z):
    """Write colour pixels and depth (W,) of a row of depth pixels to ``u``, ``v`` and ``z``.

    ``across`` and ``down`` (W,) are the X/Z and Y/Z of their rays. The depth is 0 if the pixel does
    not count or its point is outside the lens model.
    """
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, limit = lens
    distortion = (k1, k2, p1, p2, k3, k4, k5, k6)
    a, b, c, d = pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]
    e, f, g, h = pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]
    i, j, k, m = pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]
    one, millimetre, least = np.float32(1), np.float32(1e-3), np.float32(MIN_DEPTH_M)
    for at in range(len(near)):
        pz = np.float32(near[at]) * millimetre
        px, py = across[at] * pz, down[at] * pz
        x, y = a * px + b * py + c * pz + d, e * px + f * py + g * pz + h
        depth = i * px + j * py + k * pz + m
        reach = limit * depth
        inside = counts[at] & (depth > least) & (x * x + y * y <= reach * reach)
        inverse = one / max(depth, least)
        x, y = x * inverse, y * inverse
        xd, yd = distort(x, y, distortion)
        u[at], v[at] = fx * xd + cx, fy * yd + cy
        z[at] = depth if inside else np.float32(0)
