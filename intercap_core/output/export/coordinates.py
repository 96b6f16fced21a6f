"""In which frame, which way up and in which units the numbers of a file are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from intercap_core.output.export.motion import Motion
from intercap_core.output.export.numbers import listed

METRES = "metres, radians, seconds"
_ALONG = 1e-4  # of a unit vector's components, from which on it is not along an axis


@dataclass(frozen=True, eq=False)
class Coordinates:
    """``frame`` in words; ``up`` (3,) the unit vector up in it, NaN = not known; ``units``."""

    frame: str
    up: np.ndarray
    units: str = METRES

    @classmethod
    def of(cls, motion: Motion, units: str = METRES) -> Coordinates:
        """Those of a motion."""
        return cls(motion.frame, motion.up, units)

    @property
    def up_axis(self) -> str:
        """The axis that points up, as ``z`` or ``-y``, else that there is none."""
        for axis, value in zip("xyz", self.up, strict=True):
            if abs(abs(value) - 1) < _ALONG**2:
                return axis if value > 0 else f"-{axis}"
        return "none: the vector up is" if np.isfinite(self.up).all() else "not known"

    def told(self) -> dict[str, Any]:
        """In the words of JSON."""
        return {
            "frame": self.frame,
            "up_axis": self.up_axis,
            "up": listed(self.up, 6),
            "units": self.units,
        }

    def arrays(self) -> dict[str, np.ndarray]:
        """The same as arrays."""
        return {
            "frame": np.array(self.frame),
            "up_axis": np.array(self.up_axis),
            "up": self.up.astype(np.float64),
            "units": np.array(self.units),
        }

    def lines(self) -> list[str]:
        """The same for the head of a text file, a line each."""
        up = " ".join(f"{value:.6f}" for value in self.up)
        return [f"frame: {self.frame}", f"up: {self.up_axis} ({up})", f"units: {self.units}"]
