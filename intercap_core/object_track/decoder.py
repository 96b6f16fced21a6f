"""Which hypothesis is true in every frame: a hidden Markov model over all frames.

The states of a frame are its hypotheses and, last, that none of them is true: the object is hidden,
or it has left. Probabilities come from the forward-backward algorithm, the most likely sequence
from that of Viterbi (Rabiner, Proceedings of the IEEE 77(2), 1989).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.special import logsumexp

from intercap_core.object_track.constants import (
    APPEAR_COST,
    EXCURSION_COST,
    JUMP_COST,
    LEAVE_COST,
    MOVING_M_S,
    MOVING_TURN_RAD_S,
    REACH_M,
    REACH_M_S,
    VANISH_COST,
)
from intercap_core.rigid.mesh import ObjectMesh

NOT_SEEN = -1
_CERTAIN = 1e4  # nats: far more than all frames say


@dataclass(frozen=True)
class Decoded:
    """``path`` (T,) the index of the most likely hypothesis, :data:`NOT_SEEN` where none is true;
    ``probability`` [T] of each hypothesis and, last, of none, given all frames; ``gone`` (T,), of
    the object having left; ``evidence``, the log-likelihood of all frames, against that it is in
    none."""

    path: np.ndarray
    probability: list[np.ndarray]
    gone: np.ndarray
    evidence: float


def decode(
    emissions: Sequence[np.ndarray], steps: Sequence[np.ndarray], absent: float = 0.0
) -> Decoded:
    """The model's states of T frames.

    ``emissions`` [T] (K_t,) log-likelihoods of the hypotheses, against that none is true; ``steps``
    [T - 1] (K_t + 1, K_t+1 + 1) log-probabilities of going from one state to the next. Where none
    is true the object is hidden, or it has left, which costs more at either end and ``absent`` nats
    a frame less: what is in the room is seldom hidden from all cameras for long.
    """
    values = [np.append(own, [0.0, absent]) for own in emissions]
    for end in (0, -1):
        values[end][-1] -= LEAVE_COST
    ways = [_with_leaving(step) for step in steps]
    best, ahead, came = [values[0]], [values[0]], []
    for step, value in zip(ways, values[1:], strict=True):
        reach = best[-1][:, None] + step
        came.append(reach.argmax(0))
        best.append(reach.max(0) + value)
        ahead.append(logsumexp(ahead[-1][:, None] + step, axis=0) + value)
    behind = [np.zeros(len(values[-1]))]
    for step, value in zip(reversed(ways), reversed(values[1:]), strict=True):
        behind.append(logsumexp(step + (behind[-1] + value), axis=1))
    chosen = [int(best[-1].argmax())]
    for back in reversed(came):
        chosen.append(int(back[chosen[-1]]))
    path = np.array(chosen[::-1])
    path[path >= [len(own) for own in emissions]] = NOT_SEEN
    log = [a + b for a, b in zip(ahead, reversed(behind), strict=True)]
    shares = [np.exp(one - logsumexp(one)) for one in log]
    return Decoded(
        path,
        [np.append(own[:-2], own[-2] + own[-1]) for own in shares],
        np.array([own[-1] for own in shares]),
        float(logsumexp(ahead[-1])),
    )


def _with_leaving(step: np.ndarray) -> np.ndarray:
    """Log-probabilities (K + 2, L + 2) with "gone" as one more state, from those without it."""
    count, following = step.shape
    ways = np.empty((count + 1, following + 1))
    ways[:-1, :-1] = step
    ways[:-1, -1] = step[:, -1] - LEAVE_COST
    ways[-1, :-1] = step[-1] - LEAVE_COST
    ways[-1, -1] = 0.0
    return ways


def given(
    emissions: Sequence[np.ndarray],
    steps: Sequence[np.ndarray],
    frame: int,
    state: int,
    absent: float = 0.0,
) -> Decoded:
    """:func:`decode`, given the state of one frame: one of its hypotheses."""
    known = list(emissions)
    known[frame] = np.full(len(known[frame]), -_CERTAIN)
    known[frame][state] = emissions[frame][state] + _CERTAIN
    found = decode(known, steps, absent)
    return replace(found, evidence=found.evidence - _CERTAIN)


def mixed(found: Sequence[Decoded]) -> Decoded:
    """What follows from several that exclude each other, by their evidence."""
    evidence = np.array([one.evidence for one in found])
    share = np.exp(evidence - logsumexp(evidence))
    probability = [
        np.einsum("n,nk->k", share, np.array(every))
        for every in zip(*(one.probability for one in found), strict=True)
    ]
    gone = share @ np.array([one.gone for one in found])
    path = found[int(share.argmax())].path
    return Decoded(path, probability, gone, float(logsumexp(evidence)))


def step_costs(
    mesh: ObjectMesh,
    before: np.ndarray,
    after: np.ndarray,
    seconds: float,
    carried: np.ndarray,
) -> np.ndarray:
    """Log-probabilities (K + 1, L + 1) of the steps from poses ``before`` (K, 4, 4) to ``after``
    (L, 4, 4), up to a constant.

    The object rests, moves as one of the hands does, by ``carried`` (H, 3) metres in these
    ``seconds``, or freely; a step that is none of these is a fault of the track before or after.
    """
    costs = np.zeros((len(before) + 1, len(after) + 1))
    costs[:-1, -1], costs[-1, :-1] = -VANISH_COST, -APPEAR_COST
    if len(before) and len(after):
        turn = np.radians(
            mesh.symmetry.rotation_error_deg(before[:, None, :3, :3], after[None, :, :3, :3])
        )
        centres = [
            poses[:, :3, :3] @ mesh.centre_of_mass + poses[:, :3, 3] for poses in (before, after)
        ]
        shift = centres[1][None] - centres[0][:, None]
        ways = np.concatenate([np.zeros((1, 3)), carried])
        shift_m = np.linalg.norm(shift[..., None, :] - ways, axis=-1).min(-1)
        size = (turn / (MOVING_TURN_RAD_S * seconds)) ** 2 + (shift_m / (MOVING_M_S * seconds)) ** 2
        costs[:-1, :-1] = -np.minimum(0.5 * size, JUMP_COST)
    return costs


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
