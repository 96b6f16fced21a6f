"""Which moment of the truth belongs to each recorded frame set."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from intercap_core.errors import UserError


def match_times(path: Path, true_times: np.ndarray, times: np.ndarray, fps: float) -> np.ndarray:
    """The set (T,) of the truth ``path`` nearest to each recorded one; times in seconds, rising.

    Raises UserError where the truth has no set within half a frame of a recorded one.
    """
    after = np.clip(np.searchsorted(true_times, times), 0, len(true_times) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(times - true_times[before]) < np.abs(true_times[after] - times)
    nearest = np.where(nearer, before, after)
    apart = np.abs(true_times[nearest] - times)
    if apart.max(initial=0) > 0.5 / fps:
        raise UserError(
            f"{path}: holds {len(true_times)} frames and the recording {len(times)}; that of "
            f"{times[np.argmax(apart)]:.3f} s is {apart.max():.3f} s from the nearest; make the "
            "truth of this recording again or leave it out"
        )
    return nearest
