"""Levenberg-Marquardt over all frames at once, contact re-estimated between rounds."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from intercap_core.refine.equations import NormalEquations
from intercap_core.refine.state import State

log = logging.getLogger(__name__)

_DAMPING = 1e-3
_MAX_TURN, _MAX_SHIFT = 0.5, 0.1  # of one step: rad, metres
_CONVERGED = 2e-3  # relative decrease of the energy


@dataclass(frozen=True)
class Minimum:
    """Where the energy was left, the equations there, and the number of accepted steps."""

    state: State
    equations: NormalEquations
    steps: int


def minimise(
    linearise: Callable[[State], NormalEquations], state: State, *, max_steps: int
) -> Minimum:
    """Descend from ``state`` by at most ``max_steps`` steps, each accepted only if the energy,
    correspondences and visibility refreshed, becomes less."""
    damping, accepted = _DAMPING, 0
    here = linearise(state)
    for _ in range(max_steps):
        step = here.step(damping)
        if step is None:
            damping *= 10
            continue
        trial = state.moved(_limited(step))
        there = linearise(trial)
        log.info("energy %.4g -> %.4g (damping %.0e)", here.total, there.total, damping)
        if there.total >= here.total:
            damping *= 10
            continue
        decrease = (here.total - there.total) / max(here.total, 1e-12)
        state, here, accepted = trial, there, accepted + 1
        damping = max(damping / 5, 1e-6)
        if decrease < _CONVERGED:
            break
    return Minimum(state, here, accepted)


def _limited(step: np.ndarray) -> np.ndarray:
    """Keep every frame's step within what a linearisation can promise."""
    turns = np.abs(step[:, :165]).max(axis=1)
    turns = np.maximum(turns, np.abs(step[:, 168:171]).max(axis=1))
    shifts = np.maximum(np.abs(step[:, 165:168]).max(axis=1), np.abs(step[:, 171:]).max(axis=1))
    return step / np.maximum(1.0, np.maximum(turns / _MAX_TURN, shifts / _MAX_SHIFT))[:, None]
