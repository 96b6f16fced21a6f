"""Distances between a mesh and the measured points that belong to it."""

from __future__ import annotations

import numpy as np

from intercap_core.geometry.rigid.point_grid import PointGrid


class Cloud:
    """Measured points (N, 3), metres, ready for nearest-point queries."""

    def __init__(self, points: np.ndarray) -> None:
        self.points = np.asarray(points, np.float32)
        self._tree = PointGrid(self.points) if len(self.points) else None

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Distance (M,) of mesh points (M, 3) to the closest measured point; NaN without any."""
        if self._tree is None:
            return np.full(len(points), np.nan)
        return self._tree.distance(points)


def vertex_to_cloud(vertices: np.ndarray, cloud: Cloud) -> float:
    """The paper's figure: mean over every vertex (V, 3), occluded ones too, metres."""
    return float(cloud.distance(vertices).mean())


def visible_to_cloud(points: np.ndarray, visible: np.ndarray, cloud: Cloud) -> float:
    """Mean over the area samples (N, 3) that cameras can see (N,) bool; NaN with none."""
    if not visible.any():
        return float("nan")
    return float(cloud.distance(points[visible]).mean())
