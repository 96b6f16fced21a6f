"""Division of a recording into windows of frames, which bounds the memory of a fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

# Frames of a window: a sequence of InterCap (302 on average) is one. 400 frames of six cameras take
# some 2 GB (bench/RESULTS.md).
SIZE = 400
# Frames on each side that are fitted as well, and whose result is dropped: joints then change as
# little at a seam as elsewhere, by 0.04 mm (bench/RESULTS.md).
OVERLAP = 30


@dataclass(frozen=True)
class Window:
    """Frames that are fitted together, and those among them whose result is kept."""

    kept: slice
    used: slice

    @property
    def inner(self) -> slice:
        """The kept frames among those used."""
        return slice(self.kept.start - self.used.start, self.kept.stop - self.used.start)


def split_frames(count: int, size: int = SIZE, overlap: int = OVERLAP) -> list[Window]:
    """Divide ``count`` frames into windows of nearly equal length, at most ``size`` kept frames."""
    number = max(1, -(-count // size))
    ends = np.linspace(0, count, number + 1).round().astype(int).tolist()
    return [
        Window(slice(start, stop), slice(max(0, start - overlap), min(count, stop + overlap)))
        for start, stop in pairwise(ends)
    ]


def join(windows: Sequence[Window], values: Sequence[np.ndarray]) -> np.ndarray:
    """Join the kept frames of ``values``, one array (T, ...) of the used frames for each window."""
    return np.concatenate([v[w.inner] for w, v in zip(windows, values, strict=True)])
