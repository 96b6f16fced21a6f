"""Soft tissue: skin and cloth that meet the object give way instead of entering it."""

from __future__ import annotations

import numpy as np

from intercap_core.geometry.rigid.distance import DistanceField

GAP_M = 0.0003  # skin that was pressed stays this far outside, so that float32 keeps it outside
NEAR_M = 0.01


def press_out(
    points: np.ndarray,
    surface: DistanceField,
    stage_from_object: np.ndarray,
    bounds: np.ndarray,
) -> np.ndarray:
    """Move points (N, 3) of the stage that are inside the object to its surface.

    ``bounds`` (2, 3) is the object's box in its own frame. The displacement is as deep as the
    point was, so it fades to nothing where the skin leaves the object.
    """
    rotation, translation = stage_from_object[:3, :3], stage_from_object[:3, 3]
    local = (points - translation) @ rotation
    near = ((local > bounds[0] - NEAR_M) & (local < bounds[1] + NEAR_M)).all(1)
    ids = np.flatnonzero(near)
    if len(ids) == 0:
        return points
    ids = ids[surface.signed_distance(local[ids]) < GAP_M]
    if len(ids) == 0:
        return points
    moved = points.copy()
    at = local[ids]
    for _ in range(3):  # at a thin edge the nearest surface may change side
        inside = surface.signed_distance(at) < 0.5 * GAP_M
        if not inside.any():
            break
        closest = surface.closest(at[inside])
        at[inside] = closest.points + GAP_M * closest.normals
    moved[ids] = at @ rotation.T + translation
    return moved
