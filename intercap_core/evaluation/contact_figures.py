"""Reliability of the contact probabilities that the joint stage states, against true contact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.evaluation.figures import (
    SequenceMetrics,
    pooled,
)
from intercap_core.schemas import METRIC_REGIONS

# Bin edges of the reliability table. Probabilities in the first and last bin count as certain.
RELIABILITY_BINS = (0.0, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98, 1.0)


@dataclass(frozen=True)
class Reliability:
    """Reliability table over the B probability bins that are not empty."""

    count: np.ndarray
    """(B,) number of statements."""
    stated: np.ndarray
    """(B,) mean stated probability."""
    true: np.ndarray
    """(B,) share of true contact."""


def reliability(probability: np.ndarray, true: np.ndarray) -> Reliability:
    """Reliability table of probabilities; ``true`` has the same shape."""
    p, y = probability.ravel().astype(np.float64), true.ravel()
    of = np.clip(np.digitize(p, RELIABILITY_BINS) - 1, 0, len(RELIABILITY_BINS) - 2)
    count = np.bincount(of, minlength=len(RELIABILITY_BINS) - 1)
    some = np.flatnonzero(count)
    stated, found = np.bincount(of, p)[some], np.bincount(of, y)[some]
    return Reliability(count[some], stated / count[some], found / count[some])


def contact_reliability(sequences: Sequence[SequenceMetrics]) -> Reliability | None:
    """Reliability table of the joint stage's contact probabilities; None without truth."""
    found = stated_and_true(sequences)
    return None if found is None else reliability(*found[:2])


def stated_and_true(
    sequences: Sequence[SequenceMetrics],
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Stated probability, true contact and true distance (N, 12) over all sequences' frames."""
    stated = [s for s in sequences if "contact_probability" in s.values]
    have = [s for s in stated if "truth/region_distance" in s.values]
    probability, true = pooled(have, "contact_probability"), pooled(have, "truth/contact_region")
    distance = pooled(have, "truth/region_distance")
    if probability is None or true is None or distance is None:
        return None
    return probability[:, : len(METRIC_REGIONS)], true, distance  # the other regions have no truth
