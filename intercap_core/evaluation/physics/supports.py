"""Surfaces of the static scene that can carry an object: the floor and level furniture.

All coordinates are those of a frame with z up; with a known floor, the floor is z = 0. Furniture is
known by the background depth of stage ``scene``. A support is a horizontal level: background points
under the object that agree in height.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import Delaunay, QhullError

# Largest distance, metres, between an object and the surface that it rests on, beyond the deviation
# of its pose: depth error of 11 mm + 0.1 % of depth (Azure Kinect DK data sheet) of the surface and
# of the object.
REACH_M = 0.03
# Points of one level agree within this height, metres: three deviations of a background pixel's
# random error (`intercap_core/scene/background.py`).
LEVEL_M = 0.015
LEVEL_POINTS = 30  # fewer points state no level; a cup's footprint has 60 at 3 m
FOOTPRINT_MARGIN_M = 0.03  # ring around the footprint that is searched too


@dataclass(frozen=True)
class Support:
    """The surface that carries an object at rest."""

    name: str
    """"floor" or "furniture"; "" = not known."""
    height: float
    """z of the surface, metres; NaN = not known."""
    reason: str = ""
    """Why no support is known; "" = it is known."""

    @property
    def known(self) -> bool:
        """Whether the scene holds the support."""
        return not self.reason


def _unknown(reason: str) -> Support:
    return Support("", float("nan"), reason)


@dataclass(frozen=True, eq=False)
class StaticScene:
    """Static surfaces around the object."""

    floor: bool
    """Whether z = 0 is the floor."""
    measured: bool
    """Whether the background depth of a camera is known."""
    points: np.ndarray
    """(N, 3) background points of all cameras, metres; perhaps those near the object only."""

    def support_under(self, shape: np.ndarray, centre: np.ndarray, deviation: float) -> Support:
        """The surface on which an object rests.

        Args:
            shape: (V, 3) vertices of the posed object.
            centre: (3,) its centre of mass.
            deviation: stated standard deviation of its position along one axis, metres.
        """
        reach = REACH_M + 2 * deviation
        bottom = float(shape[:, 2].min())
        if self.floor and bottom <= reach:
            return Support("floor", 0.0)
        low = shape[shape[:, 2] < bottom + REACH_M, :2]
        corners = low.min(axis=0) - FOOTPRINT_MARGIN_M, low.max(axis=0) + FOOTPRINT_MARGIN_M
        inside = ((self.points[:, :2] >= corners[0]) & (self.points[:, :2] <= corners[1])).all(1)
        near = self.points[inside & (np.abs(self.points[:, 2] - bottom) <= reach)]
        if len(near) < LEVEL_POINTS:
            return _unknown("the scene holds no surface under it")
        level = _densest(near[:, 2])
        on_level = np.abs(near[:, 2] - level) <= LEVEL_M / 2
        if on_level.mean() < 0.5:
            return _unknown("the surface under it is not level")
        if not _covers(near[on_level, :2], centre[:2]):
            return _unknown("its centre of mass does not lie above its support")
        return Support("furniture", float(np.median(near[on_level, 2])))

    def near(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Background points (N, 3) in the box with the corners ``low`` and ``high`` (3,)."""
        return self.points[((self.points >= low) & (self.points <= high)).all(axis=1)]


def _densest(heights: np.ndarray) -> float:
    """Middle of the interval of length ``LEVEL_M`` that contains most of the heights (N,)."""
    ordered = np.sort(heights)
    counts = np.searchsorted(ordered, ordered + LEVEL_M, side="right") - np.arange(len(ordered))
    first = int(np.argmax(counts))
    return float(ordered[first : first + counts[first]].mean())


def _covers(points: np.ndarray, place: np.ndarray) -> bool:
    """Whether ``place`` (2,) is inside the convex hull of ``points`` (N, 2)."""
    try:
        return bool(Delaunay(points).find_simplex(place) >= 0)
    except QhullError:  # all points on one line
        return False
