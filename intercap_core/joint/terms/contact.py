"""Contact term E_C of equation 6 (A.4): body areas that touch are drawn to the object.

    E_C = CD( H(W(body)), H'(W'(object)) )

CD is the Chamfer distance between H, the body's likely-contact vertices, and H', their closest
points on the object: the signed distances of :mod:`.proximity`. By the appendix these are of the
whole object, by the paper's text of the vertices labelled as likely touched: the setting
``joint.contact_to``, where the latter are the faces between them, as vertices of a mesh may be
centimetres apart. Equation 6 weighs it by the binary Q_t (here the probability that a region
touches) times lambda_Q, and adds an E_C without Q_t, which is left out: a body that does not touch
is not drawn to the object.

Beyond the paper each region is cut into patches (a palm, each finger, a sole). The nearest patches
carry the weight, within a patch the nearest vertices, and a patch that is far is an outlier
(Geman-McClure), so that a hand holding a handle with three fingers does not drag the other two
along.

Contact: Q_t E_C of equation 6 (A.4), weighed by lambda_Q (setting ``contact_weight``).

The residuals, and what differs from the paper, are in
:mod:`intercap_core.joint.terms.contact_residual`. The
paper's binary Q_t is the probability that each region touches, annotated or detected; what somebody
saw touching draws more while it stands apart. The setting ``contact_to`` says what skin is drawn
to: any point of the object, or its annotated part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.geometry.solve.robust import geman_mcclure_weight
from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.state import State
from intercap_core.joint.terms.term import Term, add_distances

# Distance of a patch that truly touches, after errors of skin, mesh and calibration, metres.
# Tuned on the studio.
CONTACT_SIGMA = 0.004
# What an annotated contact weighs over a detected one, half its deviation: somebody saw it, while
# lasting errors of head and object hold them apart. Chosen on one recording of the studio (a bottle
# at the mouth, noise 2, three cameras): with 1 the mouth stays 10 mm off, with 16 the hand suffers.
# What touches is drawn no more than by detection: at a handle fingers were pulled askew.
ANNOTATED_CONTACT_WEIGHT = 4.0
# A vertex counts in its patch, and a patch in its region, by how much farther it is than the
# nearest, metres: skin yields and meshes are some millimetres wrong, so contact is an area of this
# depth. Tuned on the studio.
CONTACT_SOFTNESS = 0.006
# Distance at which a patch starts to count as an outlier, metres: the accuracy that keypoints and
# depth leave to a hand. Tuned on the studio.
CONTACT_OUTLIER = 0.02
# Nearer than this is contact and costs nothing, metres: half the distance (4.5 mm) at which
# ``contact_mm`` of the settings calls it contact, rounded down. Tuned on the studio.
CONTACT_TOLERANCE = 0.002


@dataclass(frozen=True)
class Shares:
    """How contact is spread over a body: ``area`` (T, N) weights that sum to one in each patch, and
    ``gate`` (T, P) how much each patch takes part in its region's contact."""

    area: np.ndarray
    gate: np.ndarray


def spread_contact(
    distance: np.ndarray, patch_of: np.ndarray, region_of_patch: np.ndarray
) -> Shares:
    """Spread contact at signed distances ``distance`` (T, N) to the object, metres.

    ``patch_of`` (N,) patch of each vertex, ``region_of_patch`` (P,). Taken once in a round and then
    held, so that the energy below has the derivative that its weights state.
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
    return Shares(area, _closeness(nearest - of_region))


def evaluate_contact(
    distance: np.ndarray,
    patch_of: np.ndarray,
    spread: Shares,
    probability: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals (T, N) in metres, weights (T, N) and energies (T,) (m^2) of all contact vertices.

    ``distance`` (T, N) signed distances to the object, metres; ``probability`` (T, P) that each
    patch's region touches. One patch in one frame has the energy q rho(s) / 2, with q probability
    times gate, s the mean square residual over the patch's area and Geman-McClure's
    rho(s) = R^2 s / (R^2 + s), R = ``CONTACT_OUTLIER``; its weights are q rho'(s) spread over that
    area.
    """
    residual = np.sign(distance) * np.maximum(np.abs(distance) - CONTACT_TOLERANCE, 0.0)
    square = np.zeros_like(probability)
    contribution = spread.area * np.square(residual)
    for patch in range(probability.shape[1]):
        square[:, patch] = contribution[:, patch_of == patch].sum(axis=1)
    gate = probability * spread.gate
    weight = spread.area * (gate * geman_mcclure_weight(square, CONTACT_OUTLIER))[:, patch_of]
    rho = CONTACT_OUTLIER**2 / (CONTACT_OUTLIER**2 + square)  # over the square
    return residual, weight, 0.5 * (gate * square * rho).sum(axis=1)


def _closeness(farther: np.ndarray) -> np.ndarray:
    """1 at the nearest, falling off with metres ``farther`` over ``CONTACT_SOFTNESS``."""
    return np.exp(-np.square(farther / CONTACT_SOFTNESS) / 2)


class Contact(Term):
    """Q_t E_C; Q (T, R), the probability that each region touches, is set between rounds."""

    name = "contact"

    def __init__(self, geometry: Geometry, weight: float) -> None:
        self._geometry, self._scale = geometry, weight / CONTACT_SIGMA**2
        self._probability: np.ndarray | None = None
        self._annotated: np.ndarray | None = None
        self._draws: np.ndarray | None = None
        self._shares: Shares | None = None

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
        self._shares = spread_contact(distance, patches.patch, patches.region_of_patch)
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
        touch, weight, energy = evaluate_contact(
            distance[:, at_patch],
            patches.patch,
            self._shares,
            self._draws[:, patches.region_of_patch],
        )
        residual, weights = np.zeros_like(distance), np.zeros_like(distance)
        residual[:, at_patch], weights[:, at_patch] = touch, weight * self._scale
        add_distances(self.name, posed, near, residual, weights, energy * self._scale, equations)
