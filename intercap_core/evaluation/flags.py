"""Flags of unreliable frames, with their reasons."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def merge_reasons(sources: Sequence[tuple[np.ndarray, str]]) -> list[str]:
    """Join the reasons that hold in each frame: (mask (T,), reason) to T texts, empty = fine."""
    frames = len(sources[0][0])
    return ["; ".join(reason for mask, reason in sources if mask[t]) for t in range(frames)]


def ranges(reasons: Sequence[str]) -> list[tuple[int, int, str]]:
    """Runs of frames with the same reason as (first, last, reason), empty reasons left out."""
    runs: list[tuple[int, int, str]] = []
    for frame, reason in enumerate(reasons):
        if not reason:
            continue
        if runs and runs[-1][1] == frame - 1 and runs[-1][2] == reason:
            runs[-1] = (runs[-1][0], frame, reason)
        else:
            runs.append((frame, frame, reason))
    return runs
