"""Depth images to thinned surfaces: points with normals, one for each cell of a grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Rig
from intercap_core.scene.background import Background
from intercap_core.scene.constants import (
    BACKGROUND_CELL_M,
    BACKGROUND_MAX_DEPTH_M,
    MAX_KINK_M_PER_M,
    MIN_VIEW_COSINE,
    NORMAL_STEP_RAD,
)


@dataclass(frozen=True, eq=False)
class Surface:
    """``points`` (N, 3) metres, ``normals`` (N, 3) unit, towards the camera, ``rays`` (N, 3) what a
    point moves by for one metre of depth: all in one camera's depth frame, float64. ``speed``
    (N,) m/s along the normal, 0 of what stands still."""

    points: np.ndarray
    normals: np.ndarray
    rays: np.ndarray
    speed: np.ndarray

    def __len__(self) -> int:
        return len(self.points)

    @classmethod
    def joined(cls, parts: Sequence[Surface]) -> Surface:
        """All parts (one or more), end to end."""
        names = ("points", "normals", "rays", "speed")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def subset(self, rows: np.ndarray) -> Surface:
        """The rows chosen."""
        return Surface(self.points[rows], self.normals[rows], self.rays[rows], self.speed[rows])


def surface_of(
    depth: np.ndarray,
    lens: Intrinsics,
    *,
    keep: np.ndarray | None = None,
    window: tuple[slice, slice] = (slice(None), slice(None)),
    cell_m: float,
    max_depth_m: float,
) -> Surface:
    """Thin a depth image (H, W) uint16 mm to one mean point and normal a cell of ``cell_m``.

    ``keep`` (H, W) bool says which pixels take part, ``window`` (rows, columns) which part of the
    image is looked at. Edges, grazing views and what is farther than ``max_depth_m`` are left out.
    """
    depth, table = depth[window], lens.rays[window]
    usable = (depth > 0) & (depth <= max_depth_m * 1000)
    if keep is not None:
        usable &= keep[window]
    z = depth.astype(np.float32) * np.float32(1e-3)
    grid = np.dstack([table * z[..., None], z])
    step = max(1, round(NORMAL_STEP_RAD * lens.fx))
    middle = np.s_[step:-step, step:-step]
    left, right = np.s_[step:-step, : -2 * step], np.s_[step:-step, 2 * step :]
    up, down = np.s_[: -2 * step, step:-step], np.s_[2 * step :, step:-step]
    flat = usable[middle].copy()
    for one, other in ((left, right), (up, down)):
        flat &= usable[one] & usable[other]
        kink = np.abs((z[one] + z[other]) / 2 - z[middle])
        flat &= kink <= MAX_KINK_M_PER_M * z[middle]
    row, column = np.nonzero(flat)
    row, column = row + step, column + step
    points = grid[row, column].astype(np.float64)
    across = grid[row, column + step] - grid[row, column - step]
    along = grid[row + step, column] - grid[row - step, column]
    normals = np.cross(along, across).astype(np.float64)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    facing = -(normals * points).sum(1) / np.maximum(np.linalg.norm(points, axis=1), 1e-12)
    good = np.isfinite(points).all(1) & (facing >= MIN_VIEW_COSINE)
    along_z = np.column_stack([table[row, column], np.ones(len(row))])
    still = np.zeros(np.count_nonzero(good))
    return thinned(Surface(points[good], normals[good], along_z[good], still), cell_m)


def thinned(surface: Surface, cell_m: float) -> Surface:
    """One mean point, normal and ray for each cell of ``cell_m``, in a fixed order."""
    if not len(surface):
        return surface
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
    return Surface(mean(surface.points)[whole], normals, mean(surface.rays)[whole], speed[whole])


def background_surfaces(rig: Rig, backgrounds: Sequence[Background | None]) -> dict[int, Surface]:
    """The static surface that each camera sees, in its depth camera's frame, by camera index."""
    surfaces = {}
    for c, background in enumerate(backgrounds):
        lens = rig[c].depth
        if background is not None and lens is not None:
            surfaces[c] = surface_of(
                background.depth,
                lens,
                keep=background.static,
                cell_m=BACKGROUND_CELL_M,
                max_depth_m=BACKGROUND_MAX_DEPTH_M,
            )
    return surfaces
