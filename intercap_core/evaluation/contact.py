"""Contact by distance, depths of penetration, and agreement of contact with the true contact.

A vertex is in contact if its signed distance to the part of the other surface that it faces
(:mod:`intercap_core.geometry.rigid.facing`) is at most the threshold. The distance is negative
inside, so a penetrating vertex is in contact too. The paper thresholds the unsigned distance to the
whole surface at 4.5 mm; so vertices behind a thin wall count there, and those more than 4.5 mm
inside do not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from intercap_core.schemas import CONTACT_M

# Thresholds, metres, at which agreement with the true contact is also evaluated.
SWEEP_M = (0.002, 0.003, 0.0045, 0.006, 0.008, 0.010, 0.015, 0.020, 0.030)


def facing_reach(threshold_m: float) -> float:
    """Distance up to which contact is evaluated at ``threshold_m`` and in the sweep, metres."""
    return 1.01 * max(threshold_m, *SWEEP_M)


def vertex_contact(facing_distance: np.ndarray, threshold_m: float = CONTACT_M) -> np.ndarray:
    """Mask of the vertices in contact, of the shape of ``facing_distance`` (metres).

    The distances are those of :func:`intercap_core.geometry.rigid.facing.facing_distance`.
    """
    return facing_distance <= threshold_m


def region_contact(
    vertex: np.ndarray, regions: Mapping[str, np.ndarray], names: Sequence[str]
) -> np.ndarray:
    """Mask (..., R) of the regions in which at least one vertex is in contact.

    Args:
        vertex: (..., V) mask of vertices in contact.
        regions: vertex indices by region name.
        names: the R regions, in the order of the result.
    """
    return np.stack([vertex[..., regions[name]].any(-1) for name in names], -1)


def confusion(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Confusion counts (..., 4) over the last axis.

    The order is true positives, false positives, false negatives, true negatives.
    """
    counts = (found & true, found & ~true, ~found & true, ~found & ~true)
    return np.stack([c.sum(-1) for c in counts], -1)


def f1(counts: np.ndarray) -> float:
    """F1 of summed counts (4,) in the order of :func:`confusion`; NaN without any positive."""
    hits, false_alarms, misses = (float(c) for c in np.asarray(counts)[:3])
    total = 2 * hits + false_alarms + misses
    return 2 * hits / total if total else float("nan")


def recall(found: np.ndarray, true: np.ndarray) -> float:
    """Share of the true elements (N,) that were found; NaN if none is true."""
    return float(found[true].mean()) if true.any() else float("nan")


def precision(found: np.ndarray, true: np.ndarray) -> float:
    """Share of the found elements (N,) that are true; NaN if none was found."""
    return recall(true, found)


class Depths(NamedTuple):
    """Depths of the penetrating points of one frame, metres; 0 if no point penetrates."""

    mean: float
    median: float
    max: float


def depths(signed_distance: np.ndarray) -> Depths:
    """Statistics of the depths of the points inside the surface.

    ``signed_distance``: (N,) metres, negative inside.
    """
    inside = -signed_distance[signed_distance < 0]
    if len(inside) == 0:
        return Depths(0.0, 0.0, 0.0)
    return Depths(float(inside.mean()), float(np.median(inside)), float(inside.max()))


def ground_penetration(vertices: np.ndarray, point: np.ndarray, normal: np.ndarray) -> float:
    """Depth of the deepest vertex below the floor, metres.

    0 if all vertices are above the floor, NaN if the floor is unknown.

    Args:
        vertices: (V, 3) metres.
        point: (3,) a point of the floor.
        normal: (3,) unit normal of the floor, pointing up.
    """
    if not (np.isfinite(point).all() and np.isfinite(normal).all()):
        return float("nan")
    return max(0.0, float(-((vertices - point) @ normal).min()))


def penetration_summary(per_frame_m: np.ndarray, contact_frame: np.ndarray) -> dict[str, float]:
    """The paper's penetration figures over contact frames; NaN if no frame has contact.

    Returns mean, median and 98th percentile in millimetres, and the shares of frames whose depth is
    at most 5, 7, 10 and 20 mm.

    Args:
        per_frame_m: (T,) one depth per frame, metres.
        contact_frame: (T,) mask of the frames with contact.
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
