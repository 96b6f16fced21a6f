"""Drink from the bottle, held around its body, its top in the middle of the mouth."""

from __future__ import annotations

from intercap_core.studio.interactions.drinking import Drinking


class BottleDrink(Drinking):
    """The bottle leans over the horizontal: its bottom is higher than the lips."""

    object_class = "bottle"
    tilt_deg = (66.0, 80.0)
    head_back = 0.42
    grip_height_m = 0.01
    lips_at_edge = False
