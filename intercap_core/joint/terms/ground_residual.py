"""Ground support E_G and E_G' of equation 6 (A.5, A.6): nothing sinks into the floor.

    E_G = sum over vertices W of the body of || RL(n . (p - W)) ||^2
    E_G' = sum over vertices W' of the object of || RL(n . (p - W')) ||^2

with p a point of the floor, n its upward unit normal and RL the rectifier max(0, x).
"""

from __future__ import annotations

import numpy as np


def residuals(points: np.ndarray, ground_point: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Height (..., N) of points (..., N, 3) over the floor where negative, else 0; metres.

    Its derivative by a point is ``normal`` where the residual is negative and 0 elsewhere.
    """
    return np.minimum((points - ground_point) @ normal, 0.0)
