"""Numbers that files hold: finite, of a shape, within bounds."""

from __future__ import annotations

from typing import Any

import numpy as np

from intercap_core.errors import UserError
from intercap_core.inputs.quotes import quoted


def numbers_of(value: Any, where: str, field: str) -> np.ndarray:
    """Finite numbers as an array; raises UserError, beginning with ``where``, for anything else."""
    try:
        numbers = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.full(1, np.nan)
    if not np.isfinite(numbers).all():
        raise UserError(f"{where}: {field} is {quoted(value)}, expected finite numbers; correct it")
    return numbers
