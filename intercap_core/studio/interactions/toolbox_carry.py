"""Squat beside a toolbox, take it by the handle over its lid, carry it two steps, put it down."""

from __future__ import annotations

from intercap_core.studio.interactions.carrying import HandleCarry

ARM_SHARE = (0.83, 0.89)  # of the arm's length: how far below the shoulder the wrist carries
SHOULDER_OF_HEIGHT = 0.81  # a standing person's shoulder, as a share of the height


class ToolboxCarry(HandleCarry):
    """The grip is a hand's width above the floor: knees and back bend far down."""

    object_class = "toolbox"
    bar_half, beside, above = 0.014, 0.225, 0.22
    knuckles_aside = (0.020, 0.030, 0.040)
    knuckles_below = (0.022, 0.028, 0.034, 0.040)
    lifted_s, lower_s = 1.70, 1.80
    stoop_from, stoop_down, stoop_back, stoop_bend = 0.28, 0.50, 0.08, 0.62

    def lifted(self) -> float:
        """The arm hangs almost straight while it carries."""
        puppet = self.puppet
        shoulder = SHOULDER_OF_HEIGHT * puppet.subject.height_m
        wrist = shoulder - self.rng.uniform(*ARM_SHARE) * puppet.arm
        return wrist - float((self.taken @ self.object_from_wrist)[2, 3])
