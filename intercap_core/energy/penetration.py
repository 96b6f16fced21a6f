"""Body-object interpenetration E_P of equation 6: body vertices inside the object pay their depth.

As in PROX, but against the moving object and its true mesh distance instead of a voxel grid.
"""

from __future__ import annotations

import numpy as np

# Contact leaves the mesh up to this deep in the surface (skin yields), which costs nothing.
TOLERANCE = 0.001


def weights(distance: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (T, N) in metres and weights (T, N) of body vertices.

    ``distance`` (T, N) signed distances to the object, negative inside; ``share`` (N,) how many
    vertices of the whole mesh each vertex stands for. Only vertices deeper than ``TOLERANCE`` have
    weight; the residual is zero at that depth.
    """
    residual = np.minimum(distance + TOLERANCE, 0.0)
    return residual, np.where(residual < 0, share[None], 0.0)
