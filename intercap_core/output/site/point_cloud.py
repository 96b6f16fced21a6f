"""Coloured points of all cameras in one frame set, and pictures of them from any place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.clouds import colour_lookup
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply

_MAX_POINTS = 600_000  # of all cameras together: more than the pictures have pixels
_EDGE = 0.06  # depth may change by this share over two grid steps, or the pixel is at an edge
_GRAZING = 0.12  # cosine between ray and normal below which depth is noise
_UNCOLOURED = (0.55, 0.55, 0.58)  # of a camera that has no image in this set
_SAME_SURFACE_M = 0.015  # points this close behind a pixel's nearest one are averaged with it
_BEHIND_M = 0.03  # a point hides those of neighbouring pixels this much farther away
_CLOSED = 5  # of eight neighbours drawn make an empty pixel a hole in a surface
_NEIGHBOURS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))


@dataclass(frozen=True, eq=False)
class CameraPoints:
    """What one camera ``c`` measured: ``points`` and unit ``normals`` (N, 3) of its depth camera's
    frame, ``rays`` (N, 3) with z = 1, ``colours`` (N, 3) RGB in 0..1."""

    c: int
    points: np.ndarray
    normals: np.ndarray
    rays: np.ndarray
    colours: np.ndarray


@dataclass(frozen=True, eq=False)
class FusedCloud:
    """Points of all cameras in one frame: ``points``, ``normals``, ``colours`` (N, 3) and the
    ``camera`` (N,) that measured each."""

    points: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
    camera: np.ndarray

    def where(self, kept: np.ndarray) -> FusedCloud:
        """The points of a mask (N,)."""
        return FusedCloud(
            self.points[kept], self.normals[kept], self.colours[kept], self.camera[kept]
        )


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole camera: ``view_from_world`` (4, 4), x right, y down, z forward, and its image."""

    view_from_world: np.ndarray
    focal: float
    width: int
    height: int

    @classmethod
    def towards(
        cls,
        target: np.ndarray,
        azimuth: float,
        elevation: float,
        distance: float,
        focal: float,
        size: tuple[int, int],
    ) -> View:
        """Look at ``target`` (3,), z up, from ``distance`` metres; angles in radians."""
        away = np.array(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
             np.sin(elevation)]
        )  # fmt: skip
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        rotation = np.stack([right, -np.cross(away, right), -away])
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = -rotation @ (target + distance * away)
        return cls(pose, focal, *size)

    @property
    def eye(self) -> np.ndarray:
        """Where it stands (3,)."""
        return -self.view_from_world[:3, :3].T @ self.view_from_world[:3, 3]

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (N, 2) and depths (N,) of points (N, 3); pixel centres at integers."""
        local = apply(self.view_from_world, points)
        z = local[:, 2]
        middle = np.array([(self.width - 1) / 2, (self.height - 1) / 2], points.dtype)
        safe = np.where(z > 1e-6, z, 1)
        return local[:, :2] * (points.dtype.type(self.focal) / safe[:, None]) + middle, z

    def holds(self, points: np.ndarray, border: float) -> bool:
        """Whether all points (N, 3) are in the picture, ``border`` pixels from its edges."""
        at, z = self.project(points)
        high = np.array([self.width, self.height]) - border
        return bool((z > 0).all() and (at > border).all() and (at < high).all())


def measured_points(images: Frames, rig: Rig, t: int) -> list[CameraPoints]:
    """Points of every camera that has a depth image in set ``t``, thinned to a common number.

    ``rig`` gives the lenses. Raises UserError where a recorded JPEG does not decode.
    """
    seen = [c for c, camera in enumerate(rig) if camera.depth and images.depth_available[t, c]]
    found = []
    for c in seen:
        depth = images.depth(t, c)
        assert depth is not None
        points = _of_camera(c, rig[c], depth, images.colour(t, c), _MAX_POINTS // len(seen))
        found.append(points)
    return found


def fuse(
    measured: Sequence[CameraPoints],
    rig: Rig,
    world_from_master: np.ndarray,
    bias: np.ndarray,
) -> FusedCloud:
    """Bring all cameras' points into one frame by the poses of ``rig``.

    ``bias`` (C,) metres is taken off each camera's depth.
    """
    points, normals = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.float32)]
    colours, cameras = [np.zeros((0, 3), np.float32)], [np.zeros(0, np.int32)]
    for own in measured:
        pose = world_from_master @ rig[own.c].master_from_depth
        points.append(apply(pose, own.points - np.float32(bias[own.c]) * own.rays))
        normals.append(own.normals @ pose[:3, :3].T.astype(np.float32))
        colours.append(own.colours)
        cameras.append(np.full(len(own.points), own.c, np.int32))
    return FusedCloud(*(np.concatenate(part) for part in (points, normals, colours, cameras)))


def splat(cloud: FusedCloud, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Picture (H, W, 3) RGB and depth (H, W), infinite where nothing is drawn.

    Only surfaces that face the viewer are drawn, so that a room is open towards it. A pixel is the
    mean of the points at its nearest surface, and covers its neighbours, so that a surface closes.
    """
    to_viewer = view.eye.astype(np.float32) - cloud.points
    facing = np.flatnonzero(np.einsum("ij,ij->i", to_viewer, cloud.normals) > 0)
    at, z = view.project(cloud.points[facing])
    column, row = np.rint(at[:, 0]).astype(np.int64), np.rint(at[:, 1]).astype(np.int64)
    inside = (z > 0.1) & (column >= 0) & (column < view.width) & (row >= 0) & (row < view.height)
    pixel, z = (row * view.width + column)[inside], z[inside]
    count = view.width * view.height
    nearest = np.full(count, np.inf, np.float32)
    np.minimum.at(nearest, pixel, z)
    front = z < nearest[pixel] + _SAME_SURFACE_M
    pixel, colours = pixel[front], cloud.colours[facing[inside][front]]
    weight = np.maximum(np.bincount(pixel, minlength=count), 1)
    picture = np.empty((count, 3), np.float32)
    for channel in range(3):
        picture[:, channel] = np.bincount(pixel, colours[:, channel], count) / weight
    source, depth = _spread(nearest.reshape(view.height, view.width))
    return picture[source], depth


def _spread(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Let every drawn pixel cover its neighbours that are empty or farther away; close holes.

    Returns the flat pixel (H, W) that each one shows, and its depth (H, W).
    """
    source, near = _cover(np.arange(depth.size).reshape(depth.shape), depth, depth)
    drawn = np.isfinite(near).astype(np.uint8)
    around = cv2.boxFilter(drawn, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    hole = (drawn == 0) & (around >= _CLOSED)
    return _cover(source, near, np.where(hole, np.inf, -np.inf))


def _cover(
    source: np.ndarray,
    depth: np.ndarray,
    coverable: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Put the nearest of its eight neighbours where it is in front of ``coverable`` (H, W)."""
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


def _of_camera(
    c: int,
    camera: Camera,
    depth: np.ndarray,
    image: np.ndarray | None,
    most: int,
) -> CameraPoints:
    step = max(1, int(np.ceil(np.sqrt(depth.size / most))))
    thin = _thinned(camera, depth[::step, ::step].shape, step)
    depth = np.ascontiguousarray(depth[::step, ::step])
    assert thin.depth is not None
    rays = thin.depth.rays.astype(np.float32)
    z = depth.astype(np.float32) * np.float32(1e-3)
    rays = np.dstack([rays, np.ones_like(z)])
    normals, kept = _normals(rays * z[..., None])
    kept &= -np.einsum("ijk,ijk->ij", normals, rays) > _GRAZING * np.linalg.norm(rays, axis=2)
    if image is None:
        index = np.flatnonzero(kept)
        colours = np.tile(np.array(_UNCOLOURED, np.float32), (len(index), 1))
    else:
        lookup = colour_lookup(depth, thin, np.flatnonzero(kept))
        shown = (lookup.colour_index >= 0) & ~lookup.hidden
        index = lookup.depth_index[shown]
        bgr = image.reshape(-1, 3)[lookup.colour_index[shown]]
        colours = bgr[:, ::-1] / np.float32(255)
    rays, normals = rays.reshape(-1, 3)[index], normals.reshape(-1, 3)[index]
    return CameraPoints(c, rays * z.ravel()[index, None], normals, rays, colours)


def _thinned(camera: Camera, shape: tuple[int, ...], step: int) -> Camera:
    """The camera whose depth image is every ``step``-th row and column of the real one's."""
    lens = camera.depth
    assert lens is not None
    thin = replace(
        lens, width=shape[1], height=shape[0], fx=lens.fx / step, fy=lens.fy / step,
        cx=lens.cx / step, cy=lens.cy / step,
    )  # fmt: skip
    return replace(camera, depth=thin)


def _normals(grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals (H, W, 3) towards the camera of a grid of points, and where they are known."""
    across, down = np.zeros_like(grid), np.zeros_like(grid)
    across[:, 1:-1] = grid[:, 2:] - grid[:, :-2]
    down[1:-1] = grid[2:] - grid[:-2]
    normals = np.cross(down, across)  # x right, y down: this one points back at the camera
    length = np.linalg.norm(normals, axis=2)
    z = grid[..., 2]
    smooth = (z > 0) & np.isfinite(length) & (length > 0)
    smooth &= (np.abs(across[..., 2]) < _EDGE * z) & (np.abs(down[..., 2]) < _EDGE * z)
    for axis in (0, 1):
        smooth &= (np.roll(z, 1, axis) > 0) & (np.roll(z, -1, axis) > 0)
    smooth[[0, -1]] = smooth[:, [0, -1]] = False
    return normals / np.maximum(length, 1e-12)[..., None], smooth
