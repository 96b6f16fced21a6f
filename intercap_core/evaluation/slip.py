"""How what is held slides along the skin that holds it, beyond what it truly does."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

# Between the two moments that a velocity is taken from: noise from frame to frame is no slip.
SLIP_S = 0.2


def slip_speed(
    local: np.ndarray,
    true_local: np.ndarray,
    touching: np.ndarray,
    normals_at: Callable[[np.ndarray], np.ndarray],
    fps: float,
) -> np.ndarray:
    """Speed (T,) at which fitted skin slides over the fitted object, beyond the true one, m/s.

    Of skin vertices in the object's own frame, fitted ``local`` and ``true_local`` (T, V, 3), over
    those ``touching`` (T, V) truly both in the frame and :data:`SLIP_S` later: the mean norm of the
    difference of both velocities along the surface, of which ``normals_at`` gives the unit normals
    (N, 3) nearest to true points (N, 3). NaN where no vertex touches at both ends.
    """
    total = len(local)
    found = np.full(total, np.nan)
    window = max(1, round(SLIP_S * fps))
    for t in range(total - window):
        held = np.flatnonzero(touching[t] & touching[t + window])
        if not len(held):
            continue
        moved, truly = (
            points[t + window, held].astype(np.float64) - points[t, held]
            for points in (local, true_local)
        )
        excess = (moved - truly) * (fps / window)
        normal = normals_at(true_local[t, held].astype(np.float64))
        along = excess - (excess * normal).sum(1, keepdims=True) * normal
        found[t] = np.linalg.norm(along, axis=1).mean()
    return found
