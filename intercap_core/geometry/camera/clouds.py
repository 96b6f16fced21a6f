"""Points of depth images, and the colour pixel that shows each of them.

Pixels are addressed by their flat index, row * width + column, so that ``image.ravel()[index]``
reads them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import minimum_filter

from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import apply

# A point is hidden if it is this far behind the nearest point of its cell of the colour image,
# metres. It is more than the change of depth over a cell of a Kinect, 7 mm wide, on a surface that
# is 3 m away and inclined by 80 degrees.
HIDDEN_BEHIND_M = 0.05
# Side of a cell of the visibility test, in distances between projected depth pixels; above 1, so
# that a surface leaves no cell empty.
CELL_SPACINGS = 1.25


class Cloud(NamedTuple):
    """Points of a depth image."""

    points: np.ndarray
    """(N, 3) float32, metres."""
    depth_index: np.ndarray
    """(N,) flat depth pixel of each point."""


class ColourLookup(NamedTuple):
    """Positions of depth pixels in the colour image."""

    depth_index: np.ndarray
    """(N,) flat depth pixel."""
    colour_index: np.ndarray
    """(N,) flat colour pixel, -1 outside the image."""
    hidden: np.ndarray
    """(N,) bool: a nearer surface covers the point in the colour camera."""

    @property
    def shown(self) -> np.ndarray:
        """(N,) bool: the colour image shows the point."""
        return (self.colour_index >= 0) & ~self.hidden


def depth_points(depth: np.ndarray, camera: Camera, index: np.ndarray | None = None) -> Cloud:
    """Return the points of a depth image (H, W) uint16 mm in the *depth camera's* frame.

    ``index`` selects flat pixels; None = all. Invalid pixels (0, or outside of the lens's metric
    radius) are left out. Raises ValueError if the image does not fit the camera.
    """
    lens = camera.depth
    if lens is None or depth.shape != (lens.height, lens.width):
        raise ValueError(f"a depth image {depth.shape} does not fit camera {camera.name}")
    values = depth.ravel()
    index = np.flatnonzero(values) if index is None else index[values[index] > 0]
    z = values[index] * np.float32(1e-3)
    points = np.empty((len(index), 3), np.float32)
    points[:, :2] = lens.rays.reshape(-1, 2)[index]
    points[:, :2] *= z[:, None]
    points[:, 2] = z
    known = np.isfinite(points[:, 0])
    return Cloud(points, index) if known.all() else Cloud(points[known], index[known])


def master_points(depth: np.ndarray, camera: Camera) -> Cloud:
    """Return the points of a depth image in the master frame; see :func:`depth_points`."""
    cloud = depth_points(depth, camera)
    return Cloud(apply(camera.master_from_depth, cloud.points), cloud.depth_index)


def colour_lookup(depth: np.ndarray, camera: Camera) -> ColourLookup:
    """Find the colour pixel of every valid depth pixel.

    All depth pixels are projected into a coarse z-buffer of the colour image, whose cells are large
    enough to leave no holes. A point is hidden if the z-buffer is more than ``HIDDEN_BEHIND_M``
    nearer in the point's own cell or a neighbouring one. Because of the neighbours, about two depth
    pixels at the edge of a nearer surface count as hidden too. If depth lies on the pixel grid of
    the colour image (:attr:`.rig.Camera.aligned`), nothing is hidden.
    Raises ValueError as :func:`depth_points` does.
    """
    points, depth_index = depth_points(depth, camera)
    if camera.aligned:
        hidden = np.zeros(len(depth_index), bool)
        return ColourLookup(depth_index, depth_index.astype(np.int64), hidden)
    assert camera.colour_from_depth is not None
    colour = camera.colour
    points = apply(camera.colour_from_depth, points)
    pixels = colour.project(points)
    z = np.where(colour.inside_model(points), points[:, 2], np.float32(0))
    column, row = np.rint(pixels).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < colour.width) & (row < colour.height)
    inside &= z > 0
    colour_index = np.where(inside, row * colour.width + column, -1)
    return ColourLookup(depth_index, colour_index, inside & _covered(pixels, z, camera))


def _covered(pixels: np.ndarray, z: np.ndarray, camera: Camera) -> np.ndarray:
    """Return whether points (N,) lie behind another one in their cell of the colour image.

    ``pixels`` (N, 2) and ``z`` (N,) are of the colour camera; z is 0 outside the lens model.
    """
    colour, depth = camera.colour, camera.depth
    assert depth is not None
    cell = CELL_SPACINGS * max(colour.fx / depth.fx, colour.fy / depth.fy, 1.0)
    across, down = int(colour.width / cell) + 1, int(colour.height / cell) + 1
    column = np.floor((pixels[:, 0] + 0.5) / cell).astype(np.int64)
    row = np.floor((pixels[:, 1] + 0.5) / cell).astype(np.int64)
    inside = (column >= 0) & (row >= 0) & (column < across) & (row < down) & (z > 0)
    cells = np.where(inside, row * across + column, across * down)  # one cell for all others
    nearest = np.full(across * down + 1, np.inf, np.float32)
    np.minimum.at(nearest, cells, z)
    nearest[-1] = np.inf
    nearest[:-1] = minimum_filter(nearest[:-1].reshape(down, across), 3, mode="nearest").ravel()
    return z > nearest[cells] + HIDDEN_BEHIND_M
