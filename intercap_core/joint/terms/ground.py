"""Ground support E_G and E_G' of equation 6 (A.5, A.6): nothing sinks into the floor.

    E_G = sum over vertices W of the body of || RL(n . (p - W)) ||^2
    E_G' = sum over vertices W' of the object of || RL(n . (p - W')) ||^2

with p a point of the floor, n its upward unit normal and RL the rectifier max(0, x). Both are
weighed by lambda_G (setting ``ground_weight``).
"""

from __future__ import annotations

import numpy as np

from intercap_core.joint.equations import BandedEquations
from intercap_core.joint.proximity import along_by_object
from intercap_core.joint.skin import SURFACE_SIGMA, VERTICES_PER_MEASUREMENT
from intercap_core.joint.state import BODY, OBJECT, State
from intercap_core.joint.terms.term import Data, Equation, JointTerm, TermContext


class _Ground(JointTerm):
    """A term that needs a floor."""

    name = "ground"

    def __init__(self, context: TermContext) -> None:
        super().__init__(context)
        assert context.floor is not None, "the term needs a floor"
        self._floor, self._weight = context.floor, context.settings.ground_weight


class BodyGround(_Ground):
    """E_G: the body does not sink into the floor."""

    equation = Equation(
        symbol="E_G",
        source="6, A.5",
        formula="\\|\\|RL(n . (p - W))\\|\\|^2 over the body's vertices W",
        settings=("ground_weight",),
    )
    needs = frozenset({Data.FLOOR})

    def add(self, state: State, equations: BandedEquations) -> None:
        posed = self.geometry.at(state)
        height = self._floor.depths(posed.skin)
        scale = self._weight / SURFACE_SIGMA**2 / VERTICES_PER_MEASUREMENT
        weight = np.where(height < 0, self.geometry.skin.share, 0.0) * scale

        def rows(frames: slice, index: np.ndarray) -> np.ndarray:
            shape = (*height[frames, index].shape, 1, 3)
            return posed.skin_by_body(frames, index, np.broadcast_to(self._floor.normal, shape))

        equations.add_rows(self.name, BODY, rows, weight, height[..., None])


class ObjectGround(_Ground):
    """E_G': the object does not sink into the floor.

    An object stands on few vertices: together they count as one measurement.
    """

    equation = Equation(
        symbol="E_G'",
        source="6, A.6",
        formula="\\|\\|RL(n . (p - W'))\\|\\|^2 over the object's vertices W'",
        settings=("ground_weight",),
    )
    needs = frozenset({Data.OBJECT, Data.FLOOR})

    def __init__(self, context: TermContext) -> None:
        super().__init__(context)
        self._standing: np.ndarray | None = None  # (T, 1) number of vertices below the floor

    def refresh(self, state: State) -> None:
        """Count the vertices on which the object stands."""
        below = self._height(state) < 0
        self._standing = np.maximum(below.sum(axis=1, keepdims=True), 1)

    def add(self, state: State, equations: BandedEquations) -> None:
        """Add E_G' at ``state`` with the number of vertices of the last :meth:`refresh`."""
        assert self._standing is not None, "refresh comes first"
        height = self._height(state)
        weight = (height < 0) / self._standing
        weight = weight * self._weight / SURFACE_SIGMA**2
        vertices = self.geometry.at(state).object_vertices

        def rows(frames: slice, index: np.ndarray) -> np.ndarray:
            points, origin = vertices[frames, index], state.translation[frames]
            up = np.broadcast_to(self._floor.normal, points.shape)
            return along_by_object(points, up, origin)[:, :, None]

        equations.add_rows(self.name, OBJECT, rows, weight, height[..., None])

    def _height(self, state: State) -> np.ndarray:
        return self._floor.depths(self.geometry.at(state).object_vertices)
