"""The scripts that the studio can play, by name: class, object and differing class attributes.

Several scripts share a class, whose attributes are documented there.
"""

from __future__ import annotations

from typing import Any

from intercap_core.errors import UserError
from intercap_core.studio.interactions.alone import BeamWalk, WalkAndWave
from intercap_core.studio.interactions.base import Interaction
from intercap_core.studio.interactions.carrying import HandleCarry
from intercap_core.studio.interactions.drinking import Drinking
from intercap_core.studio.interactions.football_kick import FootballKick
from intercap_core.studio.interactions.presenting import Checking, LookingOn, PassingOn, Turning
from intercap_core.studio.interactions.sitting import ChairSit, StoolSit
from intercap_core.studio.interactions.skateboard_ride import SkateboardRide
from intercap_core.studio.interactions.slipping import GlidingSwing, Regrasp, TurningSwing
from intercap_core.studio.interactions.swinging import Key, Swinging


def _script(base: type[Interaction], object_class: str, **values: Any) -> type[Interaction]:
    """A script on another object, with values in place of the attributes of its base."""
    return type(base.__name__, (base,), {"object_class": object_class, **values})


BY_THE_WALL = dict(top_of_height=0.555, aside=-0.10)
BOTTLE_CHECK = dict(
    **BY_THE_WALL, grip_height_m=0.01, before_eyes=(0.06, -0.42, 0.64), tip_deg=20.0
)
IN_ONE_HAND = dict(
    **BY_THE_WALL,
    before_eyes=(0.05, -0.50, 0.75),
    turns_deg=((-70, 0, 0), (0, -30, 15), (70, 0, 0), (0, 25, -20)),
)
BETWEEN_PALMS = dict(
    grip_height_m=None,
    before_eyes=(0.0, -0.70, 0.95),
    turns_deg=((65, 0, 0), (0, -30, 0), (-65, 0, 0), (0, 25, 0)),
)
CHAIR = dict(
    before_eyes=(0.0, -0.75, 1.0), turns_deg=((65, 0, 0), (0, -30, 0), (-65, 0, 0), (0, 12, 0))
)
TIPPED = dict(
    before_eyes=(0.0, -0.75, 0.90), turns_deg=((0, -60, 0), (12, 0, 0), (0, 65, 0), (-12, 0, 0))
)
# Each key has the wrist's place, the directions of fingers and thumb, and start and end.
RACQUET = dict(  # a forehand: back, through the ball's place at the right, over the left shoulder
    handle_m=-0.27,
    turn_back_rad=0.45,
    turn_through_rad=0.50,
    keys=(
        Key((0.62, -0.22, -0.40), (0.80, 0.00, -0.60), (0.60, -0.05, 0.80), 0.96, 1.28),
        Key((-0.30, -0.60, -0.55), (-0.05, -0.70, -0.70), (-0.70, -0.55, 0.45), 1.12, 1.46),
        Key((0.60, -0.25, -0.62), (0.50, -0.15, -0.85), (0.25, -0.95, 0.05), 1.42, 1.64),
        Key((0.62, 0.35, -0.10), (0.75, 0.60, 0.20), (0.10, -0.10, 1.00), 1.54, 1.74),
        Key((0.45, 0.75, 0.10), (0.30, 0.90, -0.20), (-0.60, 0.30, 0.75), 1.64, 1.92),
    ),
)
SHOWN = dict(  # pointed up, to the right, to the left and up again, the other side ahead
    attach_s=0.76,
    release_s=2.78,
    turn_back_rad=0.0,
    turn_through_rad=0.0,
    lean_s=((0.15, 0.7, 0.8, 1.15), (2.25, 2.7, 2.8, 3.2)),
    right_steps_s=((0.86, 1.2), (2.1, 2.5)),
    lower_s=(2.18, 2.66, 2.54),
    keys=(
        Key((0.62, -0.10, -0.40), (0.95, 0.25, 0.00), (0.00, 0.15, 1.00), 0.78, 1.20),
        Key((0.62, -0.10, -0.40), (0.95, 0.10, 0.20), (0.10, -1.00, 0.15), 1.05, 1.50),
        Key((0.62, -0.10, -0.40), (0.95, -0.15, -0.10), (0.20, 0.85, 0.40), 1.35, 1.95),
        Key((0.62, 0.00, -0.45), (0.40, 0.90, 0.10), (0.30, -0.10, 1.00), 1.80, 2.25),
    ),
)
UMBRELLA = dict(  # as a cane: it points ahead, sweeps to the left and then low to the right
    handle_m=0.305,
    far_end=-1.0,
    side_up=-1.0,
    turn_back_rad=0.10,
    turn_through_rad=0.20,
    back_s=(1.55, 1.85, 1.95, 2.25),
    through_s=(1.25, 1.5, 1.6, 1.9),
    keys=(
        Key((0.70, 0.00, -0.35), (0.60, 0.00, -0.80), (0.80, 0.05, 0.45), 0.96, 1.34),
        Key((0.66, 0.30, -0.30), (0.50, 0.35, -0.80), (0.35, 0.90, 0.25), 1.28, 1.62),
        Key((0.50, -0.45, -0.62), (0.30, -0.35, -0.90), (0.55, -0.75, -0.30), 1.56, 1.94),
    ),
)
INTERACTIONS: dict[str, type[Interaction]] = {
    "suitcase_carry": _script(  # its trolley bar is on the side away from the hand
        HandleCarry, "suitcase", bar_half=0.008, distance_m=0.235, above=0.14, lift_m=(0.14, 0.20),
        lifted_s=1.55, lower_s=1.95, stoop_from=0.55, stoop_down=0.24, stoop_back=0.05,
        stoop_bend=0.42,
    ),
    "cup_drink": _script(Drinking, "cup"),
    "bottle_drink": _script(  # tilted beyond the horizontal: its bottom is above the lips
        Drinking, "bottle", tilt_deg=(66.0, 80.0), head_back=0.42, grip_height_m=0.01,
        lips_at_edge=False,
    ),
    "bottle_check": _script(Checking, "bottle", **BOTTLE_CHECK, second_hand=True),
    "cup_check": _script(Checking, "cup", **BY_THE_WALL, tip_deg=38.0, second_hand=True),
    "football_check": _script(Checking, "football", grip_height_m=None, tip_deg=40.0),
    "bottle_pass": _script(
        PassingOn, "bottle", **BY_THE_WALL, carried=(-0.10, 0.20, 0.36), grip_height_m=0.01
    ),
    "cup_pass": _script(PassingOn, "cup", **BY_THE_WALL, carried=(-0.10, 0.20, 0.36)),
    "football_pass": _script(PassingOn, "football", grip_height_m=None),
    "football_kick": FootballKick,
    "skateboard_ride": SkateboardRide,
    "bottle_regrasp": _script(Regrasp, "bottle", **BOTTLE_CHECK),
    "racquet_glide": _script(GlidingSwing, "tennis_racquet", **RACQUET),
    "umbrella_turn": _script(TurningSwing, "umbrella", **UMBRELLA),
    "racquet_swing": _script(Swinging, "tennis_racquet", **RACQUET),
    "umbrella_swing": _script(Swinging, "umbrella", **UMBRELLA),
    "stool_sit": StoolSit,
    "chair_sit": ChairSit,
    "toolbox_carry": _script(  # the grip is a hand's width above the floor: the person bends down
        HandleCarry, "toolbox", bar_half=0.014, distance_m=0.225, above=0.22,
        knuckles_aside=(0.020, 0.030, 0.040), knuckles_below=(0.022, 0.028, 0.034, 0.040),
        lifted_s=1.70, lower_s=1.80, stoop_from=0.28, stoop_down=0.50, stoop_back=0.08,
        stoop_bend=0.62,
    ),
    "bottle_scan": _script(Turning, "bottle", **IN_ONE_HAND, grip_height_m=0.01),
    "cup_scan": _script(Turning, "cup", **IN_ONE_HAND),
    "suitcase_scan": _script(Turning, "suitcase", **BETWEEN_PALMS, top_of_height=0.25),
    "chair_scan": _script(  # its back is away from the person, the palms near its front edge
        Turning, "chair", **BETWEEN_PALMS | CHAIR,
        top_of_height=0.20, plinth_half_m=0.24, plinth_ahead_m=0.20, prop_heading_deg=-85.0,
        palms_m=(-0.15, 0.0, -0.01),
    ),
    "stool_scan": _script(
        Turning, "stool", **BETWEEN_PALMS, top_of_height=0.20, plinth_half_m=0.20,
        plinth_ahead_m=0.26, palms_m=(-0.05, 0.0, 0.055),
    ),
    "toolbox_scan": _script(Turning, "toolbox", **BETWEEN_PALMS, top_of_height=0.42),
    "toolbox_still": _script(LookingOn, "toolbox"),
    "football_scan": _script(Turning, "football", **BETWEEN_PALMS),
    "skateboard_scan": _script(  # the palms are at its ends
        Turning, "skateboard", **BETWEEN_PALMS | TIPPED, top_of_height=0.35,
        plinth_half_m=0.28, plinth_ahead_m=0.22, palms_m=(0.0, 0.30, 0.02),
    ),
    "racquet_scan": _script(Swinging, "tennis_racquet", **RACQUET | SHOWN),
    "umbrella_scan": _script(Swinging, "umbrella", **UMBRELLA | SHOWN),
    "walk_and_wave": WalkAndWave,
    "beam_walk": BeamWalk,
}  # fmt: skip


def interaction_named(name: str) -> type[Interaction]:
    """Return a script; raises UserError if there is none of that name."""
    if name not in INTERACTIONS:
        raise UserError(
            f"studio: no interaction {name!r}, there are {', '.join(INTERACTIONS)}; correct "
            "'interaction' of the capture"
        )
    return INTERACTIONS[name]
