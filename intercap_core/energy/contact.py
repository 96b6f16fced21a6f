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


def weights(
    distance: np.ndarray, patch_of: np.ndarray, probability: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (T, N) in metres and weights (T, N) of all contact vertices.

    ``distance`` (T, N) signed distances to the object, metres; ``patch_of`` (N,) patch of each
    vertex; ``probability`` (T, P) that the patch's region touches. The weights of one patch in one
    frame sum to probability times the square of Geman-McClure's factor.
    """
    residual = distance + INDENTATION
    out = np.zeros_like(distance)
    for patch in range(probability.shape[1]):
        members = np.flatnonzero(patch_of == patch)
        if not len(members):
            continue
        d = distance[:, members]
        nearest = np.maximum(d.min(axis=1, keepdims=True), 0.0)
        near = np.exp(-np.square(np.maximum(d - nearest, 0.0) / SOFTNESS) / 2)
        robust = np.square(REACH**2 / (REACH**2 + nearest**2))
        out[:, members] = near / near.sum(axis=1, keepdims=True) * robust * probability[:, [patch]]
    return residual, out
