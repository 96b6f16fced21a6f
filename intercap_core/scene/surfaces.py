"""Depth images as thinned surfaces: points with normals, and for the foreground their speed.

Moving surfaces (the person and the object) are in the middle of the ring of cameras. They are seen
from all sides, so they connect cameras that share no background. They also determine *when* each
camera exposed: a surface seen by two cameras is displaced by its speed along the normal times the
difference of their exposure times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

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
        return DepthSurface(
            self.points[rows], self.normals[rows], self.rays[rows], self.speed[rows]
        )


def surface_from_depth(
    depth: np.ndarray, lens: Intrinsics, *, cell_m: float, max_depth_m: float
) -> DepthSurface:
    """Thin a depth image (H, W), uint16 mm, to one mean point and normal per cell.

    Normals are cross products of central differences. Points at edges, on surfaces seen at more
    than 75 degrees from their normal, and beyond ``max_depth_m`` are left out. Speeds are 0.

    ``cell_m``: side of a cubic cell, metres.
    """
    rows, columns = np.flatnonzero(depth.any(1)), np.flatnonzero(depth.any(0))
    if not len(rows):
        rows = columns = np.zeros(1, int)
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    depth, table = depth[window], lens.rays[window]
    usable = (depth > 0) & (depth <= max_depth_m * 1000)
    z = depth.astype(np.float32) * np.float32(1e-3)
    grid = np.dstack([table * z[..., None], z])
    # Distance of the neighbours on either side: 4 px of the unbinned narrow mode (f = 504 px).
    # With closer ones noise dominates, with farther ones edges; tuned on the studio.
    step = max(1, round(0.008 * lens.fx))
    middle = np.s_[step:-step, step:-step]
    left, right = np.s_[step:-step, : -2 * step], np.s_[step:-step, 2 * step :]
    up, down = np.s_[: -2 * step, step:-step], np.s_[2 * step :, step:-step]
    flat = usable[middle].copy()
    for one, other in ((left, right), (up, down)):
        flat &= usable[one] & usable[other]
        kink = np.abs((z[one] + z[other]) / 2 - z[middle])
        flat &= kink <= 0.008 * z[middle]  # share of depth; tuned on the studio
    row, column = np.nonzero(flat)
    row, column = row + step, column + step
    points = grid[row, column].astype(np.float64)
    across = grid[row, column + step] - grid[row, column - step]
    along = grid[row + step, column] - grid[row - step, column]
    normals = np.cross(along, across).astype(np.float64)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    facing = -(normals * points).sum(1) / np.maximum(np.linalg.norm(points, axis=1), 1e-12)
    # 75 degrees: time-of-flight degrades at grazing angles; tuned on the studio
    good = np.isfinite(points).all(1) & (facing >= 0.26)
    along_z = np.column_stack([table[row, column], np.ones(len(row))])
    still = np.zeros(np.count_nonzero(good))
    return thin_surface(DepthSurface(points[good], normals[good], along_z[good], still), cell_m)


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
    result = []
    for t in sample_evenly(whole.sum(1) >= 2, 16):
        at_once = {}
        for c in np.flatnonzero(whole[t]):
            background, lens = backgrounds[c], rig[int(c)].depth
            if background is None or lens is None:
                continue
            images = [frames.depth(int(depth_image[k, c]), int(c)) for k in (t - 1, t, t + 1)]
            gaps = frames.time_s[[t, t + 1]] - frames.time_s[[t - 1, t]]
            surface = _moving(images, background, lens, gaps)
            if len(surface):
                at_once[int(c)] = surface
        if len(at_once) >= 2:
            result.append(at_once)
    return result


def _moving(
    images: list[np.ndarray | None], background: Background, lens: Intrinsics, gaps: np.ndarray
) -> DepthSurface:
    """Foreground surface of the second of three depth images, with the mean speed over both
    ``gaps`` (2,), seconds."""
    before, now, after = (_foreground(image, background) for image in images)
    # cells of 2 cm, finer than those of the background
    surface = surface_from_depth(now, lens, cell_m=0.02, max_depth_m=MOVING_MAX_DEPTH_M)
    if not len(surface):
        return surface
    earlier = _along_normals(surface, _points(before, lens))
    later = _along_normals(surface, _points(after, lens))
    speed = (later - earlier) / gaps.sum()
    return replace(surface, speed=speed).subset(np.flatnonzero(np.isfinite(speed)))


def _foreground(image: np.ndarray | None, background: Background) -> np.ndarray:
    """Depth (H, W), uint16 mm, of the pixels in front of the background; 0 for others."""
    assert image is not None
    behind = background.depth
    # above the systematic error of 11 mm + 0.1 % of depth (Azure Kinect DK data sheet) and noise;
    # margins tuned on the studio
    limit = behind * (1 - 0.012) - 40.0
    return np.where((behind == 0) | (image < limit), image, 0).astype(np.uint16)


def _points(image: np.ndarray, lens: Intrinsics) -> np.ndarray:
    """Points (N, 3), metres, of the valid pixels of a depth image (H, W), uint16 mm."""
    thin = np.s_[::2, ::2]  # every second pixel is enough
    z = image[thin].astype(np.float64) * 1e-3
    keep = (z > 0) & (z < MOVING_MAX_DEPTH_M + 0.3)  # margin for motion, metres
    points = np.column_stack([lens.rays[thin][keep] * z[keep, None], z[keep]])
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
    tree = cKDTree(points, balanced_tree=False)
    for _ in range(3):
        sought = surface.points + away[:, None] * surface.normals
        distance, nearest = tree.query(sought, distance_upper_bound=reach)
        lost |= ~np.isfinite(distance)
        offset = points[np.where(lost, 0, nearest)] - surface.points
        away = np.where(lost, 0.0, (offset * surface.normals).sum(1))
        lost |= np.abs(away) > reach
    return np.where(lost, np.nan, away)
