"""Levenberg-Marquardt over all frames at once, with a damping for each frame."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from intercap_core.body.parameters import TRANSL
from intercap_core.joint.problem import JointProblem
from intercap_core.joint.state import BODY_TURNS, OBJECT_SHIFT, OBJECT_TURN, State

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Minimum:
    """Result of one round of minimisation."""

    state: State  # Final state
    previous: State  # State before the last accepted step
    decrease: float  # Decrease of the energy by the last accepted step, as a share of the energy
    energies: dict[str, np.ndarray]  # (T,) of each term at the final state
    energies_before: dict[str, np.ndarray]  # (T,) of each term at the start
    steps: int  # Number of accepted steps
    refused: int  # Number of refused steps
    converged: bool  # Whether the last step gained little, or would have
    stalled: np.ndarray  # (T,) frames that no step moved, since each raised the energy there


def minimise(problem: JointProblem, state: State, *, max_steps: int) -> Minimum:
    """Accept at most ``max_steps`` steps from ``state``, those that lower the energy.

    Steps are tried twice as often at most.

    Each frame has its own damping, which grows if the energy rose there in a refused step: a badly
    linearised frame slows down its neighbourhood alone. The round has converged if a step lowers
    the energy by less than 3 % of what all its steps have gained, since most of the energy is
    noise; or if a refused step would have gained less than 0.1 % of the energy. Dampings, factors
    and tolerances are tuned on the studio.
    """
    stalling = 0.5  # damping with which a frame hardly moves, share of the diagonal
    accepted, refused, gained, converged = 0, 0, 0.0, False
    damping, moved = np.full(len(state), 1e-3), np.zeros(len(state), bool)
    previous, decrease = state, 0.0
    here = problem.equations(state)
    before = here.energies
    for _ in range(2 * max_steps):
        if accepted == max_steps:
            break
        if here.is_spent:
            here = problem.equations(state)
        step = here.step(damping)
        if step is None:
            damping, refused = damping * 10.0, refused + 1
            continue
        trial = state.moved(limited(step))
        there = problem.energies(trial)
        bounds = damping.min(), damping.max()
        log.info("energy %.4g -> %.4g (damping %.0e to %.0e)", here.total, there.total, *bounds)
        if not there.total < here.total:
            rose, tried = _risen(there.by_frame - here.by_frame), damping
            damping, refused = np.where(rose, damping * 100.0, damping), refused + 1
            # a quadratic energy falls by half of what its slope promises, by less if damped
            promised = -0.5 * float((here.gradient * step).sum())
            if promised < 1e-3 * here.total and tried.max() < stalling:
                converged = True
                break
            continue
        gain = here.total - there.total
        gained += gain
        previous, decrease = state, gain / here.total
        state, here, accepted = trial, there, accepted + 1
        moved |= damping < stalling
        damping = np.maximum(damping / 5.0, 1e-6)
        if gain < 0.03 * gained:
            converged = True
            break
    stalled = (damping >= stalling) & ~moved
    return Minimum(
        state, previous, decrease, here.energies, before, accepted, refused, converged, stalled
    )


def _risen(change: np.ndarray) -> np.ndarray:
    """Mask (T,) of frames t for which the energy of frames t - 1 to t + 1 rose or is not finite.

    ``change`` (T,) is the energy after a step minus the one before. The mask contains all frames if
    none rose.
    """
    around = np.convolve(np.nan_to_num(change, nan=np.inf), np.ones(3))[1:-1]
    rose = ~(around <= 0)
    return rose if rose.any() else np.ones(len(change), bool)


def limited(step: np.ndarray) -> np.ndarray:
    """Scale each frame's step (T, 174) down to at most 0.5 rad and 0.1 m (tuned on the studio).

    Beyond that the linearisation of skinning is poor.
    """

    def largest(*columns: slice) -> np.ndarray:
        return np.maximum.reduce([np.abs(step[:, part]).max(axis=1) for part in columns])

    turns, shifts = largest(BODY_TURNS, OBJECT_TURN), largest(TRANSL, OBJECT_SHIFT)
    excess = np.maximum(turns / 0.5, shifts / 0.1)
    return step / np.maximum(1.0, excess)[:, None]
