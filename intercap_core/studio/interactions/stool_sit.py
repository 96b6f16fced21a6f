"""Step back to a stool, feel for its edge, sit down, rest, rise."""

from __future__ import annotations

import numpy as np

from intercap_core.studio.controls import Pose, ramp
from intercap_core.studio.hands import RELAXED
from intercap_core.studio.interactions.sitting import LEFT, SEATED_S, Sitting
from intercap_core.studio.skeleton import unit

HOVER_M = (0.006, 0.016)


class StoolSit(Sitting):
    """A round seat without a back; the left hand hangs beside its rim."""

    object_class = "stool"
    palm_at = (-0.02, -0.16)
    hanging = 1.0

    def plan(self) -> None:
        super().plan()
        self.hover_place = self._beside_seat(self.rng.uniform(*HOVER_M))

    def turned(self) -> float:
        return self.rng.uniform(0, np.pi / 2)

    def _beside_seat(self, hover: float) -> np.ndarray:
        """The left hand hanging beside the seat's rim, ``hover`` metres away."""
        hand = self.puppet.hands[LEFT]
        fingers, palm = unit(np.array([0.15, 0.10, -1.0])), np.array([0.0, -1.0, -0.1])
        rotation = self.puppet.wrist_rotation(LEFT, fingers, palm)
        place = np.array([0.02, 0.20, self.seat_top - 0.02]) - rotation @ hand.knuckles.mean(0)
        return self.approached(LEFT, RELAXED, rotation, place, np.array([0, 1.0, 0]), hover)

    def left_wrist(
        self,
        idle: Pose,
        world: np.ndarray,
        pelvis: np.ndarray,
        times: np.ndarray,
    ) -> Pose:
        count = len(times)
        place = self.hover_place
        aside = place.copy()
        aside[:3, 3] += (0.0, 0.07, 0.06)
        wrist = idle.towards(Pose.still(aside, count), ramp(times, 0.9, SEATED_S))
        wrist = wrist.towards(Pose.still(place, count), ramp(times, 1.38, 1.66))
        return wrist.towards(Pose.still(aside, count), ramp(times, 1.92, 2.15))
