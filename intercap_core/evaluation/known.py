"""Figures of values of which some are unknown (NaN)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

Figures = dict[str, float]


def over_known(how: Callable[..., Any], values: Any, *arguments: float) -> float:
    """``how(values, *arguments)``; NaN if there are no values, or all of them are NaN.

    ``how`` is a function such as np.nanmean or np.nanpercentile.
    """
    values = np.asarray(values)
    return float("nan") if np.isnan(values).all() else float(how(values, *arguments))


def finite(figures: Figures) -> Figures:
    """The figures that are known."""
    return {name: value for name, value in figures.items() if np.isfinite(value)}
