"""Which parts of the soles stand, from how low and how still they are."""

from __future__ import annotations

import numpy as np

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.joint.contact.chain import Chain
from intercap_core.joint.contact.constants import (
    STANDING_BEGINS,
    STANDING_ELSEWHERE,
    STANDING_HEIGHT,
    STANDING_S,
    STANDING_SPEED,
    SWING_HEIGHT,
    SWING_SPEED,
)
from intercap_core.joint.contact.patches import Patches
from intercap_core.schemas import CONTACT_REGIONS

_SOLES = tuple(
    JOINT_INDEX[f"{side}_{name}"] for side in ("left", "right") for name in ("ankle", "foot")
)

_STAND = Chain(STANDING_BEGINS, (STANDING_S,), (1.0,))


def sole_parts(patches: Patches, count: int) -> list[np.ndarray]:
    """Members of the patches, at most ``count`` each, of heel and ball of the left and of the right
    foot: a foot that rolls stands on one of them."""
    feet = [CONTACT_REGIONS.index(f"{side}_foot") for side in ("left", "right")]
    found = []
    for joint in _SOLES:
        members = np.flatnonzero(np.isin(patches.region, feet) & (patches.joint == joint))
        if len(members):
            chosen = np.linspace(0, len(members) - 1, min(len(members), count)).round().astype(int)
            found.append(members[chosen])
    return found


def standing_probability(sole: np.ndarray, height: np.ndarray | None, fps: float) -> np.ndarray:
    """Probability (T - 1,) that a part of a sole stands from each frame to the next.

    ``sole`` (T, S, 3) its vertices and ``height`` (T, S) theirs above the floor, metres, None where
    no floor is known. A two-state chain over half-normal speeds and normal heights, of what stands
    and of what swings; what stands is on the floor, or on something at any height that a foot
    reaches (a beam, a step), where stillness alone tells.
    """
    if len(sole) < 2:
        return np.zeros(0)
    speed = np.linalg.norm(np.diff(sole, axis=0), axis=2).mean(1) * fps
    odds = _log_ratio(speed, STANDING_SPEED, SWING_SPEED)
    if height is not None:
        low = np.abs(height).mean(1)
        on_floor = _log_ratio(np.maximum(low[1:], low[:-1]), STANDING_HEIGHT, SWING_HEIGHT)
        odds = odds + np.logaddexp(
            np.log1p(-STANDING_ELSEWHERE) + on_floor, np.log(STANDING_ELSEWHERE)
        )
    return _STAND.posterior(odds[:, None], fps)[:, 0]


def _log_ratio(values: np.ndarray, narrow: float, wide: float) -> np.ndarray:
    """Log-likelihood ratio of two half-normal distributions of these deviations."""
    return 0.5 * (values**2) * (wide**-2 - narrow**-2) + np.log(wide / narrow)
