"""From the grey levels of an image to light."""

from __future__ import annotations

import numpy as np


def linear(levels: np.ndarray) -> np.ndarray:
    """Light (...,), 0 to 1, of uint8 grey levels by the curve of sRGB (IEC 61966-2-1)."""
    value = np.asarray(levels) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
