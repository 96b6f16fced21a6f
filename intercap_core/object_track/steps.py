"""How the object goes from one frame to the next: at rest, in a hand, or freely.

Each is a mode of motion, in which it stays for a while, and changes it seldom. Of a mode's own
log-probability the most likely step has 0, whatever the mode's width: poses are a few hypotheses,
no densities.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.special import logsumexp

from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.constants import (
    APPEAR_COST,
    EXCURSION_COST,
    FREE_COST_S,
    FREE_LASTING_S,
    HELD_M,
    HELD_M_S,
    HELD_RAD,
    HELD_RAD_S,
    JUMP_COST,
    MODE_CHANGES_S,
    MOVING_M_S,
    MOVING_TURN_RAD_S,
    REACH_M,
    REACH_M_S,
    STANDING_M,
    STANDING_RAD,
    VANISH_COST,
)
from intercap_core.object_track.motion import HandMotion

FIRST_HAND = 2  # the modes before: rest, free


def step_costs(
    mesh: ObjectMesh,
    before: np.ndarray,
    after: np.ndarray,
    seconds: float,
    hands: Sequence[HandMotion | None],
    free_cost_s: float = FREE_COST_S,
) -> np.ndarray:
    """Log-probabilities (M, M, K + 1, L + 1), M = 2 + H, of the steps from poses ``before`` (K, 4,
    4) to ``after`` (L, 4, 4), ``seconds`` later, and to and from none of them, by the mode of the
    step before and by the step's own.

    The first mode is rest; in the second the object moves freely, of which any step is one, at
    ``free_cost_s`` nats a second; then it moves with each of the H ``hands``, where the hand's
    motion is known and it is near enough to hold the object.
    """
    modes = FIRST_HAND + len(hands)
    found = np.zeros((modes, modes, len(before) + 1, len(after) + 1))
    found[..., :-1, -1], found[..., -1, :-1] = -VANISH_COST, -APPEAR_COST
    if not (len(before) and len(after)):
        return found
    own = mode_log_ratios(mesh, before, after, seconds, hands, free_cost_s)
    changes = np.full((modes, modes), np.log(-np.expm1(-MODE_CHANGES_S * seconds)))
    np.fill_diagonal(changes, 0.0)
    # of the modes that are possible from a pose, one is true
    possible = np.where(np.isfinite(own).any(2), 0.0, -np.inf)
    share = changes[:, :, None] - logsumexp(changes[:, :, None] + possible, axis=1, keepdims=True)
    found[..., :-1, :-1] = share[..., None] + own
    return found


def mode_log_ratios(
    mesh: ObjectMesh,
    before: np.ndarray,
    after: np.ndarray,
    seconds: float,
    hands: Sequence[HandMotion | None],
    free_cost_s: float = FREE_COST_S,
) -> np.ndarray:
    """Log-probabilities (M, K, L) of the same steps in each mode, of those between poses alone."""
    turn, shift = apart(mesh, before, after)
    moved = (turn / (MOVING_TURN_RAD_S * seconds)) ** 2 + (shift / (MOVING_M_S * seconds)) ** 2
    ways = [
        -0.5 * ((turn / STANDING_RAD) ** 2 + (shift / STANDING_M) ** 2),
        -np.minimum(0.5 * moved, JUMP_COST) - free_cost_s * min(seconds, FREE_LASTING_S),
        *(_held(mesh, before, after, seconds, hand) for hand in hands),
    ]
    return np.array(ways)


def _held(
    mesh: ObjectMesh, before: np.ndarray, after: np.ndarray, seconds: float, hand: HandMotion | None
) -> np.ndarray:
    """Log-probabilities (K, L) of steps with this hand."""
    if hand is None:
        return np.full((len(before), len(after)), -np.inf)
    turn, shift = apart(mesh, hand.carry(before), after)
    centres = np.array([mesh.centre_at(pose) for pose in before])
    turn_sigma = np.hypot(HELD_RAD, HELD_RAD_S * seconds)
    # an error of the hand's turn moves what is far from it
    arm = np.linalg.norm(centres - hand.start, axis=1)
    shift_sigma = np.sqrt(HELD_M**2 + (HELD_M_S * seconds) ** 2 + (arm * turn_sigma) ** 2)
    found = -0.5 * ((turn / turn_sigma) ** 2 + (shift / shift_sigma[:, None]) ** 2)
    found[~hand.reaches(centres, mesh.diameter / 2)] = -np.inf
    return found


def apart(mesh: ObjectMesh, before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
    """The log-probabilities of steps [T - 1] (M, M, K_t + 1, K_t+1 + 1), where going to a
    hypothesis that is out of reach, and coming back, each cost :data:`EXCURSION_COST` in addition;
    ``away`` [T] (K_t,) as of :func:`excursions`."""
    result = []
    for step, (before, after) in zip(steps, pairwise(away), strict=True):
        out, back = np.append(before, False), np.append(after, False)
        result.append(step - EXCURSION_COST * (out[:, None] != back))
    return result
