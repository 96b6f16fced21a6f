"""Body in object: named in the text of equation 6 ("as done in PROX"), without a symbol there.

Beyond the paper's formulas: its E_P is equation 5, the self-penetration. Weighed by the setting
``penetration_weight``; residuals in :mod:`intercap_core.joint.terms.penetration_residual`.
E_P_self itself is part of the body's data.
"""

from __future__ import annotations

from intercap_core.joint.constants import PENETRATION_SIGMA, VERTICES_PER_MEASUREMENT
from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.state import State
from intercap_core.joint.terms import penetration_residual as penetration
from intercap_core.joint.terms.coupled import add_distances
from intercap_core.joint.terms.term import Term


class Penetration(Term):
    """Depth of the skin's vertices inside the object."""

    name = "penetration"

    def __init__(self, geometry: Geometry, weight: float) -> None:
        self._geometry = geometry
        self._scale = weight / PENETRATION_SIGMA**2 / VERTICES_PER_MEASUREMENT

    def add(self, state: State, equations: NormalEquations) -> None:
        """Add the depths at ``state``."""
        posed = self._geometry.at(state)
        near = posed.proximity
        depth, weight = penetration.weights(near.distance, self._geometry.skin.share)
        add_distances(self.name, posed, near, depth, weight * self._scale, None, equations)
