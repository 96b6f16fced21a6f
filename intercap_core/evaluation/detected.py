"""Contact as the joint stage states it, by its own probabilities, held to the true one.

Not to be confused with the contact that fitted meshes happen to have: :mod:`.contact`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.evaluation import contact

NEAR_MISS_M = 0.03  # what comes nearer than this and does not touch is a near miss
# Edges of the bins of a reliability table: the first and the last hold what is as good as sure.
RELIABILITY_BINS = (0.0, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98, 1.0)


def detected_figures(
    probability: np.ndarray, true: np.ndarray, distance: np.ndarray, names: Sequence[str]
) -> dict[str, float]:
    """How well ``probability`` (N, R) over a half agrees with ``true`` (N, R) contact.

    Over all frames and regions; the least F1 of the regions ``names`` (R,) that truly touch;
    precision among what truly is nearer than a near miss by ``distance`` (N, R), metres; the Brier
    score, the mean squared error of the probability; and its calibration error.
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
        "contact_detected_calibration_error": calibration_error(probability, true),
    }
    touching = [r for r in range(len(names)) if true[:, r].any()]
    if touching:
        by_region = {names[r]: contact.f1(counts[r]) for r in touching}
        figures["contact_detected_worst_region_f1"] = min(by_region.values())
        figures |= {f"contact_detected_{name}_f1": value for name, value in by_region.items()}
    return figures


@dataclass(frozen=True)
class Reliability:
    """Of each bin of probabilities that holds any: their ``count``, the mean ``stated`` one, and
    the share that is ``true``, all (B,)."""

    count: np.ndarray
    stated: np.ndarray
    true: np.ndarray


def reliability(probability: np.ndarray, true: np.ndarray) -> Reliability:
    """The reliability table of probabilities of any shape, ``true`` of the same."""
    p, y = probability.ravel().astype(np.float64), true.ravel()
    of = np.clip(np.digitize(p, RELIABILITY_BINS) - 1, 0, len(RELIABILITY_BINS) - 2)
    count = np.bincount(of, minlength=len(RELIABILITY_BINS) - 1)
    some = np.flatnonzero(count)
    stated, found = np.bincount(of, p)[some], np.bincount(of, y)[some]
    return Reliability(count[some], stated / count[some], found / count[some])


def calibration_error(probability: np.ndarray, true: np.ndarray) -> float:
    """Mean |stated - true| of the bins in which something is open: not surely free or touching.

    Nearly all regions are far from the object; with them the figure would always be near zero.
    """
    open_ = (probability >= RELIABILITY_BINS[1]) & (probability < RELIABILITY_BINS[-2])
    if not open_.any():
        return float("nan")
    found = reliability(probability[open_], true[open_])
    return float(np.average(np.abs(found.stated - found.true), weights=found.count))


def _share(part: float, whole: float) -> float:
    return part / whole if whole else float("nan")
