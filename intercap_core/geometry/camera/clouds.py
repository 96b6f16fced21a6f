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
# metres. It is more than the change of depth over a cell of a surface that is 3 m away and inclined
# by 80 degrees.
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

    def sample(self, image: np.ndarray, outside: float = 0) -> np.ndarray:
        """Read the colour-sized ``image`` (H, W) at every point (N,), else ``outside``."""
        shown = (self.colour_index >= 0) & ~self.hidden
        values = np.full(len(self.depth_index), outside, image.dtype)
        values[shown] = image.ravel()[self.colour_index[shown]]
        return values


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


def master_points(depth: np.ndarray, camera: Camera, index: np.ndarray | None = None) -> Cloud:
    """Return the points of a depth image in the master frame; see :func:`depth_points`."""
    cloud = depth_points(depth, camera, index)
    return Cloud(apply(camera.master_from_depth, cloud.points), cloud.depth_index)


def colour_lookup(
    depth: np.ndarray, camera: Camera, index: np.ndarray | None = None
) -> ColourLookup:
    """Find the colour pixel of every valid depth pixel, or of those in ``index`` (flat).

    All depth pixels that could cover a point are projected into a coarse z-buffer of the colour
    image, whose cells are large enough to leave no holes. A point is hidden if the z-buffer is more
    than ``HIDDEN_BEHIND_M`` nearer in the point's own cell or a neighbouring one. Because of the
    neighbours, about two depth pixels at the edge of a nearer surface count as hidden too. If depth
    lies on the pixel grid of the colour image (:attr:`.rig.Camera.aligned`), nothing is hidden.
    Raises ValueError as :func:`depth_points` does.
    """
    cloud = depth_points(depth, camera, index)
    if camera.aligned:
        hidden = np.zeros(len(cloud.depth_index), bool)
        return ColourLookup(cloud.depth_index, cloud.depth_index.astype(np.int64), hidden)
    colour = camera.colour
    wanted = _to_colour(cloud, camera)
    pixels, z = wanted
    column = np.rint(pixels[:, 0]).astype(np.int64)
    row = np.rint(pixels[:, 1]).astype(np.int64)
    inside = (column >= 0) & (row >= 0) & (column < colour.width) & (row < colour.height)
    inside &= z > 0
    colour_index = np.where(inside, row * colour.width + column, -1)
    occluders = wanted
    if index is not None and len(cloud.depth_index):
        occluders = _to_colour(
            depth_points(depth, camera, _around(depth, camera, cloud.depth_index)), camera
        )
    hidden = inside & _covered(pixels, z, *occluders, camera)
    return ColourLookup(cloud.depth_index, colour_index, hidden)


def _to_colour(cloud: Cloud, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return colour pixels (N, 2) and colour camera depths (N,), 0 outside the lens model."""
    assert camera.colour_from_depth is not None
    points = apply(camera.colour_from_depth, cloud.points)
    z = np.where(camera.colour.inside_model(points), points[:, 2], np.float32(0))
    return camera.colour.project(points), z


def _around(depth: np.ndarray, camera: Camera, index: np.ndarray) -> np.ndarray:
    """Return all valid depth pixels that could cover those in ``index`` in the colour camera.

    The depth pixels of two points on one colour ray differ by at most the stereo disparity of the
    nearest point that the sensor measures.
    """
    assert camera.depth is not None and camera.colour_from_depth is not None
    width = camera.depth.width
    baseline = np.abs(camera.colour_from_depth[:2, 3])
    nearest = 0.25  # metres, lower limit of the sensor (WFOV; Azure Kinect DK specification)
    pad_x, pad_y = (
        int(b * f / nearest) + 4
        for b, f in zip(baseline, (camera.depth.fx, camera.depth.fy), strict=True)
    )
    rows, columns = np.divmod(index, width)
    top, bottom = max(0, rows.min() - pad_y), rows.max() + pad_y + 1
    left, right = max(0, columns.min() - pad_x), columns.max() + pad_x + 1
    local_row, local_column = np.nonzero(depth[top:bottom, left:right])
    return (local_row + top) * width + local_column + left


def _covered(
    pixels: np.ndarray,
    z: np.ndarray,
    occluder_pixels: np.ndarray,
    occluder_z: np.ndarray,
    camera: Camera,
) -> np.ndarray:
    """Return whether points (N,) lie behind an occluder in their cell of the colour image."""
    colour, depth = camera.colour, camera.depth
    assert depth is not None
    cell = CELL_SPACINGS * max(colour.fx / depth.fx, colour.fy / depth.fy, 1.0)
    across, down = int(colour.width / cell) + 1, int(colour.height / cell) + 1

    def cells(at: np.ndarray, at_z: np.ndarray) -> np.ndarray:
        column = np.floor((at[:, 0] + 0.5) / cell).astype(np.int64)
        row = np.floor((at[:, 1] + 0.5) / cell).astype(np.int64)
        inside = (column >= 0) & (row >= 0) & (column < across) & (row < down) & (at_z > 0)
        return np.where(inside, row * across + column, across * down)  # one cell for all others

    nearest = np.full(across * down + 1, np.inf, np.float32)
    np.minimum.at(nearest, cells(occluder_pixels, occluder_z), occluder_z)
    nearest[-1] = np.inf
    nearest[:-1] = minimum_filter(nearest[:-1].reshape(down, across), 3, mode="nearest").ravel()
    return z > nearest[cells(pixels, z)] + HIDDEN_BEHIND_M
