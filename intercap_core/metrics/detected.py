"""Contact as the joint stage states it, by its own probabilities, held to the true one.

Not to be confused with the contact that fitted meshes happen to have: :mod:`.contact`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from intercap_core.metrics import contact

NEAR_MISS_M = 0.03  # what comes nearer than this and does not touch is a near miss


def detected_figures(
    probability: np.ndarray, true: np.ndarray, distance: np.ndarray, names: Sequence[str]
) -> dict[str, float]:
    """How well ``probability`` (N, R) over a half agrees with ``true`` (N, R) contact.

    Over all frames and regions; the least F1 of the regions ``names`` (R,) that truly touch;
    precision among what truly is nearer than a near miss by ``distance`` (N, R), metres; and the
    Brier score, the mean squared error of the probability.
    """
    found = probability > 0.5
    counts = contact.confusion(found.T, true.T)
    hits, false_alarms, misses = (float(n) for n in counts[:, :3].sum(0))
    near = distance < NEAR_MISS_M
    figures = {
        "contact_detected_precision": _share(hits, hits + false_alarms),
        "contact_detected_recall": _share(hits, hits + misses),
        "contact_detected_f1": contact.f1(counts.sum(0)),
        "contact_detected_near_precision": contact.precision(found[near], true[near]),
        "contact_detected_brier": float(np.mean((probability - true) ** 2)),
    }
    touching = [r for r in range(len(names)) if true[:, r].any()]
    if touching:
        by_region = {names[r]: contact.f1(counts[r]) for r in touching}
        figures["contact_detected_worst_region_f1"] = min(by_region.values())
        figures |= {f"contact_detected_{name}_f1": value for name, value in by_region.items()}
    return figures


def _share(part: float, whole: float) -> float:
    return part / whole if whole else float("nan")
