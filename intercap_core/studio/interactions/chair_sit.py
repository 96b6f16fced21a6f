"""Step back to a chair, feel for the seat, sit down, lean back against it, rise."""

from __future__ import annotations

import numpy as np

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.studio.hands import part_of
from intercap_core.studio.interactions.sitting import SEATED_S, Sitting
from intercap_core.studio.skeleton import local_rotations

BACK_PRESSED_M = 0.006  # the back gives way by this much on the slats
OVER_SEAT_M = 0.04  # what is lower meets the seat
SITS_ABOVE_M = 0.13  # the pelvis above the seat, about
UPRIGHT_RAD, RECLINED_RAD = 0.08, 0.65
FARTHEST_AHEAD_M = 0.04  # of the pelvis from the seat's middle


class ChairSit(Sitting):
    """The chair's front is ahead; both hands come to rest on the thighs."""

    object_class = "chair"
    palm_at = (-0.02, -0.19)
    rise_s, risen_s = 2.40, 3.20
    sat_back = -0.12
    front_edge, on_thigh_s = 0.262, 1.95
    back_by_s = 0.12

    def turned(self) -> float:
        return np.pi / 2 + self.rng.normal(0, 0.03)

    def sit(self) -> None:
        """Sit as far back as an upright back has room, then lean until it is pressed."""
        subject = self.puppet.subject
        bones = [JOINT_INDEX[name] for name in ("pelvis", "spine1", "spine2", "spine3")]
        share = np.asarray(subject.weights[:, bones].sum(1)).ravel()
        back = part_of(subject, np.flatnonzero(share > 0.5))
        when = np.array([(SEATED_S + self.rise_s) / 2])

        def pressed() -> bool:
            trunk = self.trunk(when, still=True)
            local = local_rotations(self.puppet.trunk(trunk))
            posed = back.skin(local, trunk.pelvis - subject.rest_joints[0]).vertices[0]
            at = (posed - self.seat[:3, 3]) @ self.seat[:3, :3]
            at = at[at[:, 2] + self.seat[2, 3] > self.seat_top + OVER_SEAT_M]
            return float(self.thing.surface.signed_distance(at).min()) < -BACK_PRESSED_M

        self.seated_height, self.recline = self.seat_top + SITS_ABOVE_M, UPRIGHT_RAD
        low, high = self.sat_back, FARTHEST_AHEAD_M
        for _ in range(12):
            self.sat_back = (low + high) / 2
            if pressed():
                low = self.sat_back
            else:
                high = self.sat_back
        self.sat_back = high
        for _ in range(2):
            super().sit()
            low, high = 0.0, RECLINED_RAD
            for _ in range(12):
                self.recline = (low + high) / 2
                if pressed():
                    high = self.recline
                else:
                    low = self.recline
            self.recline = low
        super().sit()
