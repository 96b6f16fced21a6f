"""The other direction of E_D (equation 4): from vertices that a camera should see to its depth.

Beyond the paper. A vertex that faces a camera, and past which that camera measured something
clearly farther away, sticks out of the person. It has to go in along its normal until the measured
person begins:

    e = -d - c,    d = the way along -n, in the image, to the first pixel not seen through,

c the covering's thickness as in :mod:`intercap_core.body_fit.body_cloud`. The person's mask is not
used, so one that is too small, or lacks a hand, adds no bias; an occluder is nearer than the
vertex, and pixels without depth are unknown: neither has a residual.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.body_fit import free_space_kernel
from intercap_core.body_fit.constants import (
    FREE_SPACE_BEHIND_M,
    FREE_SPACE_FACING,
    FREE_SPACE_NEAREST_M,
    FREE_SPACE_REACH_M,
    FREE_SPACE_STEP_M,
)
from intercap_core.geometry.camera.rig import Camera


@dataclass(frozen=True, eq=False)
class DepthWindow:
    """Part of camera ``view``'s depth image: (h,w) uint16 mm, its first pixel's row, column."""

    view: int
    first: tuple[int, int]
    depth: np.ndarray


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
    return free_space_kernel.seen_through(
        window.depth, *window.first, tuple(camera.depth.parameters.tolist()),
        camera.depth_from_master, depth_bias, points, normals,
        FREE_SPACE_BEHIND_M, FREE_SPACE_FACING, FREE_SPACE_NEAREST_M, FREE_SPACE_REACH_M,
        FREE_SPACE_STEP_M,
    )  # fmt: skip
