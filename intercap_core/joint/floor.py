"""The floor plane, and a test whether the sequential fits contradict it.

Several terms push body and object onto the floor: a floor that is wrong by decimetres would
displace the whole body. The sequential fits do not use the floor, so they can contradict it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.joint.geometry import Geometry, PosedGeometry
from intercap_core.joint.sequential import SequentialFits
from intercap_core.joint.state import frame_chunks
from intercap_core.schemas import CONTACT_REGIONS

_FEET = tuple(CONTACT_REGIONS.index(f"{side}_foot") for side in ("left", "right"))


@dataclass(frozen=True)
class FloorPlane:
    """The floor, in the master frame."""

    point: np.ndarray  # (3,) any point of the plane, metres
    normal: np.ndarray  # (3,) upward unit vector

    def heights(self, points: np.ndarray) -> np.ndarray:
        """Heights (..., N) of points (..., N, 3) above the floor, metres; negative below it."""
        return points @ self.normal - self.point @ self.normal

    def depths(self, points: np.ndarray) -> np.ndarray:
        """Return min(height, 0) (..., N) of points (..., N, 3), metres: 0 above the floor.

        The derivative by a point is the normal if the height is negative, 0 otherwise.
        """
        return np.minimum(self.heights(points), 0.0)


def contradiction(geometry: Geometry, sequential: SequentialFits, floor: FloorPlane) -> str:
    """Describe how the sequential fits contradict ``floor``; "" if they do not.

    The floor is too high if it is 0.1 m or more above the lower foot in most frames. It is too low
    if it is as far below both feet and object in 90 % of the frames, more than a jump lasts. Frames
    with an interpolated body do not count, nor does the object while it is lost.
    """
    tolerance = 0.10  # metres, three times the largest error of sequential fits on the studio
    feet = geometry.skin.patch[np.isin(geometry.patches.region, _FEET)]
    lowest, objects = np.full((2, len(sequential.state)), np.inf)
    for frames in frame_chunks(len(lowest)):
        posed = PosedGeometry(geometry, sequential.state.window(frames))
        lowest[frames] = floor.heights(posed.posed(geometry.skin.vertices[feet])).min(axis=1)
        if geometry.has_object:
            objects[frames] = floor.heights(posed.object_vertices).min(axis=1)
    known = ~sequential.flags.filled
    if not known.any():
        return ""
    sunk = float(np.median(lowest[known]))
    if sunk < -tolerance:
        return f"floor {-sunk:.2f} m above the feet, not used"
    reach = np.where(sequential.flags.lost, lowest, np.minimum(lowest, objects))
    nearest = float(np.quantile(reach[known], 0.1))
    if nearest > tolerance:
        return f"floor {nearest:.2f} m below feet and object, not used"
    return ""
