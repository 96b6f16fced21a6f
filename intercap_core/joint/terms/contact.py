"""Contact: Q_t E_C of equation 6 (A.4), weighed by lambda_Q (setting ``contact_weight``).

The residuals, and what differs from the paper, are in
:mod:`intercap_core.joint.terms.contact_residual`. The
paper's binary Q_t is the probability that each region touches, annotated or detected; what somebody
saw touching draws more while it stands apart. The setting ``contact_to`` says what skin is drawn
to: any point of the object, or its annotated part.
"""

from __future__ import annotations

import numpy as np

from intercap_core.joint.constants import ANNOTATED_CONTACT_WEIGHT, CONTACT_SIGMA
from intercap_core.joint.energy_constants import CONTACT_TOLERANCE
from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.state import State
from intercap_core.joint.terms import contact_residual as contact
from intercap_core.joint.terms.coupled import add_distances
from intercap_core.joint.terms.term import Term


class Contact(Term):
    """Q_t E_C; Q (T, R), the probability that each region touches, is set between rounds."""

    name = "contact"

    def __init__(self, geometry: Geometry, weight: float) -> None:
        self._geometry, self._scale = geometry, weight / CONTACT_SIGMA**2
        self._probability: np.ndarray | None = None
        self._annotated: np.ndarray | None = None
        self._draws: np.ndarray | None = None
        self._shares: contact.Shares | None = None

    def take_contact(self, probability: np.ndarray, annotated: np.ndarray) -> None:
        """Use this probability (T, R) that each region touches from now on; ``annotated`` (T, R) is
        1 where somebody states that it does."""
        self._probability, self._annotated = probability, annotated == 1

    def holding(self) -> np.ndarray:
        """How surely each of the patches' vertices holds the object (T, M), times its share of its
        patch's area, as of the last :meth:`refresh`."""
        assert self._shares is not None, "refresh comes first"
        assert self._probability is not None, "take_contact comes first"
        patches = self._geometry.patches
        gate = self._probability[:, patches.region_of_patch] * self._shares.gate
        return self._shares.area * gate[:, patches.patch]

    def refresh(self, state: State) -> None:
        """Take anew which vertices carry the contact, and how much each region draws."""
        assert self._probability is not None, "take_contact comes first"
        assert self._annotated is not None, "take_contact comes first"
        patches = self._geometry.patches
        distance = self._geometry.at(state).touching.distance[:, self._geometry.skin.patch]
        self._shares = contact.shares(distance, patches.patch, patches.region_of_patch)
        more = np.zeros_like(self._probability)
        for region in np.flatnonzero(self._annotated.any(0)).tolist():
            nearest = np.abs(distance[:, patches.region == region]).min(1)
            apart = np.clip((nearest - CONTACT_TOLERANCE) / CONTACT_SIGMA, 0.0, 1.0)
            more[:, region] = self._annotated[:, region] * apart
        self._draws = (1.0 + (ANNOTATED_CONTACT_WEIGHT - 1.0) * more) * self._probability

    def add(self, state: State, equations: NormalEquations) -> None:
        """Add Q_t E_C at ``state`` with the vertices' shares of the last :meth:`refresh`."""
        assert self._shares is not None, "refresh comes first"
        assert self._draws is not None, "refresh comes first"
        patches, at_patch = self._geometry.patches, self._geometry.skin.patch
        posed = self._geometry.at(state)
        near = posed.touching
        distance = near.distance
        touch, weight, energy = contact.term(
            distance[:, at_patch],
            patches.patch,
            self._shares,
            self._draws[:, patches.region_of_patch],
        )
        residual, weights = np.zeros_like(distance), np.zeros_like(distance)
        residual[:, at_patch], weights[:, at_patch] = touch, weight * self._scale
        add_distances(self.name, posed, near, residual, weights, energy * self._scale, equations)
