"""Plant (beyond the paper): a foot that stands stays where it stands, on the floor.

    E = sum over steps t, vertices i of P a_i rho(|x_i(t+1) - x_i(t)|^2) / 2 sigma^2

with P the probability that this part of the sole stands over the step (:mod:`.contact.standing`)
and a_i the vertex's share of it. Robust, as a foot may slide. Weighed by ``plant_weight``.
"""

from __future__ import annotations

import numpy as np

from intercap_core.joint.constants import PLANT_OUTLIER, PLANT_WALK, SOLE_VERTICES
from intercap_core.joint.contact.standing import sole_parts, standing_probability
from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.state import BODY, State
from intercap_core.joint.terms.coupled import add_steps
from intercap_core.joint.terms.ground import Ground
from intercap_core.joint.terms.term import Term


class Plant(Term):
    """Motion of what stands; ``floor`` None where none was seen: then stillness alone tells."""

    name = "plant"

    def __init__(self, geometry: Geometry, floor: Ground | None, fps: float, weight: float) -> None:
        self._geometry, self._floor, self._fps = geometry, floor, fps
        self._scale = weight * fps / PLANT_WALK**2
        parts = sole_parts(geometry.patches, SOLE_VERTICES)
        self._parts = [geometry.skin.patch[part] for part in parts]
        self._index = np.concatenate([np.zeros(0, int), *self._parts])
        self._weight = np.zeros((0, len(self._index)))

    def refresh(self, state: State) -> None:
        """Take anew which parts of the soles stand over each step."""
        skin = self._geometry.at(state).skin
        self._weight = np.zeros((max(len(state) - 1, 0), 0))
        for part in self._parts:
            height = None
            if self._floor is not None:
                height = (skin[:, part] - self._floor.point) @ self._floor.normal
            stands = standing_probability(skin[:, part], height, self._fps)
            share = np.repeat(stands[:, None] * self._scale / len(part), len(part), axis=1)
            self._weight = np.concatenate([self._weight, share], axis=1)

    def add(self, state: State, equations: NormalEquations) -> None:
        """Add the motion of soles at ``state``."""
        frames, count = len(state), len(self._index)
        if frames < 2 or not count:
            return
        posed = self._geometry.at(state)
        points = posed.skin[:, self._index]

        def rows(at: slice, index: np.ndarray) -> np.ndarray:
            axes = np.broadcast_to(np.eye(3), (*points[at, index].shape, 3))
            return posed.skin_by_body(at, self._index[index], axes)

        outlier = PLANT_OUTLIER / self._fps
        add_steps(self.name, BODY, points, rows, self._weight, outlier, equations)
