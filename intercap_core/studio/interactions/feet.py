"""A foot by itself: its skin where a script wants it, for soles and insteps that meet things."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.studio.hands import part_of
from intercap_core.studio.motion import SIDES, Puppet, foot_rotations


class Foot:
    """One foot of a puppet; ``side`` 0 left, 1 right. Places are ankle x, y, z, pitch, heading."""

    def __init__(self, puppet: Puppet, side: int) -> None:
        self.side, self.subject = side, puppet.subject
        self.ankle, self.toes = (JOINT_INDEX[f"{SIDES[side]}_{j}"] for j in ("ankle", "foot"))
        share = np.asarray(self.subject.weights[:, [self.ankle, self.toes]].sum(1)).ravel()
        self._part = part_of(self.subject, np.flatnonzero(share > 0.5))

    def skin(self, places: np.ndarray) -> np.ndarray:
        """(N, 5) -> skin, or the shoe round it, (N, n, 3) of the stage."""
        foot = foot_rotations(places[:, [4, 4]], places[:, [3, 3]])[:, self.side]
        local = np.broadcast_to(np.eye(3), (len(places), 55, 3, 3)).copy()
        local[:, self.ankle] = foot[:, 0]
        local[:, self.toes] = np.swapaxes(foot[:, 0], 1, 2) @ foot[:, 1]
        posed = self._part.skin(local, np.zeros((len(places), 3))).clothed
        return posed - self.subject.rest_joints[self.ankle] + places[:, None, :3]

    def backed_off(
        self,
        place: np.ndarray,
        way: np.ndarray,
        gap: float,
        distance: Callable[[np.ndarray], float],
    ) -> np.ndarray:
        """The place (5,) moved along ``way`` (5,) until the skin is ``gap`` metres off by
        ``distance`` of skin (n, 3)."""
        low, high = 0.0, 1.0
        for _ in range(18):
            middle = (low + high) / 2
            if distance(self.skin((place + middle * way)[None])[0]) < gap:
                low = middle
            else:
                high = middle
        return place + high * way


def moved(place: np.ndarray, x: float, y: float, z: float, pitch: float = 0.0) -> np.ndarray:
    """A place (5,) moved by metres and pitched by rad."""
    return place + np.array([x, y, z, pitch, 0.0])


def still(place: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """The path of a foot that stays at a place (5,)."""
    return lambda times: np.broadcast_to(place, (len(times), 5))
