"""Contact by distance, and how well it agrees with the true contact.

A vertex is in contact when its signed distance to the other surface is at most the threshold, so
a penetrating vertex is too. The paper thresholds the unsigned distance at 4.5 mm; the two differ
by the vertices that lie deeper than that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

CONTACT_M = 0.0045  # the paper's threshold, Experiments, "Contact Heatmaps"
SWEEP_M = (0.002, 0.003, 0.0045, 0.006, 0.008, 0.010, 0.015, 0.020, 0.030)


def vertex_contact(signed_distance: np.ndarray, threshold_m: float = CONTACT_M) -> np.ndarray:
    """Which vertices touch, of any shape."""
    return signed_distance <= threshold_m


def region_contact(
    vertex: np.ndarray,
    regions: Mapping[str, np.ndarray],
    names: Sequence[str],
) -> np.ndarray:
    """Whether some vertex of each region touches: (..., V) bool to (..., R) in ``names``' order."""
    return np.stack([vertex[..., regions[name]].any(-1) for name in names], -1)


def confusion(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """True and false positives, false and true negatives (..., 4) over the last axis."""
    counts = (found & true, found & ~true, ~found & true, ~found & ~true)
    return np.stack([c.sum(-1) for c in counts], -1)


def f1(counts: np.ndarray) -> float:
    """F1 of summed counts (4,) as :func:`confusion` orders them; NaN with nothing to find."""
    hits, false_alarms, misses = (float(c) for c in np.asarray(counts)[:3])
    total = 2 * hits + false_alarms + misses
    return 2 * hits / total if total else float("nan")


def recall(found: np.ndarray, true: np.ndarray) -> float:
    """Share of the true ones (T,) that were found; NaN where there are none."""
    return float(found[true].mean()) if true.any() else float("nan")


def precision(found: np.ndarray, true: np.ndarray) -> float:
    """Share of the found ones (T,) that are true; NaN where none was found."""
    return recall(true, found)
