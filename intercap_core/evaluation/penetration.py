"""Penetration depths between body and object."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Depths(NamedTuple):
    """Mean, median and deepest of one frame's penetrating points, metres; 0 with none."""

    mean: float
    median: float
    max: float


def depths(signed_distance: np.ndarray) -> Depths:
    """Depths to the surface over the points (N,) that are inside (negative distance)."""
    inside = -signed_distance[signed_distance < 0]
    if len(inside) == 0:
        return Depths(0.0, 0.0, 0.0)
    return Depths(float(inside.mean()), float(np.median(inside)), float(inside.max()))


def ground_penetration(vertices: np.ndarray, point: np.ndarray, normal: np.ndarray) -> float:
    """Depth of the deepest vertex (V, 3) below a floor, metres; 0 above it, NaN without floor.

    ``point`` (3,) lies on the floor, ``normal`` (3,) is its unit normal, up.
    """
    if not (np.isfinite(point).all() and np.isfinite(normal).all()):
        return float("nan")
    return max(0.0, float(-((vertices - point) @ normal).min()))


def summarise(per_frame_m: np.ndarray, contact_frame: np.ndarray) -> dict[str, float]:
    """The paper's figures over contact frames, millimetres and shares; NaN with no contact.

    ``per_frame_m`` (T,) one depth a frame, ``contact_frame`` (T,) bool.
    """
    depth = 1e3 * np.asarray(per_frame_m, np.float64)[contact_frame]
    if len(depth) == 0:
        depth = np.array([np.nan])
    nothing = bool(np.isnan(depth).all())
    return {
        "mean_mm": float(depth.mean()),
        "median_mm": float(np.median(depth)),
        "p98_mm": float(np.percentile(depth, 98)),
        **{
            f"share_le_{limit}mm": float("nan") if nothing else float((depth <= limit).mean())
            for limit in (5, 7, 10, 20)
        },
    }
