"""The scripts that the studio can play, by name."""

from __future__ import annotations

from intercap_core.errors import UserError
from intercap_core.studio.interactions.alone import BeamWalk, WalkAndWave
from intercap_core.studio.interactions.base import Interaction
from intercap_core.studio.interactions.carrying import SuitcaseCarry, ToolboxCarry
from intercap_core.studio.interactions.drinking import BottleDrink, CupDrink
from intercap_core.studio.interactions.football_kick import FootballKick
from intercap_core.studio.interactions.presenting import (
    BottleCheck,
    BottlePass,
    CupCheck,
    CupPass,
    FootballCheck,
    FootballPass,
)
from intercap_core.studio.interactions.sitting import ChairSit, StoolSit
from intercap_core.studio.interactions.skateboard_ride import SkateboardRide
from intercap_core.studio.interactions.slipping import BottleRegrasp, RacquetGlide, UmbrellaTurn
from intercap_core.studio.interactions.swinging import RacquetSwing, UmbrellaSwing

INTERACTIONS: dict[str, type[Interaction]] = {
    "suitcase_carry": SuitcaseCarry,
    "cup_drink": CupDrink,
    "bottle_drink": BottleDrink,
    "bottle_check": BottleCheck,
    "cup_check": CupCheck,
    "football_check": FootballCheck,
    "bottle_pass": BottlePass,
    "cup_pass": CupPass,
    "football_pass": FootballPass,
    "football_kick": FootballKick,
    "skateboard_ride": SkateboardRide,
    "bottle_regrasp": BottleRegrasp,
    "racquet_glide": RacquetGlide,
    "umbrella_turn": UmbrellaTurn,
    "racquet_swing": RacquetSwing,
    "umbrella_swing": UmbrellaSwing,
    "stool_sit": StoolSit,
    "chair_sit": ChairSit,
    "toolbox_carry": ToolboxCarry,
    "walk_and_wave": WalkAndWave,
    "beam_walk": BeamWalk,
}


def interaction_named(name: str) -> type[Interaction]:
    """Return a script. Raises UserError where there is none of that name."""
    if name not in INTERACTIONS:
        raise UserError(
            f"studio: no interaction {name!r}, there are {', '.join(INTERACTIONS)}; correct "
            "'interaction' of the capture"
        )
    return INTERACTIONS[name]
