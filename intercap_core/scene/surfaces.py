"""Depth images as thinned surfaces: points with normals, and for the foreground their speed.

Moving surfaces (the person and the object) are in the middle of the ring of cameras. They are seen
from all sides, so they connect cameras that share no background. They also determine *when* each
camera exposed: a surface seen by two cameras is displaced by its speed along the normal times the
difference of their exposure times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numba
import numpy as np

from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.solve.time_series import sample_evenly
from intercap_core.scene.background import Background

# Largest depth of moving surfaces: farther, the depth error exceeds the motion between two sets.
MOVING_MAX_DEPTH_M = 4.0
BACKGROUND_CELL_M = 0.03  # side of the cells of thinned backgrounds; tuned on the studio


@dataclass(frozen=True, eq=False)
class DepthSurface:
    """Oriented points in one camera's depth frame, float64."""

    points: np.ndarray
    """(N, 3) metres."""
    normals: np.ndarray
    """(N, 3) unit, towards the camera."""
    rays: np.ndarray
    """(N, 3) displacement of a point per metre of depth."""
    speed: np.ndarray
    """(N,) m/s along the normal; 0 for static surfaces."""

    def __len__(self) -> int:
        return len(self.points)

    @classmethod
    def joined(cls, parts: Sequence[DepthSurface]) -> DepthSurface:
        """Concatenate one or more surfaces."""
        names = ("points", "normals", "rays", "speed")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def subset(self, rows: np.ndarray) -> DepthSurface:
        """The points of some rows."""
        parts = (self.points, self.normals, self.rays, self.speed)
        return DepthSurface(*(part.take(rows, 0) for part in parts))


class NearestPoints:
    """Exact nearest neighbours within a radius, among points of one or several layers.

    The points lie in cubic cells as wide as the radius, so a search visits at most 27 cells. For
    depth surfaces this is three times as fast as a k-d tree.
    """

    def __init__(self, points: np.ndarray, layer: np.ndarray | int, radius_m: float) -> None:
        """
        Args:
            points: (N, 3) metres, at least one.
            layer: (N,) from 0, or one number for all points. Points of different layers are never
                neighbours.
            radius_m: largest distance of a neighbour, metres.
        """
        self._low, self._radius_m = points.min(0), radius_m
        scaled = (points - self._low) / radius_m
        cell = scaled.astype(np.int64)
        layer = np.zeros(len(points), np.int64) + layer
        layers, x, y, z = (int(n) + 1 for n in (layer.max(), *cell.max(0)))
        self._shape = (layers, x, y, z)
        flat = np.ravel_multi_index((layer, *cell.T), self._shape)
        self._order = np.argsort(flat, kind="stable")
        self._scaled = scaled[self._order]
        counts = np.bincount(flat, minlength=int(np.prod(self._shape)))
        self._starts = np.append(0, np.cumsum(counts))

    def query(self, sought: np.ndarray, layer: np.ndarray | int) -> np.ndarray:
        """Index (M,) of the point nearest to each of ``sought`` (M, 3), metres; -1 = none.

        ``layer``: (M,) layer of each, or one number for all; a layer may have no points.
        """
        scaled = (sought - self._low) / self._radius_m
        layer = np.zeros(len(sought), np.int64) + layer
        place = _nearest(self._scaled, self._starts, self._shape, scaled, layer)
        return np.where(place < 0, -1, self._order[place])


@numba.njit(cache=True)
def _nearest(
    points: np.ndarray,
    starts: np.ndarray,
    shape: tuple[int, int, int, int],
    sought: np.ndarray,
    layer: np.ndarray,
) -> np.ndarray:
    """Kernel of :class:`NearestPoints`; the radius and the cells' width are 1.

    Args:
        points: (N, 3) ordered by cell: layer, x, y, z.
        starts: first point of each cell, and N.
        shape: number of layers, and of cells along x, y and z.
        sought: (M, 3).
        layer: (M,).
    """
    result = np.full(len(sought), -1)
    for i in range(len(sought)):
        x, y, z = sought[i, 0], sought[i, 1], sought[i, 2]
        own_x, own_y, own_z = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
        first, end = max(own_z - 1, 0), min(own_z + 2, shape[3])
        if first >= end or not 0 <= layer[i] < shape[0]:
            continue
        best = 1.0
        for u in (own_x, own_x - 1, own_x + 1):
            for v in (own_y, own_y - 1, own_y + 1):
                if not (0 <= u < shape[1] and 0 <= v < shape[2]):
                    continue
                gap_x, gap_y = max(u - x, x - u - 1, 0.0), max(v - y, y - v - 1, 0.0)
                if gap_x * gap_x + gap_y * gap_y >= best:
                    continue
                row = ((layer[i] * shape[1] + u) * shape[2] + v) * shape[3]
                for k in range(starts[row + first], starts[row + end]):
                    dx, dy, dz = points[k, 0] - x, points[k, 1] - y, points[k, 2] - z
                    square = dx * dx + dy * dy + dz * dz
                    if square < best:
                        best, result[i] = square, k
    return result


def surface_from_depth(
    depth: np.ndarray, lens: Intrinsics, *, cell_m: float, max_depth_m: float
) -> DepthSurface:
    """Thin a depth image (H, W), uint16 mm, to one mean point and normal per cell.

    Normals are cross products of central differences. Points at edges, on surfaces seen at more
    than 75 degrees from their normal, and beyond ``max_depth_m`` are left out. Speeds are 0.

    ``cell_m``: side of a cubic cell, metres.
    """
    # Distance of the neighbours on either side: 4 px of the unbinned narrow mode (f = 504 px).
    # With closer ones noise dominates, with farther ones edges; tuned on the studio.
    step = max(1, round(0.008 * lens.fx))
    points, normals, rays = _oriented_points(depth, lens.rays, step, max_depth_m * 1000)
    return thin_surface(DepthSurface(points, normals, rays, np.zeros(len(points))), cell_m)


@numba.njit(cache=True)
def _oriented_points(
    depth: np.ndarray, rays: np.ndarray, step: int, max_mm: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Kernel of :func:`surface_from_depth`: points, normals and rays (N, 3) before thinning.

    Args:
        depth: (H, W) uint16 mm.
        rays: (H, W, 2) float32 of the lens; NaN = outside its calibration.
        step: distance of the neighbours that determine a normal, px.
        max_mm: largest depth.
    """
    height, width = depth.shape
    points, normals, along = np.empty((3, depth.size, 3))
    count = 0
    for v in range(step, height - step):
        for u in range(step, width - step):
            usable = 0 < depth[v, u] <= max_mm
            for side in ((v, u - step), (v, u + step), (v - step, u), (v + step, u)):
                usable = usable and 0 < depth[side] <= max_mm
            if not usable:
                continue
            px, py, pz = _point_of(depth, rays, v, u)
            left, right = _point_of(depth, rays, v, u - step), _point_of(depth, rays, v, u + step)
            up, down = _point_of(depth, rays, v - step, u), _point_of(depth, rays, v + step, u)
            kink = max(
                abs((left[2] + right[2]) / np.float32(2) - pz),
                abs((up[2] + down[2]) / np.float32(2) - pz),
            )
            if kink > np.float32(0.008) * pz:  # share of depth; tuned on the studio
                continue
            ax, ay, az = down[0] - up[0], down[1] - up[1], down[2] - up[2]
            bx, by, bz = right[0] - left[0], right[1] - left[1], right[2] - left[2]
            normal = normals[count]
            normal[:] = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            normal /= max(np.sqrt((normal * normal).sum()), 1e-12)
            point = points[count]
            point[:] = px, py, pz
            # 75 degrees: time-of-flight degrades at grazing angles; tuned on the studio
            if -(normal * point).sum() >= 0.26 * np.sqrt((point * point).sum()):  # False for NaN
                along[count] = rays[v, u, 0], rays[v, u, 1], np.float32(1)
                count += 1
    return points[:count], normals[:count], along[:count]


@numba.njit(cache=True)
def _point_of(
    depth: np.ndarray, rays: np.ndarray, v: int, u: int
) -> tuple[np.float32, np.float32, np.float32]:
    """Point of pixel (v, u), metres; see :func:`_oriented_points`."""
    z = np.float32(depth[v, u]) * np.float32(1e-3)
    return rays[v, u, 0] * z, rays[v, u, 1] * z, z


def thin_surface(surface: DepthSurface, cell_m: float) -> DepthSurface:
    """One mean point, normal, ray and speed for each cell of ``cell_m``, ordered by cell."""
    if not len(surface):
        return surface
    # one integer key per cell: 20 bits for each coordinate, which is made positive
    cell = np.floor(surface.points / cell_m).astype(np.int64) + (1 << 19)
    key = (cell[:, 0] << 40) + (cell[:, 1] << 20) + cell[:, 2]
    _, inverse, counts = np.unique(key, return_inverse=True, return_counts=True)

    def mean(values: np.ndarray) -> np.ndarray:
        sums = [np.bincount(inverse, values[:, i], len(counts)) for i in range(3)]
        return np.stack(sums, 1) / counts[:, None]

    normals = mean(surface.normals)
    length = np.linalg.norm(normals, axis=1)
    whole = length > 0.8  # a cell across an edge has no single normal
    normals = normals[whole] / length[whole, None]
    speed = np.bincount(inverse, surface.speed, len(counts)) / counts
    return DepthSurface(
        mean(surface.points)[whole], normals, mean(surface.rays)[whole], speed[whole]
    )


def background_surfaces(
    rig: Rig, backgrounds: Sequence[Background | None]
) -> dict[int, DepthSurface]:
    """Static surface of each camera, in its depth camera's frame, by camera index."""
    surfaces = {}
    for c, background in enumerate(backgrounds):
        lens = rig[c].depth
        if background is not None and lens is not None:
            surfaces[c] = surface_from_depth(
                np.where(background.static, background.depth, 0),
                lens,
                cell_m=BACKGROUND_CELL_M,
                max_depth_m=5.0,  # farther, the depth error exceeds a centimetre
            )
    return surfaces


def moving_surfaces(
    frames: Frames, rig: Rig, image_of: np.ndarray, backgrounds: list[Background | None]
) -> list[dict[int, DepthSurface]]:
    """Return the moving surfaces of up to 16 moments, by camera index.

    Points are in the depth camera's frame. A camera is used at a moment only if it also has depth
    at the moments before and after, which are needed for the speed. A moment needs two cameras.

    Args:
        frames: read by image, not by moment.
        rig: gives the lenses of the depth cameras.
        image_of: (T, C) set whose image of camera c shows moment t; -1 = none.
        backgrounds: of the C cameras; None = no depth.
    """
    has_depth = frames.depth_available[np.maximum(image_of, 0), np.arange(image_of.shape[1])]
    depth_image = np.where((image_of >= 0) & has_depth, image_of, -1)
    whole = np.zeros(depth_image.shape, bool)  # (T, C) with the sets before and after
    whole[1:-1] = (depth_image[:-2] >= 0) & (depth_image[1:-1] >= 0) & (depth_image[2:] >= 0)
    limits = [None if b is None else _nearest_background(b) for b in backgrounds]
    result = []
    for t in sample_evenly(whole.sum(1) >= 2, 16):
        at_once = {}
        for c in np.flatnonzero(whole[t]):
            limit, lens = limits[c], rig[int(c)].depth
            if limit is None or lens is None:
                continue
            images = [frames.depth(int(depth_image[k, c]), int(c)) for k in (t - 1, t, t + 1)]
            gaps = frames.time_s[[t, t + 1]] - frames.time_s[[t - 1, t]]
            surface = _moving(images, limit, lens, gaps)
            if len(surface):
                at_once[int(c)] = surface
        if len(at_once) >= 2:
            result.append(at_once)
    return result


def _moving(
    images: list[np.ndarray | None], limit: np.ndarray, lens: Intrinsics, gaps: np.ndarray
) -> DepthSurface:
    """Foreground surface of the second of three depth images, with its mean speed.

    Args:
        images: (H, W) uint16 mm.
        limit: (H, W) uint16 mm, see :func:`_nearest_background`.
        gaps: (2,) seconds between the images.
    """
    before, now, after = (
        np.where(image < limit, image, np.uint16(0)) for image in images if image is not None
    )
    # cells of 2 cm, finer than those of the background
    surface = surface_from_depth(now, lens, cell_m=0.02, max_depth_m=MOVING_MAX_DEPTH_M)
    if not len(surface):
        return surface
    earlier = _along_normals(surface, _points(before, lens))
    later = _along_normals(surface, _points(after, lens))
    speed = (later - earlier) / gaps.sum()
    return replace(surface, speed=speed).subset(np.flatnonzero(np.isfinite(speed)))


def _nearest_background(background: Background) -> np.ndarray:
    """Depth (H, W), uint16 mm, from which on a measurement may be the background."""
    behind = background.depth
    # above the systematic error of 11 mm + 0.1 % of depth (Azure Kinect DK data sheet) and noise;
    # margins tuned on the studio
    limit = np.ceil(behind * (1 - 0.012) - 40.0)
    return np.where(behind == 0, 65535, np.maximum(limit, 0)).astype(np.uint16)


def _points(image: np.ndarray, lens: Intrinsics) -> np.ndarray:
    """Points (N, 3), metres, of the valid pixels of a depth image (H, W), uint16 mm."""
    thin = np.s_[::2, ::2]  # every second pixel is enough
    image = image[thin]
    keep = (image > 0) & (image < 1000 * (MOVING_MAX_DEPTH_M + 0.3))  # margin for motion, metres
    z = image[keep] * 1e-3
    points = np.column_stack([lens.rays[thin][keep] * z[:, None], z])
    return points[np.isfinite(points).all(1)]


def _along_normals(surface: DepthSurface, points: np.ndarray) -> np.ndarray:
    """Displacement (N,) of the surface along each point's normal, metres; NaN = not found.

    The nearest of the other ``points`` does not lie on the normal. The displacement is its distance
    along the normal, and the search is repeated twice from the displaced point.
    """
    reach = 0.15  # metres from one set to the next: 2 m/s at 15 sets per second
    away, lost = np.zeros(len(surface)), np.zeros(len(surface), bool)
    if not len(points):
        return np.full(len(surface), np.nan)
    others = NearestPoints(points, 0, reach)
    for _ in range(3):
        nearest = others.query(surface.points + away[:, None] * surface.normals, 0)
        lost |= nearest < 0
        offset = points[np.where(lost, 0, nearest)] - surface.points
        away = np.where(lost, 0.0, (offset * surface.normals).sum(1))
        lost |= np.abs(away) > reach
    return np.where(lost, np.nan, away)


# Largest share of a pair's weight that one direction keeps. Tuned on the studio: the cameras of
# config/field/floor.yaml are 4.1 mm off, without this limit 4.4 mm.
MAX_DIRECTION_SHARE = 0.8
MAX_DIRECTION_GAIN = 3.0  # largest factor on the weights of other directions; tuned on the studio


def balance_directions(weight: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Rescale weights (N,) of points with unit normals (N, 3) so that no direction dominates.

    Points whose normals are within 20 degrees of the dominant direction keep together at most
    ``MAX_DIRECTION_SHARE`` of the total weight. The other weights are multiplied so that the total
    is unchanged, but at most by ``MAX_DIRECTION_GAIN``: a few stray points at the edge of a bare
    floor must not count as a wall.
    """
    total = weight.sum()
    inside = np.ones(len(weight), bool)
    for _ in range(3):  # until the mean of the dominant direction is stable
        mean = weight[inside] @ normals[inside]
        inside = normals @ mean >= 0.94 * np.linalg.norm(mean)  # 20 degrees
    share = weight[inside].sum() / max(total, 1e-9)
    if share <= MAX_DIRECTION_SHARE or share >= 1:
        return weight
    gain = min(MAX_DIRECTION_GAIN, (1 - MAX_DIRECTION_SHARE) / (1 - share))
    return weight * np.where(inside, (1 - (1 - share) * gain) / share, gain)
