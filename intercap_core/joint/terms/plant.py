"""Which parts of the soles stand, from how low and how still they are.

Plant (beyond the paper): a foot that stands stays where it stands, on the floor.

    E = sum over steps t, vertices i of P a_i rho(|x_i(t+1) - x_i(t)|^2) / 2 sigma^2

with P the probability that this part of the sole stands over the step (:mod:`.contact.standing`)
and a_i the vertex's share of it. Robust, as a foot may slide. Weighed by ``plant_weight``.
"""

from __future__ import annotations

import numpy as np

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.joint.contact.chain import Chain
from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.floor import Ground
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.skin import Patches
from intercap_core.joint.state import BODY, State
from intercap_core.joint.terms.term import Term, add_steps
from intercap_core.schemas import CONTACT_REGIONS

# How far a grip and a sole creep: a random walk, metres in one second. Tuned on the studio.
PLANT_WALK = 0.003
# Speeds of what truly slides, m/s: beyond the jitter of the fits. Tuned on the studio.
PLANT_OUTLIER = 0.15
SOLE_VERTICES = 6
# Of a part of a sole that stands, after errors of the fits: speed, m/s, and height above the floor,
# metres; and of one that swings. Tuned on the studio.
STANDING_SPEED, SWING_SPEED = 0.06, 0.6
STANDING_HEIGHT, SWING_HEIGHT = 0.02, 0.15
# Share of what stands that stands on something else than the floor, or where the floor is not.
# Tuned on the studio.
STANDING_ELSEWHERE = 0.2
# How often a second a part of a sole that swings comes to stand, and how long it stands, seconds.
# Tuned on the studio.
STANDING_BEGINS, STANDING_S = 0.18, 0.98

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


class Plant(Term):
    """Motion of what stands; ``floor`` None where none was seen: then stillness alone tells."""

    name = "plant"

    def __init__(self, geometry: Geometry, floor: Ground | None, fps: float, weight: float) -> None:
        self._geometry, self._floor, self._fps = geometry, floor, fps
        self._scale = weight * fps / PLANT_WALK**2
        parts = sole_parts(geometry.patches, SOLE_VERTICES)
        self._parts = [geometry.skin.patch[part] for part in parts]
        self._index = np.concatenate([np.zeros(0, int), *self._parts])
        self._weight = np.zeros((0, len(self._index)))

    def refresh(self, state: State) -> None:
        """Take anew which parts of the soles stand over each step."""
        skin = self._geometry.at(state).skin
        self._weight = np.zeros((max(len(state) - 1, 0), 0))
        for part in self._parts:
            height = None
            if self._floor is not None:
                height = self._floor.heights(skin[:, part])
            stands = standing_probability(skin[:, part], height, self._fps)
            share = np.repeat(stands[:, None] * self._scale / len(part), len(part), axis=1)
            self._weight = np.concatenate([self._weight, share], axis=1)

    def add(self, state: State, equations: NormalEquations) -> None:
        """Add the motion of soles at ``state``."""
        frames, count = len(state), len(self._index)
        if frames < 2 or not count:
            return
        posed = self._geometry.at(state)
        points = posed.skin[:, self._index]

        def rows(at: slice, index: np.ndarray) -> np.ndarray:
            axes = np.broadcast_to(np.eye(3), (*points[at, index].shape, 3))
            return posed.skin_by_body(at, self._index[index], axes)

        outlier = PLANT_OUTLIER / self._fps
        add_steps(self.name, BODY, points, rows, self._weight, outlier, equations)
