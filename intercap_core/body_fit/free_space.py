"""The opposite direction of E_D (equation 4): from visible vertices to the measured depth.

Beyond the paper. A vertex that faces a camera, and behind which that camera measured a surface
clearly farther away, sticks out of the person. It has to move inward along its normal until the
measured person begins:

    e = -d - c,    d = distance along -n after which the pixel there is no longer farther away

with the thickness c of the covering as in :mod:`.cloud_term`. The person's mask is not used, so a
mask that is too small or lacks a hand adds no bias. An occluder is nearer than the vertex, and
pixels without depth are unknown: neither has a residual.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from intercap_core.geometry.camera.projection_kernels import project_point
from intercap_core.geometry.camera.rig import Camera

# Metres behind a vertex from which a depth is not the person's surface. Tuned on the studio.
_BEHIND_M = 0.06
# Largest cosine of the normal and the viewing direction, -1 = facing the camera: up to 6 degrees
# beyond the rim. Tuned on the studio.
_FACING = 0.1
# Smallest depth of a vertex, metres: the Azure Kinect (NFOV) measures from 0.5 m (data sheet).
_NEAREST_M = 0.3


@dataclass(frozen=True, eq=False)
class DepthWindow:
    """Part of a camera's depth image."""

    view: int
    """Camera index."""
    first: tuple[int, int]
    """Row and column of the first pixel in the image."""
    depth: np.ndarray
    """(h, w) uint16, mm."""


def find_protruding(
    window: DepthWindow,
    camera: Camera,
    depth_bias: float,
    points: np.ndarray,
    normals: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Find points that stick out of the person in one view.

    Args:
        window: depth around the person.
        camera: the camera.
        depth_bias: distance that the camera measures too much, metres.
        points: (N, 3) master frame, metres.
        normals: (N, 3) unit normals.

    Returns:
        (M,) index of each point that sticks out of the person by 1 to 5 cm.
        (M,) distance by which it sticks out, metres, > 0.
    """
    assert camera.depth is not None
    return _find_protruding(
        window.depth, *window.first, tuple(camera.depth.parameters.tolist()),
        camera.depth_from_master, depth_bias + _BEHIND_M, points, normals,
    )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def _find_protruding(depth, top, left, lens, pose, behind, points, normals):
    """Compiled form of :func:`find_protruding`.

    depth (h,w) uint16 mm, whose first pixel is at row ``top`` and column ``left`` of the image;
    lens: thirteen parameters; pose (4,4): depth_from_master; behind: metres behind a vertex from
    which a depth is not the person's.
    """
    index, away = np.empty(len(points), np.int64), np.empty(len(points))
    count = 0
    steps, step = 5, 0.01  # number and length of the steps inward, metres; tuned on the studio
    for i in range(len(points)):
        px, py, pz = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
        if not z > _NEAREST_M:
            continue
        x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]
        y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]
        px, py, pz = np.float64(normals[i, 0]), np.float64(normals[i, 1]), np.float64(normals[i, 2])
        nx = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz
        ny = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz
        nz = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz
        if not nx * x + ny * y + nz * z < _FACING * np.sqrt(x * x + y * y + z * z):
            continue
        if not _is_measured_behind(depth, top, left, lens, x, y, z, behind):
            continue
        for s in range(1, steps + 1):
            way = s * step
            inward = x - way * nx, y - way * ny, z - way * nz
            if _is_measured_behind(depth, top, left, lens, *inward, behind):
                continue
            # A single step is left out as within the error of the image: errors outward would
            # count and errors inward would not, which makes every person thinner.
            if s > 1:
                # the middle between the last point outside the person and the first one inside
                index[count], away[count] = i, way - step / 2
                count += 1
            break
    return index[:count].copy(), away[:count].copy()


@numba.njit(cache=True, nogil=True)
def _is_measured_behind(depth, top, left, lens, x, y, z, behind):
    """Return whether a camera's depth at a point of its frame is ``behind`` metres farther."""
    u, v = project_point(x, y, z, lens)
    if not (np.isfinite(u) and np.isfinite(v)):
        return False
    column, row = np.rint(u - left), np.rint(v - top)
    if not (0 <= row < depth.shape[0] and 0 <= column < depth.shape[1]):
        return False
    return depth[int(row), int(column)] * 1e-3 > z + behind
