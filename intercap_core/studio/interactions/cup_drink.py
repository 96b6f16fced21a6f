"""Drink from the cup, whose handle points to the person's left."""

from __future__ import annotations

from intercap_core.studio.interactions.drinking import Drinking


class CupDrink(Drinking):
    """The hand around the wall, the rim's near edge at the lips."""

    object_class = "cup"
