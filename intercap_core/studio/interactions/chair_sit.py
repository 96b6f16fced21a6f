"""Step back to a chair, feel for the seat, sit down, lean back against it, rise."""

from __future__ import annotations

import numpy as np

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.studio.hands import part_of
from intercap_core.studio.interactions.sitting import SEATED_S, Sitting
from intercap_core.studio.skeleton import local_rotations

BACK_PRESSED_M = 0.006  # the back gives way by this much on the slats
BACKRESTS = (0.0, 0.60)  # rad, between which the trunk finds the back


class ChairSit(Sitting):
    """The chair's front is ahead; both hands come to rest on the thighs."""

    object_class = "chair"
    palm_at = (-0.02, -0.19)
    rise_s, risen_s = 2.40, 3.20
    sat_back = -0.05
    feet_ahead, on_thigh_s = 0.32, 1.95

    def turned(self) -> float:
        return np.pi / 2 + self.rng.normal(0, 0.03)

    def sit(self) -> None:
        """Sit, lean back until the back is pressed, and sit as one then sits."""
        super().sit()
        subject = self.puppet.subject
        bones = [JOINT_INDEX[name] for name in ("spine1", "spine2", "spine3")]
        share = np.asarray(subject.weights[:, bones].sum(1)).ravel()
        back = part_of(subject, np.flatnonzero(share > 0.5))
        when = np.array([(SEATED_S + self.rise_s) / 2])
        low, high = BACKRESTS
        for _ in range(14):
            self.recline = (low + high) / 2
            trunk = self.trunk(when, still=True)
            local = local_rotations(self.puppet.trunk(trunk))
            posed = back.skin(local, trunk.pelvis - subject.rest_joints[0]).vertices[0]
            at = (posed - self.seat[:3, 3]) @ self.seat[:3, :3]
            if self.thing.surface.signed_distance(at).min() < -BACK_PRESSED_M:
                high = self.recline
            else:
                low = self.recline
        self.recline = low
        super().sit()
