"""Ground support E_G and E_G' of equation 6 (A.5, A.6): nothing sinks into the floor.

    E_G = sum over vertices W of the body of || RL(n . (p - W)) ||^2
    E_G' = sum over vertices W' of the object of || RL(n . (p - W')) ||^2

with p a point of the floor, n its upward unit normal and RL the rectifier max(0, x).

Ground support: E_G (body, A.5) and E_G' (object, A.6) of equation 6.

Weighed by lambda_G (setting ``ground_weight``); residuals in
:mod:`intercap_core.joint.terms.ground_residual`.
"""

from __future__ import annotations

import numpy as np

from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.floor import Ground
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.proximity import along_by_object
from intercap_core.joint.skin import VERTICES_PER_MEASUREMENT
from intercap_core.joint.state import BODY, OBJECT, State
from intercap_core.joint.terms.term import Term

# Depth of a vertex below the floor, metres: the ground plane's own error. Tuned on the studio.
GROUND_SIGMA = 0.005
# Vertices of the object on which it stands at least: fewer would each count as a measurement of
# their own when an edge just touches the floor. Tuned on the studio.
MIN_STANDING_VERTICES = 4


def depth_below(points: np.ndarray, floor: Ground) -> np.ndarray:
    """Height (..., N) of points (..., N, 3) over the floor where negative, else 0; metres.

    Its derivative by a point is the normal where the residual is negative and 0 elsewhere.
    """
    return np.minimum(floor.heights(points), 0.0)


class BodyGround(Term):
    """E_G: the body does not sink into the floor."""

    name = "ground"

    def __init__(self, geometry: Geometry, floor: Ground, weight: float) -> None:
        self._geometry, self._floor = geometry, floor
        self._scale = weight / GROUND_SIGMA**2 / VERTICES_PER_MEASUREMENT

    def add(self, state: State, equations: NormalEquations) -> None:
        """Add E_G at ``state``."""
        posed = self._geometry.at(state)
        height = depth_below(posed.skin, self._floor)
        weight = np.where(height < 0, self._geometry.skin.share, 0.0) * self._scale

        def rows(frames: slice, index: np.ndarray) -> np.ndarray:
            shape = (*height[frames, index].shape, 1, 3)
            return posed.skin_by_body(frames, index, np.broadcast_to(self._floor.normal, shape))

        equations.add_rows(self.name, BODY, rows, weight, height[..., None])


class ObjectGround(Term):
    """E_G': the object does not sink into the floor.

    An object stands on few vertices: together they count as one measurement.
    """

    name = "ground"

    def __init__(self, geometry: Geometry, floor: Ground, weight: float) -> None:
        self._geometry, self._floor, self._weight = geometry, floor, weight
        self._standing: np.ndarray | None = None

    def refresh(self, state: State) -> None:
        """Take anew on how many vertices the object stands."""
        below = self._height(state) < 0
        self._standing = np.maximum(below.sum(axis=1, keepdims=True), MIN_STANDING_VERTICES)

    def add(self, state: State, equations: NormalEquations) -> None:
        """Add E_G' at ``state`` with the number of vertices of the last :meth:`refresh`."""
        assert self._standing is not None, "refresh comes first"
        height = self._height(state)
        weight = (height < 0) / self._standing
        weight = weight * self._weight / GROUND_SIGMA**2
        vertices = self._geometry.at(state).object_vertices

        def rows(frames: slice, index: np.ndarray) -> np.ndarray:
            points, origin = vertices[frames, index], state.translation[frames]
            up = np.broadcast_to(self._floor.normal, points.shape)
            return along_by_object(points, up, origin)[:, :, None]

        equations.add_rows(self.name, OBJECT, rows, weight, height[..., None])

    def _height(self, state: State) -> np.ndarray:
        vertices = self._geometry.at(state).object_vertices
        return depth_below(vertices, self._floor)
