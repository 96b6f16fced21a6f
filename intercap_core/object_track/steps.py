"""How the object goes from one frame to the next: at rest, in a hand, or freely.

Each is a mode of motion, in which it stays for a while; the decoder goes from one to another at a
cost (:mod:`.decoder`). All log-probabilities are up to the same constant, which is that of no
motion at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from intercap_core.object_track.constants import (
    APPEAR_COST,
    EXCURSION_COST,
    FREE_COST_S,
    HELD_M,
    HELD_M_S,
    HELD_RAD,
    HELD_RAD_S,
    HOLDING_REACH_M,
    JUMP_COST,
    MOVING_M_S,
    MOVING_TURN_RAD_S,
    REACH_M,
    REACH_M_S,
    STANDING_M,
    STANDING_RAD,
    VANISH_COST,
)
from intercap_core.object_track.motion import HandMotion
from intercap_core.rigid.mesh import ObjectMesh


def step_costs(
    mesh: ObjectMesh,
    before: np.ndarray,
    after: np.ndarray,
    seconds: float,
    hands: Sequence[HandMotion | None],
) -> np.ndarray:
    """Log-probabilities (2 + H, K + 1, L + 1) of the steps from poses ``before`` (K, 4, 4) to
    ``after`` (L, 4, 4), ``seconds`` later, and to and from none of them, by mode.

    First at rest; then freely, of which any step is one, at some cost; then with each of the H
    ``hands``, where its motion is known and it is near enough to hold the object.
    """
    found = np.zeros((2 + len(hands), len(before) + 1, len(after) + 1))
    found[:, :-1, -1], found[:, -1, :-1] = -VANISH_COST, -APPEAR_COST
    if not (len(before) and len(after)):
        return found
    turn, shift = _apart(mesh, before, after)
    found[0, :-1, :-1] = -0.5 * ((turn / STANDING_RAD) ** 2 + (shift / STANDING_M) ** 2)
    moved = (turn / (MOVING_TURN_RAD_S * seconds)) ** 2 + (shift / (MOVING_M_S * seconds)) ** 2
    found[1, :-1, :-1] = -np.minimum(0.5 * moved, JUMP_COST) - FREE_COST_S * seconds
    for mode, hand in enumerate(hands, 2):
        found[mode, :-1, :-1] = -np.inf
        if hand is not None:
            found[mode, :-1, :-1] = _held(mesh, before, after, seconds, hand)
    return found


def _held(
    mesh: ObjectMesh, before: np.ndarray, after: np.ndarray, seconds: float, hand: HandMotion
) -> np.ndarray:
    """Log-probabilities (K, L) of steps with this hand."""
    turn, shift = _apart(mesh, hand.carry(before), after)
    arm = np.array([np.linalg.norm(mesh.centre_at(pose) - hand.start) for pose in before])
    turn_sigma = np.hypot(HELD_RAD, HELD_RAD_S * seconds)
    # an error of the hand's turn moves what is far from it
    shift_sigma = np.sqrt(HELD_M**2 + (HELD_M_S * seconds) ** 2 + (arm * turn_sigma) ** 2)
    found = -0.5 * ((turn / turn_sigma) ** 2 + (shift / shift_sigma[:, None]) ** 2)
    found[arm > mesh.diameter / 2 + HOLDING_REACH_M] = -np.inf
    return found


def _apart(
    mesh: ObjectMesh, before: np.ndarray, after: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Turns (K, L), radians, and shifts (K, L) of the centre, metres, between all pairs of poses
    (K, 4, 4) and (L, 4, 4)."""
    turn = np.radians(
        mesh.symmetry.rotation_error_deg(before[:, None, :3, :3], after[None, :, :3, :3])
    )
    here, there = (
        poses[:, :3, :3] @ mesh.centre_of_mass + poses[:, :3, 3] for poses in (before, after)
    )
    return turn, np.linalg.norm(there[None] - here[:, None], axis=-1)


def excursions(
    centres: Sequence[np.ndarray], path: np.ndarray, sure: np.ndarray, times: np.ndarray
) -> list[np.ndarray]:
    """Which hypotheses [T] (K_t,) cannot be true if the sure frames around are.

    ``centres`` [T] (K_t, 3) of the hypotheses, metres; of frames that are ``sure`` (T,) the
    ``path`` (T,) says where it is; ``times`` (T,) seconds. Out of reach is what is too far from the
    sure frame before or after, where there are both and one can be reached from the other.
    """

    def reaches(a: np.ndarray, b: np.ndarray, seconds: float) -> np.ndarray:
        return np.linalg.norm(a - b, axis=-1) < REACH_M + REACH_M_S * seconds

    known = np.flatnonzero(sure).tolist()
    places = np.array([centres[t][path[t]] for t in known]).reshape(-1, 3)
    found = [np.zeros(len(own), bool) for own in centres]
    for i, (u, v) in enumerate(pairwise(known)):
        if v > u + 1 and reaches(places[i], places[i + 1], times[v] - times[u]):
            for t in range(u + 1, v):
                found[t] = ~(
                    reaches(centres[t], places[i], times[t] - times[u])
                    & reaches(centres[t], places[i + 1], times[v] - times[t])
                )
    return found


def with_excursions(steps: Sequence[np.ndarray], away: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The log-probabilities of steps where going to a hypothesis that is out of reach, and coming
    back, each cost :data:`EXCURSION_COST` in addition; ``away`` [T] as of :func:`excursions`."""
    result = []
    for step, (before, after) in zip(steps, pairwise(away), strict=True):
        out, back = np.append(before, False), np.append(after, False)
        result.append(step - EXCURSION_COST * (out[:, None] != back))
    return result
