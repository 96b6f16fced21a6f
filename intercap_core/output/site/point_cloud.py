"""Coloured point clouds of all cameras in one frame set, and their rendering."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.clouds import colour_lookup
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply
from intercap_core.output.site.drawing import look_at

_BEHIND_M = 0.03  # a pixel covers neighbours that are more than this farther away
# Row and column offsets of a pixel's neighbours
_NEIGHBOURS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))


@dataclass(frozen=True, eq=False)
class CameraPoints:
    """Points that one camera measured, in its depth camera's frame."""

    c: int
    """Index of the camera."""
    points: np.ndarray
    """(N, 3) metres."""
    normals: np.ndarray
    """(N, 3) unit vectors."""
    rays: np.ndarray
    """(N, 3) viewing rays with z = 1: points = depth x rays."""
    colours: np.ndarray
    """(N, 3) RGB in 0..1."""


@dataclass(frozen=True, eq=False)
class FusedCloud:
    """Points of all cameras in one coordinate frame."""

    points: np.ndarray
    """(N, 3) metres."""
    normals: np.ndarray
    """(N, 3) unit vectors."""
    colours: np.ndarray
    """(N, 3) RGB in 0..1."""
    camera: np.ndarray
    """(N,) index of the measuring camera."""

    def where(self, kept: np.ndarray) -> FusedCloud:
        """Return the points of a mask (N,)."""
        return FusedCloud(
            self.points[kept], self.normals[kept], self.colours[kept], self.camera[kept]
        )


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A camera without distortion (x right, y down, z forward) and its pose."""

    view_from_world: np.ndarray
    """(4, 4) transform to the camera's frame."""
    lens: Intrinsics

    @classmethod
    def towards(
        cls, target: np.ndarray, azimuth: float, elevation: float, distance: float, lens: Intrinsics
    ) -> Viewpoint:
        """Look at ``target`` (3,), z up, from ``distance`` metres; angles in radians."""
        away = Rotation.from_euler("ZY", [azimuth, -elevation]).as_matrix()[:, 0]
        return cls(look_at(target, -away, np.array([0.0, 0.0, 1.0]), distance), lens)

    @property
    def eye(self) -> np.ndarray:
        """Position (3,) in the world."""
        return -self.view_from_world[:3, :3].T @ self.view_from_world[:3, 3]

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels (N, 2) and depths (N,) of points (N, 3); pixel centres are integers."""
        local = apply(self.view_from_world, points)
        z = local[:, 2]
        middle = np.array([self.lens.cx, self.lens.cy], points.dtype)
        safe = np.where(z > 1e-6, z, 1)
        return local[:, :2] * (points.dtype.type(self.lens.fx) / safe[:, None]) + middle, z

    def contains(self, points: np.ndarray, border: float) -> bool:
        """Return whether all points (N, 3) are at least ``border`` pixels inside the image."""
        at, z = self.project(points)
        high = np.array([self.lens.width, self.lens.height]) - border
        return bool((z > 0).all() and (at > border).all() and (at < high).all())


def measured_points(images: Frames, rig: Rig, t: int) -> list[CameraPoints]:
    """Compute the points of every camera with a depth image in set ``t``, thinned evenly.

    Raises UserError if a recorded image does not decode.
    """
    seen = [c for c, camera in enumerate(rig) if camera.depth and images.depth_available[t, c]]
    most = 600_000 // max(1, len(seen))  # in all more points than the pictures have pixels
    measured = []
    for c in seen:
        depth = images.depth(t, c)
        assert depth is not None
        measured.append(_camera_points(c, rig[c], depth, images.colour(t, c), most))
    return measured


def fuse(
    measured: Sequence[CameraPoints], rig: Rig, world_from_master: np.ndarray, bias: np.ndarray
) -> FusedCloud:
    """Transform all cameras' points into one frame by the poses of ``rig``.

    Args:
        bias: (C,) metres, subtracted from each camera's depth.
    """
    nothing = np.zeros((0, 3), np.float32)
    parts = [(nothing, nothing, nothing, np.zeros(0, np.int32))]
    for own in measured:
        pose = world_from_master @ rig[own.c].master_from_depth
        points = apply(pose, own.points - np.float32(bias[own.c]) * own.rays)
        normals = own.normals @ pose[:3, :3].T.astype(np.float32)
        parts.append((points, normals, own.colours, np.full(len(points), own.c, np.int32)))
    return FusedCloud(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def splat(cloud: FusedCloud, view: Viewpoint) -> tuple[np.ndarray, np.ndarray]:
    """Render the cloud; return RGB (H, W, 3) and depth (H, W), infinite where it is empty.

    Only surfaces that face the viewer are drawn, so that a room is open towards the viewer. A pixel
    has the mean colour of its points within 15 mm of the nearest one. Drawn pixels also cover empty
    or farther neighbours (:func:`_spread`), so that surfaces have no holes.
    """
    to_viewer = view.eye.astype(np.float32) - cloud.points
    facing = np.flatnonzero(np.einsum("ij,ij->i", to_viewer, cloud.normals) > 0)
    at, z = view.project(cloud.points[facing])
    width, height = view.lens.width, view.lens.height
    column, row = np.rint(at[:, 0]).astype(np.int64), np.rint(at[:, 1]).astype(np.int64)
    inside = (z > 0.1) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    pixel, z = (row * width + column)[inside], z[inside]
    count = width * height
    nearest = np.full(count, np.inf, np.float32)
    np.minimum.at(nearest, pixel, z)
    front = z < nearest[pixel] + 0.015
    pixel, colours = pixel[front], cloud.colours[facing[inside][front]]
    weight = np.maximum(np.bincount(pixel, minlength=count), 1)
    picture = np.empty((count, 3), np.float32)
    for channel in range(3):
        picture[:, channel] = np.bincount(pixel, colours[:, channel], count) / weight
    source, depth = _spread(nearest.reshape(height, width))
    return picture[source], depth


def _spread(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Let every drawn pixel cover neighbours that are empty or farther away, then close holes.

    Returns for each pixel (H, W) the flat index of the pixel that it shows, and the depth.
    """
    source, near = _cover(np.arange(depth.size).reshape(depth.shape), depth, depth)
    drawn = np.isfinite(near).astype(np.uint8)
    around = cv2.boxFilter(drawn, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    hole = (drawn == 0) & (around >= 5)  # most neighbours are drawn
    return _cover(source, near, np.where(hole, np.inf, -np.inf))


def _cover(
    source: np.ndarray, depth: np.ndarray, coverable: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Replace a pixel by its nearest neighbour if that covers it; returns source and depth.

    A neighbour covers a pixel if its depth plus ``_BEHIND_M`` is below ``coverable`` (H, W).
    """
    height, width = depth.shape
    result, near, limit = source.copy(), depth.copy(), coverable.copy()
    padded = np.pad(depth, 1, constant_values=np.inf)
    for down, across in _NEIGHBOURS:
        z = padded[1 + down : 1 + down + height, 1 + across : 1 + across + width]
        row, column = np.nonzero(z + _BEHIND_M < limit)
        result[row, column] = source[row + down, column + across]
        near[row, column] = z[row, column]
        limit[row, column] = z[row, column] + _BEHIND_M
    return result, near


def _camera_points(
    c: int, camera: Camera, depth: np.ndarray, image: np.ndarray | None, most: int
) -> CameraPoints:
    """Points of a depth image in millimetres, thinned to at most ``most``, with their colours.

    Points without a visible pixel in the colour image are left out; without an image, all are grey.
    """
    step = max(1, int(np.ceil(np.sqrt(depth.size / most))))
    thin = _thinned(camera, depth[::step, ::step].shape, step)
    depth = np.ascontiguousarray(depth[::step, ::step])
    assert thin.depth is not None
    rays = thin.depth.rays.astype(np.float32)
    z = depth.astype(np.float32) * np.float32(1e-3)
    rays = np.dstack([rays, np.ones_like(z)])
    normals, kept = _normals(rays * z[..., None])
    # depth at a grazing angle is noise: the cosine of normal and ray must exceed 0.12 (83 degrees)
    kept &= -np.einsum("ijk,ijk->ij", normals, rays) > 0.12 * np.linalg.norm(rays, axis=2)
    if image is None:
        index = np.flatnonzero(kept)
        colours = np.tile(np.array([0.55, 0.55, 0.58], np.float32), (len(index), 1))
    else:
        lookup = colour_lookup(depth, thin)
        shown = lookup.shown & kept.ravel()[lookup.depth_index]
        index = lookup.depth_index[shown]
        bgr = image.reshape(-1, 3)[lookup.colour_index[shown]]
        colours = bgr[:, ::-1] / np.float32(255)
    rays, normals = rays.reshape(-1, 3)[index], normals.reshape(-1, 3)[index]
    return CameraPoints(c, rays * z.ravel()[index, None], normals, rays, colours)


def _thinned(camera: Camera, shape: tuple[int, ...], step: int) -> Camera:
    """Return the camera whose depth image has every ``step``-th row and column."""
    lens = camera.depth
    assert lens is not None
    thin = replace(
        lens, width=shape[1], height=shape[0], fx=lens.fx / step, fy=lens.fy / step,
        cx=lens.cx / step, cy=lens.cy / step,
    )  # fmt: skip
    return replace(camera, depth=thin)


def _normals(grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals (H, W, 3) of a grid of points, towards the camera, and their mask."""
    across, down = np.zeros_like(grid), np.zeros_like(grid)
    across[:, 1:-1] = grid[:, 2:] - grid[:, :-2]
    down[1:-1] = grid[2:] - grid[:-2]
    normals = np.cross(down, across)  # x right, y down: towards the camera
    length = np.linalg.norm(normals, axis=2)
    z = grid[..., 2]
    smooth = (z > 0) & np.isfinite(length) & (length > 0)
    edge = 0.06 * z  # a larger change of depth over two grid steps is an edge
    smooth &= (np.abs(across[..., 2]) < edge) & (np.abs(down[..., 2]) < edge)
    for axis in (0, 1):
        smooth &= (np.roll(z, 1, axis) > 0) & (np.roll(z, -1, axis) > 0)
    smooth[[0, -1]] = smooth[:, [0, -1]] = False
    return normals / np.maximum(length, 1e-12)[..., None], smooth
