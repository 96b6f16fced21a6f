"""Free space as a measurement of E_D (equation 4), from visible vertices to the measured depth.

Beyond the paper; E_D itself leads from measured points to vertices. A camera measures free space in
front of each depth pixel. A vertex that faces the camera and projects to a pixel whose depth is
clearly larger than the vertex's lies in free space: it protrudes from the person. It has to move
inward along its normal n until it reaches a pixel whose depth is no longer larger:

    e = -d - c,    d = this distance along -n, found by steps of 1 cm

with the thickness c of the covering as in :mod:`.cloud_term`. The person's mask is not used, so a
mask that is too small or lacks a hand adds no bias. A vertex behind an occluder, or at a pixel
without depth, has no residual.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from intercap_core.geometry.camera.projection_kernels import project_point
from intercap_core.geometry.camera.rig import Camera

# A depth that exceeds a vertex's by more than this is not the person's surface, metres. Tuned on
# the studio.
_BEHIND_M = 0.06
# Largest cosine of the normal and the viewing direction, -1 = facing the camera, 0 = on the rim: up
# to 6 degrees beyond the rim. Tuned on the studio.
_FACING = 0.1
# Smallest depth of a vertex, metres, with a margin: the Azure Kinect (NFOV) measures from 0.5 m
# (data sheet).
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
    window: DepthWindow, camera: Camera, depth_bias: float, points: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Find points that protrude from the person in one view.

    Args:
        window: depth around the person.
        camera: the camera.
        depth_bias: excess of the depth that the camera measures, metres.
        points: (N, 3) master frame, metres.
        normals: (N, 3) unit normals.

    Returns:
        (M,) index of each point that protrudes by 1 to 5 cm. Points that protrude farther are
            left out.
        (M,) distance by which it protrudes, metres, > 0.
    """
    assert camera.depth is not None
    return _find_protruding(
        window.depth, *window.first, tuple(camera.depth.parameters.tolist()),
        camera.depth_from_master, depth_bias + _BEHIND_M, points, normals,
    )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def _find_protruding(depth, top, left, lens, pose, behind, points, normals):
    """Compiled form of :func:`find_protruding`.

    depth (h,w): uint16, mm. top, left: row and column of its first pixel in the image.
    lens: thirteen intrinsic parameters. pose (4,4): depth_from_master.
    behind: a depth that exceeds a vertex's by more than this, metres, is not the person's.
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
            # A single step is ignored: it is within the error of the image. Since only errors
            # outward would count, not errors inward, every person would become thinner.
            if s > 1:
                # the middle between the last point outside the person and the first one inside
                index[count], away[count] = i, way - step / 2
                count += 1
            break
    return index[:count].copy(), away[:count].copy()


@numba.njit(cache=True, nogil=True)
def _is_measured_behind(depth, top, left, lens, x, y, z, behind):
    """Return whether the depth measured at a point's pixel exceeds its z by ``behind``, metres.

    x, y, z: the point in the frame of the depth camera, metres.
    """
    u, v = project_point(x, y, z, lens)
    if not (np.isfinite(u) and np.isfinite(v)):
        return False
    column, row = np.rint(u - left), np.rint(v - top)
    if not (0 <= row < depth.shape[0] and 0 <= column < depth.shape[1]):
        return False
    return depth[int(row), int(column)] * 1e-3 > z + behind
