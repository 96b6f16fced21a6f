"""Contact term E_C of equation 6 and the appendix: body areas that touch are drawn to the object.

E_C = CD(H(W(body)), H'(W'(object))): the distances between the body's likely-contact vertices and
the closest points of the object. Here each region is cut into patches (a palm, each finger, a
sole): the nearest patches carry the weight, within a patch the nearest vertices, and a patch that
is far gives up (Geman-McClure), so that a hand holding a handle with three fingers does not drag
the other two along. The paper's gate Q_t is the probability that the region touches.
"""

from __future__ import annotations

import numpy as np

# A vertex counts in its patch, and a patch in its region, by how much farther it is than the
# nearest: skin yields and meshes are some millimetres wrong, so contact is an area of this depth.
SOFTNESS = 0.006
# A patch farther than this gives up: the accuracy that keypoints and depth leave to a hand.
REACH = 0.02
# Nearer than this is contact and pulls no more: half the distance at which datasets call it so.
TOLERANCE = 0.002


def term(
    distance: np.ndarray,
    patch_of: np.ndarray,
    region_of_patch: np.ndarray,
    probability: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Residuals (T, N) in metres, weights (T, N) and energy (m^2) of all contact vertices.

    ``distance`` (T, N) signed distances to the object, metres; ``patch_of`` (N,) patch of each
    vertex; ``region_of_patch`` (P,); ``probability`` (T, R) that the region touches. One patch in
    one frame has the energy q rho(s) / 2, with q the region's probability times the patch's share
    in it, s the mean square residual over the patch's nearest area and Geman-McClure's
    rho(s) = R^2 s / (R^2 + s), R = ``REACH``; its weights are q rho'(s) spread over that area.
    """
    residual = np.sign(distance) * np.maximum(np.abs(distance) - TOLERANCE, 0.0)
    weight = np.zeros_like(distance)
    energy = 0.0
    patches = [np.flatnonzero(patch_of == patch) for patch in range(len(region_of_patch))]
    nearest = np.stack([np.maximum(distance[:, ids].min(axis=1), 0.0) for ids in patches], axis=1)
    for patch, members in enumerate(patches):
        region = region_of_patch[patch]
        gate = probability[:, region]
        if not gate.any():
            continue
        away = nearest[:, patch] - nearest[:, region_of_patch == region].min(axis=1)
        gate = (gate * _closeness(away))[:, None]
        area = _closeness(np.maximum(distance[:, members] - nearest[:, [patch]], 0.0))
        area /= area.sum(axis=1, keepdims=True)
        square = (area * np.square(residual[:, members])).sum(axis=1, keepdims=True)
        robust = REACH**2 / (REACH**2 + square)
        weight[:, members] = gate * area * robust**2
        energy += 0.5 * float((gate * square * robust).sum())
    return residual, weight, energy


def _closeness(away: np.ndarray) -> np.ndarray:
    """1 for what is nearest, falling off over ``SOFTNESS``."""
    return np.exp(-np.square(away / SOFTNESS) / 2)
