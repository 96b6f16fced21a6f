"""Gaps in sampled values, filled in."""

from __future__ import annotations

import numpy as np


def filled_linearly(values: np.ndarray, at: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Values (T, D) with the rows that are not ``known`` (T,) replaced by straight lines.

    ``at`` (T,) increasing: times or frame numbers. Known rows stay as they are; before the first
    and after the last one their values are held. Without any known row the values are returned as
    they are.
    """
    result = values.copy()
    if known.any() and not known.all():
        for column in range(values.shape[1]):
            result[~known, column] = np.interp(at[~known], at[known], values[known, column])
    return result
