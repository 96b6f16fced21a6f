"""Levenberg-Marquardt over all frames at once, contact re-estimated between rounds."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from intercap_core.joint.constants import (
    DAMPING_DOWN,
    DAMPING_UP,
    INITIAL_DAMPING,
    MAX_STEP_SHIFT,
    MAX_STEP_TURN,
    MIN_DAMPING,
    MIN_GAIN_SHARE,
    NEGLIGIBLE_SHARE,
)
from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.state import (
    BODY_SHIFT,
    BODY_TURNS,
    OBJECT_SHIFT,
    OBJECT_TURN,
    State,
)

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Minimum:
    """The final state, the equations there, the energy of each term at the start, the numbers of
    accepted ``steps`` and of ``refused`` ones, and whether the last one gained little or would
    have."""

    state: State
    equations: NormalEquations
    energy_before: dict[str, float]
    steps: int
    refused: int
    converged: bool


def minimise(
    linearise: Callable[[State], NormalEquations],
    state: State,
    *,
    max_steps: int,
) -> Minimum:
    """Try at most ``max_steps`` steps from ``state``, each accepted only if it lowers the energy.

    Progress is measured against the round's own, since most of the energy is noise that no state
    explains.
    """
    damping, accepted, refused, gained, converged = INITIAL_DAMPING, 0, 0, 0.0, False
    here = linearise(state)
    before = here.energy
    for _ in range(max_steps):
        step = here.step(damping)
        if step is None:
            damping, refused = damping * DAMPING_UP, refused + 1
            continue
        trial = state.moved(limited(step))
        there = linearise(trial)
        log.info("energy %.4g -> %.4g (damping %.0e)", here.total, there.total, damping)
        if not there.total < here.total:
            damping, refused = damping * DAMPING_UP, refused + 1
            # of a quadratic energy, half of what its slope promises
            if -0.5 * float((here.gradient * step).sum()) < NEGLIGIBLE_SHARE * here.total:
                converged = True
                break
            continue
        gain = here.total - there.total
        gained += gain
        state, here, accepted = trial, there, accepted + 1
        damping = max(damping / DAMPING_DOWN, MIN_DAMPING)
        if gain < MIN_GAIN_SHARE * gained:
            converged = True
            break
    return Minimum(state, here, before, accepted, refused, converged)


def limited(step: np.ndarray) -> np.ndarray:
    """Limit every frame's step to the range in which the linearisation holds."""

    def largest(*columns: slice) -> np.ndarray:
        return np.maximum.reduce([np.abs(step[:, part]).max(axis=1) for part in columns])

    turns, shifts = largest(BODY_TURNS, OBJECT_TURN), largest(BODY_SHIFT, OBJECT_SHIFT)
    excess = np.maximum(turns / MAX_STEP_TURN, shifts / MAX_STEP_SHIFT)
    return step / np.maximum(1.0, excess)[:, None]
