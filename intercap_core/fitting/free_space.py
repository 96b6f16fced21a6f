"""The other direction of E_D: vertices that a camera should see, against what it measured there.

A vertex that faces a camera, and past which that camera measured something clearly farther away,
sticks out of the person. It has to go in along its normal until the measured person begins:

    e = -d - c,    d = the way along -n, in the image, to the first pixel not seen through,

c the covering's thickness as in :mod:`intercap_core.energy.body_cloud`. The person's mask has no
say, so one that is too small, or lacks a hand, draws nothing to it; what hides the vertex is nearer
than it, and pixels without depth are unknown: neither pulls.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.camera.rig import Camera
from intercap_core.camera.transforms import apply

_BEHIND_M = 0.06  # farther behind the vertex is not the person's surface there
_FACING = 0.1  # cosine between normal and line of sight; larger ones look away
_REACH_M = 0.05
_WAY_M = 0.01  # steps along the way in


@dataclass(frozen=True, eq=False)
class DepthWindow:
    """Part of camera ``view``'s depth image: (h,w) uint16 mm, its first pixel's row, column."""

    view: int
    first: tuple[int, int]
    depth: np.ndarray

    def at(self, pixels: np.ndarray) -> np.ndarray:
        """Depth (...,) in metres at pixels (...,2) x, y of the whole image; 0 = unknown."""
        known = np.isfinite(pixels).all(-1)
        place = np.where(known[..., None], pixels, -1e6) - np.array(self.first[::-1])
        column, row = np.rint(np.moveaxis(place, -1, 0)).astype(np.int64)
        height, width = self.depth.shape
        known &= (row >= 0) & (row < height) & (column >= 0) & (column < width)
        found = self.depth[np.where(known, row, 0), np.where(known, column, 0)]
        return np.where(known, found, 0) * 1e-3


def seen_through(
    window: DepthWindow,
    camera: Camera,
    depth_bias: float,
    points: np.ndarray,
    normals: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Which points (M,) stick out in one view, and how far, metres, M values > 0.

    points, unit normals (N,3), master frame; ``depth_bias`` metres that the camera measures too
    much. Those for which no person begins within reach are left out.
    """
    assert camera.depth is not None
    pose = camera.depth_from_master
    local = apply(pose, points)
    outward = normals @ pose[:3, :3].T
    sight = local / np.linalg.norm(local, axis=1, keepdims=True)
    index = np.flatnonzero(((outward * sight).sum(1) < _FACING) & (local[:, 2] > 0.3))
    index = index[_past(window, camera, depth_bias, local[index])]
    if not len(index):
        return index, np.zeros(0)
    way = np.arange(_WAY_M, _REACH_M + _WAY_M / 2, _WAY_M)
    inward = local[index, None] - way[:, None] * outward[index, None]
    through = _past(window, camera, depth_bias, inward)
    # the nearest step is within the image's own error: counting only those that err outward would
    # make everybody thinner
    ends = ~through.all(1) & through[:, 0]
    # half a step back: the edge is between the last that is seen through and the first that is not
    return index[ends], way[through[ends].argmin(1)] - _WAY_M / 2


def _past(window: DepthWindow, camera: Camera, depth_bias: float, local: np.ndarray) -> np.ndarray:
    """Where (...,) the camera measured clearly behind points (...,3), depth camera's frame."""
    assert camera.depth is not None
    measured = window.at(camera.depth.project(local))
    return measured - depth_bias > local[..., 2] + _BEHIND_M
