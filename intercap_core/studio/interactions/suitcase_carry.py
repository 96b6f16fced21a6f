"""Walk up to a suitcase, take it by its top handle, carry it two steps, put it down."""

from __future__ import annotations

from intercap_core.studio.interactions.carrying import HandleCarry

LIFT_M = (0.14, 0.20)


class SuitcaseCarry(HandleCarry):
    """The case's trolley bar is on the side away from the hand."""

    object_class = "suitcase"
    bar_half, beside, above = 0.008, 0.235, 0.14
    lifted_s, lower_s = 1.55, 1.95
    stoop_from, stoop_down, stoop_back, stoop_bend = 0.55, 0.24, 0.05, 0.42

    def lifted(self) -> float:
        return self.rng.uniform(*LIFT_M)
