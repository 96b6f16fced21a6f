"""Ways to take a thing from a plinth, for any script that handles one."""

from __future__ import annotations

import numpy as np

from intercap_core.studio.interactions.grasps import (
    WRAP_OPEN,
    Approach,
    Grip,
    around_wall,
    laid_on,
    wrapped,
)
from intercap_core.studio.interactions.handling import FINGERS_REST_M, LEFT, RIGHT, SIDES, Handling

PALMS_BELOW_M = 0.01  # the middle of a thing held between palms


def between_palms(script: Handling) -> dict[int, Grip]:
    """A palm on either side of the thing, fingers ahead and a little down."""
    grips = {}
    for side in SIDES:
        inward = (-1.0, 1.0)[side]
        at = script.taken[:3, 3] - (0.0, 0.0, PALMS_BELOW_M)
        approach = Approach(at, np.array([0.9, 0.25 * inward, -0.35]),
                            np.array([0.15, inward, 0.18]),
                            floor=script.top + FINGERS_REST_M)  # fmt: skip
        grips[side] = laid_on(script.puppet, side, script.thing.surface, script.taken, approach)
    return grips


def by_the_wall(script: Handling, height: float) -> Grip:
    """The right hand around an upright wall, ``height`` metres above the thing's origin or as low
    as the plinth lets it."""
    at = script.taken[:3, 3] + (0, 0, height)
    return wrapped(script.puppet, RIGHT, WRAP_OPEN, script.thing.surface, script.taken,
                   around_wall(at, script.top + FINGERS_REST_M))  # fmt: skip


def palm_below(script: Handling) -> Grip:
    """The thing's bottom on the left palm, fingers ahead and to the right."""
    below = Approach(script.taken[:3, 3], np.array([0.75, -0.65, -0.05]), np.array([0, 0, 1.0]))
    return laid_on(script.puppet, LEFT, script.thing.surface, script.taken, below)
