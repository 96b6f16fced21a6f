"""In place of E_O where there is no object: a person alone, or a track that is not believed.

Nothing is known of the object's unknowns and nothing moves them; their poses are NaN throughout.
"""

from __future__ import annotations

import numpy as np

from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.state import OBJECT, State
from intercap_core.joint.terms.term import Term


class NoObject(Term):
    """Keeps the equations definite over unknowns that no term knows; no energy."""

    name = "no_object"

    def take_offsets(self, time_offset: np.ndarray) -> None:
        """Nothing was exposed."""

    def add(self, state: State, equations: NormalEquations) -> None:
        """Add ones to the diagonal: the step of these unknowns is 0."""
        equations.hold(OBJECT)
