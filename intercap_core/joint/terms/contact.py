"""Contact Q_t E_C of equation 6 (A.4): body areas that touch are drawn to the object.

    E_C = CD( H(W(body)), H'(W'(object)) )

CD is the Chamfer distance between H, the body's likely-contact vertices, and H', their closest
points on the object (:mod:`intercap_core.joint.proximity`). H' is the whole object (the paper's
appendix) or the faces between labelled vertices (its text); see the setting ``contact_to``.

Q_t, binary in the paper, is the probability that a region touches; lambda_Q is the setting
``contact_weight``. Equation 6 also has an E_C without Q_t, which is left out: a body that does not
touch is not drawn to the object. Beyond the paper the hands are cut into patches (a palm, each
finger). The nearest patches and vertices carry the weight, and far patches are outliers
(Geman-McClure): a hand that holds a handle with three fingers does not pull the other two along.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.geometry.solve.robust import geman_mcclure_weight
from intercap_core.joint.equations import BandedEquations
from intercap_core.joint.skin import SURFACE_SIGMA
from intercap_core.joint.state import State
from intercap_core.joint.terms.term import Data, Equation, JointTerm, TermContext

# Weight of an annotated contact relative to a detected one while the region stands apart. Tuned on
# `python -m bench.annotate_driven`: contact of the meshes has an F1 of 0.97 (weight 1: 0.88), and
# with 16 the hand is displaced.
ANNOTATED_CONTACT_WEIGHT = 4.0
CONTACT_OUTLIER = 0.02  # distance at which a patch counts a quarter, metres; tuned on the studio
CONTACT_TOLERANCE = 0.002  # m, costs nothing: half of ``metrics.contact_mm``; tuned on the studio


@dataclass(frozen=True)
class ContactShares:
    """How contact is spread over the body."""

    area: np.ndarray  # (T, M) weights of the patches' vertices; they sum to one in each patch
    gate: np.ndarray  # (T, P) participation of each patch in its region's contact, 0 to 1


def spread_contact(
    distance: np.ndarray, patch_of: np.ndarray, region_of_patch: np.ndarray
) -> ContactShares:
    """Spread contact over the nearest vertices of each patch and the nearest patches of a region.

    The result stays fixed during a round, so that the weights of :func:`evaluate_contact` are the
    exact derivative of its energy.

    Args:
        distance: (T, M) signed distances of the patches' vertices to the object, metres.
        patch_of: (M,) patch of each vertex.
        region_of_patch: (P,) region of each patch.
    """
    area = np.zeros_like(distance)
    nearest = np.empty((len(distance), len(region_of_patch)))
    for patch in range(len(region_of_patch)):
        members = np.flatnonzero(patch_of == patch)
        d = distance[:, members]
        nearest[:, patch] = np.maximum(d.min(axis=1), 0.0)
        near = _closeness(np.maximum(d - nearest[:, [patch]], 0.0))
        area[:, members] = near / near.sum(axis=1, keepdims=True)
    of_region = np.stack(
        [nearest[:, region_of_patch == region].min(axis=1) for region in region_of_patch], axis=1
    )
    return ContactShares(area, _closeness(nearest - of_region))


def evaluate_contact(
    distance: np.ndarray, patch_of: np.ndarray, shares: ContactShares, probability: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals (T, M) in metres, weights (T, M) and energies (T,) in m^2.

    One patch in one frame has the energy q rho(s) / 2. q is probability times gate, and s the mean
    square residual over the patch's area. rho(s) = R^2 s / (R^2 + s) is Geman-McClure's function
    with R = ``CONTACT_OUTLIER``. The weights are q rho'(s) spread over that area.

    Args:
        distance: (T, M) signed distances of the patches' vertices to the object, metres.
        patch_of: (M,) patch of each vertex.
        shares: result of :func:`spread_contact`.
        probability: (T, P) that each patch's region touches.
    """
    residual = np.sign(distance) * np.maximum(np.abs(distance) - CONTACT_TOLERANCE, 0.0)
    square = np.zeros_like(probability)
    contribution = shares.area * np.square(residual)
    for patch in range(probability.shape[1]):
        square[:, patch] = contribution[:, patch_of == patch].sum(axis=1)
    gate = probability * shares.gate
    weight = shares.area * (gate * geman_mcclure_weight(square, CONTACT_OUTLIER))[:, patch_of]
    rho = CONTACT_OUTLIER**2 / (CONTACT_OUTLIER**2 + square)  # divided by the square
    return residual, weight, 0.5 * (gate * square * rho).sum(axis=1)


def _closeness(excess: np.ndarray) -> np.ndarray:
    """Weight of points by their ``excess`` distance over the nearest one, metres.

    A Gaussian of 6 mm (tuned): skin yields and meshes err by millimetres, so that points not much
    farther away than the nearest one touch as well.
    """
    return np.exp(-np.square(excess / 0.006) / 2)


class Contact(JointTerm):
    """Q_t E_C. The probability Q is set between rounds by :meth:`take_contact`."""

    name = "contact"
    equation = Equation(
        symbol="E_C",
        source="6, A.4",
        formula="Q_t CD(H(W), H'(W')): likely-contact vertices H of the body to their closest "
        "points H' on the object, by patches, robust",
        settings=("contact_weight", "contact_to"),
    )
    needs = frozenset({Data.OBJECT})

    def __init__(self, context: TermContext) -> None:
        super().__init__(context)
        self._scale = context.settings.contact_weight / SURFACE_SIGMA**2
        self._probability: np.ndarray | None = None  # (T, R)
        self._annotated: np.ndarray | None = None  # (T, R)
        self._draws: np.ndarray | None = None  # (T, R) probability times annotated weight
        self._shares: ContactShares | None = None

    def take_contact(self, probability: np.ndarray, labels: np.ndarray) -> None:
        """Set the probability (T, R) that each region touches.

        ``labels`` (T, R) is 1 where an annotation states that the region touches.
        """
        self._probability, self._annotated = probability, labels == 1

    @property
    def probability(self) -> np.ndarray:
        """Probability (T, R) that each region touches, as of :meth:`take_contact`."""
        assert self._probability is not None, "take_contact comes first"
        return self._probability

    def holding_probability(self) -> np.ndarray:
        """Probability (T, M) that each patch vertex holds the object, times its share of the patch.

        As of the last :meth:`refresh`.
        """
        assert self._shares is not None, "refresh comes first"
        assert self._probability is not None, "take_contact comes first"
        patches = self.geometry.patches
        gate = self._probability[:, patches.region_of_patch] * self._shares.gate
        return self._shares.area * gate[:, patches.patch]

    def refresh(self, state: State) -> None:
        """Choose the vertices that carry the contact, and the weight of each region."""
        assert self._probability is not None and self._annotated is not None, "take_contact first"
        patches = self.geometry.patches
        distance = self.geometry.at(state).touching.distance[:, self.geometry.skin.patch]
        self._shares = spread_contact(distance, patches.patch, patches.region_of_patch)
        more = np.zeros_like(self._probability)
        for region in np.flatnonzero(self._annotated.any(0)).tolist():
            nearest = np.abs(distance[:, patches.region == region]).min(1)
            apart = np.clip((nearest - CONTACT_TOLERANCE) / SURFACE_SIGMA, 0.0, 1.0)
            more[:, region] = self._annotated[:, region] * apart
        self._draws = (1.0 + (ANNOTATED_CONTACT_WEIGHT - 1.0) * more) * self._probability

    def add(self, state: State, equations: BandedEquations) -> None:
        """Add Q_t E_C at ``state`` with the shares of the last :meth:`refresh`."""
        assert self._shares is not None, "refresh comes first"
        assert self._draws is not None, "refresh comes first"
        patches, at_patch = self.geometry.patches, self.geometry.skin.patch
        posed = self.geometry.at(state)
        near = posed.touching
        distance = near.distance
        touch, weight, energy = evaluate_contact(
            distance[:, at_patch],
            patches.patch,
            self._shares,
            self._draws[:, patches.region_of_patch],
        )
        residual, weights = np.zeros_like(distance), np.zeros_like(distance)
        residual[:, at_patch], weights[:, at_patch] = touch, weight * self._scale
        self.add_distances(posed, near, residual, weights, equations, energy * self._scale)
