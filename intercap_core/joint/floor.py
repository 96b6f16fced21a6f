"""Whether the floor that the scene gives is one on which the tracked body can be.

A floor decides how high a body stands, by several terms at once: where it is wrong by decimetres,
they would carry the body there. The sequential fits know nothing of it, so they can contradict it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.joint.geometry import Geometry
from intercap_core.joint.sequential import SequentialFits
from intercap_core.schemas import CONTACT_REGIONS

# Feet so far below the floor, or feet and object so far above it, contradict it, metres: several
# times what sequential fits err there (at most 0.03). Tuned on the studio.
FLOOR_CONTRADICTED = 0.10
# Share of the frames in which feet or object should reach the floor: a jump ends, and so does a
# walk with the object in the air. Tuned on the studio.
REACHED_SHARE = 0.1

_FEET = tuple(CONTACT_REGIONS.index(f"{side}_foot") for side in ("left", "right"))


@dataclass(frozen=True)
class Ground:
    """A floor: ``point`` (3,) and upward unit ``normal`` (3,), master frame, metres."""

    point: np.ndarray
    normal: np.ndarray

    def heights(self, points: np.ndarray) -> np.ndarray:
        """Heights (..., N) of points (..., N, 3) above the floor, metres; negative below it."""
        return (points - self.point) @ self.normal


def contradiction(geometry: Geometry, sequential: SequentialFits, floor: Ground) -> str:
    """What the sequential fits say against ``floor``, in words; "" = nothing.

    The lower foot is below it in most frames, or neither feet nor object ever come near it: feet
    may hang from a chair or stand on a board, but then these reach it. Frames in which the body was
    filled in or the object is lost have no say.
    """
    posed = geometry.at(sequential.state)
    feet = geometry.skin.patch[np.isin(geometry.patches.region, _FEET)]
    lowest = floor.heights(posed.skin[:, feet]).min(axis=1)
    known = ~sequential.flags.filled
    if not known.any():
        return ""
    sunk = float(np.median(lowest[known]))
    if sunk < -FLOOR_CONTRADICTED:
        return f"floor {-sunk:.2f} m above the feet, not used"
    reach = lowest
    if geometry.has_object:
        objects = floor.heights(posed.object_vertices).min(axis=1)
        reach = np.where(sequential.flags.lost, lowest, np.minimum(lowest, objects))
    reach = reach[known]
    nearest = float(np.quantile(reach, REACHED_SHARE))
    if nearest > FLOOR_CONTRADICTED:
        return f"floor {nearest:.2f} m below feet and object, not used"
    return ""
