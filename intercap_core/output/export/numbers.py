"""Numbers in JSON, which has no NaN."""

from __future__ import annotations

from typing import Any

import numpy as np


def listed(values: np.ndarray, digits: int) -> Any:
    """An array of any shape as lists of numbers of so many decimals, None where one is not
    finite."""
    if values.ndim:
        return [listed(part, digits) for part in values]
    number = float(values)
    return round(number, digits) if np.isfinite(number) else None
