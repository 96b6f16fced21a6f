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
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.geometry.solve.robust import geman_mcclure_weight
from intercap_core.joint.energy_constants import (
    CONTACT_OUTLIER,
    CONTACT_SOFTNESS,
    CONTACT_TOLERANCE,
)


@dataclass(frozen=True)
class Shares:
    """How contact is spread over a body: ``area`` (T, N) weights that sum to one in each patch, and
    ``gate`` (T, P) how much each patch takes part in its region's contact."""

    area: np.ndarray
    gate: np.ndarray


def shares(distance: np.ndarray, patch_of: np.ndarray, region_of_patch: np.ndarray) -> Shares:
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


def term(
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
