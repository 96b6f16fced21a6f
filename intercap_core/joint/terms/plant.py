"""Plant (beyond the paper): a foot that stands does not move.

    E = sum over steps t, vertices i of P a_i rho(|x_i(t+1) - x_i(t)|^2) / 2 sigma^2

A step leads from frame t to frame t + 1. P is the probability that this part of the sole stands
over the step, by its height and speed, and a_i the vertex's share of it. rho is robust
(Geman-McClure), as a foot may slide. Weighed by the setting ``plant_weight``.
"""

from __future__ import annotations

import numpy as np

from intercap_core.body.joints import FOOT_JOINTS
from intercap_core.joint.contact.chain import DwellChain
from intercap_core.joint.equations import BandedEquations
from intercap_core.joint.hand_track import CREEP
from intercap_core.joint.skin import Patches
from intercap_core.joint.state import BODY, State
from intercap_core.joint.terms.term import SLIP_OUTLIER, Equation, JointTerm, TermContext
from intercap_core.schemas import CONTACT_REGIONS

# A swinging sole comes to stand 0.18 times per second, and stands for 0.98 s. Tuned on the studio.
_STANDING = DwellChain(begins=0.18, durations=(0.98,), shares=(1.0,))


def sole_parts(patches: Patches, count: int) -> list[np.ndarray]:
    """Indices of at most ``count`` patch vertices of heel and ball of either foot.

    A foot that rolls stands on one of the two.
    """
    feet = [CONTACT_REGIONS.index(f"{side}_foot") for side in ("left", "right")]
    parts = []
    for joint in FOOT_JOINTS:
        members = np.flatnonzero(np.isin(patches.region, feet) & (patches.joint == joint))
        if len(members):
            chosen = np.linspace(0, len(members) - 1, min(len(members), count)).round().astype(int)
            parts.append(members[chosen])
    return parts


def standing_probability(sole: np.ndarray, height: np.ndarray | None, fps: float) -> np.ndarray:
    """Probability (T - 1,) that a part of a sole stands from each frame to the next.

    Posterior of a two-state chain. Speeds and heights are half-normal: 0.06 m/s and 20 mm while the
    sole stands, 0.6 m/s and 150 mm while it swings. One standing sole in five is not on the
    floor but on a beam or a step, where only the speed is informative. All are tuned on the studio.

    Args:
        sole: (T, S, 3) vertices, metres.
        height: (T, S) their heights above the floor, metres; None without a floor.
    """
    if len(sole) < 2:
        return np.zeros(0)
    speed = np.linalg.norm(np.diff(sole, axis=0), axis=2).mean(1) * fps
    odds = _log_ratio(speed, 0.06, 0.6)
    if height is not None:
        low = np.abs(height).mean(1)
        on_floor = _log_ratio(np.maximum(low[1:], low[:-1]), 0.02, 0.15)
        odds = odds + np.logaddexp(np.log1p(-0.2) + on_floor, np.log(0.2))
    return _STANDING.posterior(odds[:, None], fps)[:, 0]


def _log_ratio(values: np.ndarray, narrow: float, wide: float) -> np.ndarray:
    """Log-likelihood ratio, ``narrow`` over ``wide``, of half-normal standard deviations."""
    return 0.5 * (values**2) * (wide**-2 - narrow**-2) + np.log(wide / narrow)


class Plant(JointTerm):
    """Motion of soles that stand. Without a floor, stillness alone decides which stand."""

    name = "plant"
    equation = Equation(
        symbol="plant",
        source="beyond",
        formula="P rho(\\|\\|x(t+1) - x(t)\\|\\|^2) / (2 sigma^2), P the probability that this "
        "half of the sole stands",
        settings=("plant_weight",),
    )

    def __init__(self, context: TermContext) -> None:
        super().__init__(context)
        self._floor, self._fps = context.floor, context.fps
        self._scale = context.settings.plant_weight * context.fps / CREEP**2
        parts = sole_parts(self.geometry.patches, 6)  # vertices that move nearly as one
        self._parts = [self.geometry.skin.patch[part] for part in parts]
        self._index = np.concatenate([np.zeros(0, int), *self._parts])  # (K,) of the skin samples
        self._weight = np.zeros((0, len(self._index)))  # (T - 1, K)

    def refresh(self, state: State) -> None:
        """Estimate which parts of the soles stand over each step."""
        skin = self.geometry.at(state).skin
        self._weight = np.zeros((max(len(state) - 1, 0), 0))
        for part in self._parts:
            height = None if self._floor is None else self._floor.heights(skin[:, part])
            stands = standing_probability(skin[:, part], height, self._fps)
            share = np.repeat(stands[:, None] * self._scale / len(part), len(part), axis=1)
            self._weight = np.concatenate([self._weight, share], axis=1)

    def add(self, state: State, equations: BandedEquations) -> None:
        """Add the motion of the soles at ``state``."""
        frames, count = len(state), len(self._index)
        if frames < 2 or not count:
            return
        posed = self.geometry.at(state)
        points = posed.skin[:, self._index]

        def rows(at: slice, index: np.ndarray) -> np.ndarray:
            axes = np.broadcast_to(np.eye(3), (*points[at, index].shape, 3))
            return posed.skin_by_body(at, self._index[index], axes)

        self.add_steps(BODY, points, rows, self._weight, SLIP_OUTLIER / self._fps, equations)
