"""Body in object, beside equation 6: vertices of the body inside the object.

    E = sum over vertices v of the body inside the object of (depth(v) - tolerance)^2

Equation 6 sums E_P of equation 5, the body's self-penetration (:mod:`.body_self`), over frames, and
the text adds "we also penalize the body-object interpenetration, as done in PROX" without a symbol.
This is that term: beyond the paper's formulas, against the moving object, and by the distance to
its mesh instead of a voxel grid.
"""

from __future__ import annotations

import numpy as np

from intercap_core.joint.energy_constants import PENETRATION_TOLERANCE


def weights(distance: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (T, N) in metres and weights (T, N) of body vertices.

    ``distance`` (T, N) signed distances to the object, negative inside; ``share`` (N,) how many
    vertices of the whole mesh each vertex stands for. Only vertices deeper than
    ``PENETRATION_TOLERANCE`` have weight; the residual is zero at that depth.
    """
    residual = np.minimum(distance + PENETRATION_TOLERANCE, 0.0)
    return residual, np.where(residual < 0, share[None], 0.0)
