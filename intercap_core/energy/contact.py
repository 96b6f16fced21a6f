"""Contact term E_C of equation 6 and the appendix: body areas that touch are drawn to the object.

E_C = CD(H(W(body)), H'(W'(object))): the distances between the body's likely-contact vertices and
the closest points of the object. Here each region is cut into patches (a palm, each finger, a
sole): within a patch the vertices nearest to the surface carry the weight, and a patch that is far
gives up (Geman-McClure), so that a hand holding a handle with three fingers does not drag the
other two along. The paper's gate Q_t is the probability that the region touches.
"""

from __future__ import annotations

import numpy as np

# A vertex counts in its patch by how little farther it is than the patch's nearest one: skin
# yields and the mesh is some millimetres wrong, so contact is an area of about this depth.
SOFTNESS = 0.006
# Beyond this a patch is taken not to take part in its region's contact: twice the accuracy that
# keypoints and depth leave to a hand.
REACH = 0.03
# Contact is drawn this far into the surface: flesh gives way by a millimetre or so under load.
INDENTATION = 0.001


def term(
    distance: np.ndarray, patch_of: np.ndarray, probability: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Residuals (T, N) in metres, weights (T, N) and energy (m^2) of all contact vertices.

    ``distance`` (T, N) signed distances to the object, metres; ``patch_of`` (N,) patch of each
    vertex; ``probability`` (T, P) that the patch's region touches. One patch in one frame has the
    energy q rho(s) / 2, with s the mean square residual over its nearest area and Geman-McClure's
    rho(s) = R^2 s / (R^2 + s), R = ``REACH``; its weights are q rho'(s) spread over that area.
    """
    residual = distance + INDENTATION
    weight = np.zeros_like(distance)
    energy = 0.0
    for patch in range(probability.shape[1]):
        members = np.flatnonzero(patch_of == patch)
        gate = probability[:, [patch]]
        if not len(members) or not gate.any():
            continue
        d = distance[:, members]
        nearest = np.maximum(d.min(axis=1, keepdims=True), 0.0)
        area = np.exp(-np.square(np.maximum(d - nearest, 0.0) / SOFTNESS) / 2)
        area /= area.sum(axis=1, keepdims=True)
        square = (area * np.square(residual[:, members])).sum(axis=1, keepdims=True)
        robust = REACH**2 / (REACH**2 + square)
        weight[:, members] = gate * area * robust**2
        energy += 0.5 * float((gate * square * robust).sum())
    return residual, weight, energy
