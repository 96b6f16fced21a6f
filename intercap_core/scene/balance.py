"""Weights of surface points by the direction of their normals.

Where nearly all points that two cameras share lie on one plane, it says little of motions along
itself; the few others say all of them, and would be drowned.
"""

from __future__ import annotations

import numpy as np

from intercap_core.scene.constants import DIRECTION_COSINE, MAX_DIRECTION_GAIN, MAX_DIRECTION_SHARE

_STEPS = 3  # until the mean of a direction that holds most of the weight stays


def balanced(weight: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Weights (N,) of points with unit normals (N, 3), their sum unchanged, in which one direction
    has at most ``MAX_DIRECTION_SHARE`` of it.

    The others gain at most ``MAX_DIRECTION_GAIN`` times: specks of a bare floor's edge are no wall.
    """
    total = weight.sum()
    inside = np.ones(len(weight), bool)
    for _ in range(_STEPS):
        mean = weight[inside] @ normals[inside]
        inside = normals @ mean >= DIRECTION_COSINE * np.linalg.norm(mean)
    share = weight[inside].sum() / max(total, 1e-9)
    if share <= MAX_DIRECTION_SHARE or share >= 1:
        return weight
    gain = min(MAX_DIRECTION_GAIN, (1 - MAX_DIRECTION_SHARE) / (1 - share))
    return weight * np.where(inside, (1 - (1 - share) * gain) / share, gain)
