"""Irregular device clocks: resets, single wrong times, drift."""

from __future__ import annotations

import numpy as np

from intercap_core.formats.recordings.synchronise import distance_to

WRONG = -1
EARLIER_IS_ENOUGH = 0.5  # of the images of the fullest stretch


def epochs(times_us: np.ndarray) -> np.ndarray:
    """Return for each image (N,) the stretch of running time that it belongs to, from 0.

    ``times_us`` (N,) int64 are device times in the order of recording. Where time jumps back, a
    stretch ends and the next begins (the device's clock was reset). A single time that its
    neighbours on both sides contradict is ``WRONG`` and ends nothing.
    """
    stretch = np.zeros(len(times_us), np.int64)
    times = times_us.tolist()
    kept: list[int] = []  # of the current stretch
    number = 0
    for at, time in enumerate(times):
        if kept and time <= times[kept[-1]]:
            later = times[at + 1] if at + 1 < len(times) else None
            if later is not None and later > times[kept[-1]]:
                stretch[at] = WRONG
                continue
            if len(kept) > 1 and time > times[kept[-2]]:
                stretch[kept.pop()] = WRONG
            else:
                number += 1
                kept = []
        kept.append(at)
        stretch[at] = number
    return stretch


def best_epoch(
    times_us: np.ndarray, stretch: np.ndarray, reference_us: np.ndarray, within_us: float
) -> int:
    """Return the stretch that overlaps the others' times; the longest where none does.

    ``stretch`` (N,) is what :func:`epochs` says of ``times_us`` (N,); ``reference_us`` (M,) are
    increasing times of the others. A reset takes a clock out of step with them, so that of several
    stretches among their times the earlier is right: the first one with at least half as many
    images near a reference time as any other.
    """
    near = (distance_to(times_us, reference_us) <= within_us) & (stretch >= 0)
    if not near.any():
        return int(np.argmax(np.bincount(stretch[stretch >= 0])))
    counts = np.bincount(stretch[near])
    return int(np.argmax(counts >= counts.max() * EARLIER_IS_ENOUGH))


def drift_us(times_us: np.ndarray, skew_us: np.ndarray) -> float:
    """Return by how much a clock ran away from the sets' over the recording, microseconds.

    ``skew_us`` (T,) is device time minus the set's at ``times_us`` (T,), NaN = no image; the
    difference between the medians of the last and the first quarter, stretched to the whole.
    """
    has = np.flatnonzero(np.isfinite(skew_us))
    quarter = len(has) // 4
    if quarter < 2:
        return 0.0
    early, late = has[:quarter], has[-quarter:]
    moved = float(np.median(skew_us[late]) - np.median(skew_us[early]))
    span = float(np.median(times_us[late]) - np.median(times_us[early]))
    return moved * float(times_us[-1] - times_us[0]) / span
