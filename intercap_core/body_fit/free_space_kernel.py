"""The test of :mod:`.free_space` (beyond equation 4), compiled: one view, point by point."""

from __future__ import annotations

import numba
import numpy as np

from intercap_core.geometry.camera.projection_kernels import project_point


@numba.njit(cache=True, nogil=True)
def seen_through(
    depth,
    top,
    left,
    lens,
    pose,
    bias,
    points,
    normals,
    behind,
    facing,
    nearest,
    reach,
    step,
):
    """Numbers (M,) of the points (N,3) that stick out, and how far (M,), metres, float64.

    ``depth`` (h,w) uint16 mm, its first pixel at row ``top``, column ``left`` of the image;
    ``lens`` thirteen parameters; ``pose`` (4,4) depth_from_master. Normals look towards the camera
    where their cosine with the line of sight is below ``facing``; points nearer than ``nearest``
    metres are left out, and those that ``reach`` metres along the normal in steps of ``step`` do
    not bring to where nothing ``behind`` metres farther is seen.
    """
    index, away = np.empty(len(points), np.int64), np.empty(len(points))
    count, steps = 0, int(np.rint(reach / step))
    for i in range(len(points)):
        px, py, pz = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
        if not z > nearest:
            continue
        x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]
        y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]
        px, py, pz = np.float64(normals[i, 0]), np.float64(normals[i, 1]), np.float64(normals[i, 2])
        nx = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz
        ny = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz
        nz = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz
        if not nx * x + ny * y + nz * z < facing * np.sqrt(x * x + y * y + z * z):
            continue
        if not _past(depth, top, left, lens, x, y, z, bias + behind):
            continue
        for s in range(1, steps + 1):
            way = s * step
            if _past(
                depth, top, left, lens, x - way * nx, y - way * ny, z - way * nz, bias + behind
            ):
                continue
            # the nearest step is within the image's own error: counting only those that err
            # outward would make everybody thinner
            if s > 1:
                # half a step back: between the last that is seen through and the first that is not
                index[count], away[count] = i, way - step / 2
                count += 1
            break
    return index[:count].copy(), away[:count].copy()


@numba.njit(cache=True, nogil=True)
def _past(depth, top, left, lens, x, y, z, behind):
    """Whether more than ``behind`` metres farther than the point, depth camera's frame, is seen."""
    u, v = project_point(x, y, z, lens)
    if not (np.isfinite(u) and np.isfinite(v)):
        return False
    column, row = np.rint(u - left), np.rint(v - top)
    if not (0 <= row < depth.shape[0] and 0 <= column < depth.shape[1]):
        return False
    return depth[int(row), int(column)] * 1e-3 > z + behind
