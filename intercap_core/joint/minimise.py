"""Levenberg-Marquardt over all frames at once, contact re-estimated between rounds."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.state import State

log = logging.getLogger(__name__)

_DAMPING = 1e-3
_MAX_TURN, _MAX_SHIFT = 0.5, 0.1  # of one step: rad, metres
_CONVERGED = 0.03  # a step that gains less than this share of what the round has gained ends it


@dataclass(frozen=True)
class Minimum:
    """Where the energy was left, the equations there, the number of accepted steps, and whether
    the last one gained little."""

    state: State
    equations: NormalEquations
    steps: int
    converged: bool


def minimise(
    linearise: Callable[[State], NormalEquations], state: State, *, max_steps: int
) -> Minimum:
    """Descend from ``state`` by at most ``max_steps`` steps, each accepted only if the energy
    becomes less.

    Progress is measured against the round's own, since most of the energy is noise that no state
    explains.
    """
    damping, accepted, gained, converged = _DAMPING, 0, 0.0, False
    here = linearise(state)
    for _ in range(max_steps):
        step = here.step(damping)
        if step is None:
            damping *= 10
            continue
        trial = state.moved(_limited(step))
        there = linearise(trial)
        log.info("energy %.4g -> %.4g (damping %.0e)", here.total, there.total, damping)
        if not there.total < here.total:
            damping *= 10
            continue
        gain = here.total - there.total
        gained += gain
        state, here, accepted = trial, there, accepted + 1
        damping = max(damping / 5, 1e-6)
        if gain < _CONVERGED * gained:
            converged = True
            break
    return Minimum(state, here, accepted, converged)


def _limited(step: np.ndarray) -> np.ndarray:
    """Keep every frame's step within what a linearisation can promise."""
    turns = np.abs(step[:, :165]).max(axis=1)
    turns = np.maximum(turns, np.abs(step[:, 168:171]).max(axis=1))
    shifts = np.maximum(np.abs(step[:, 165:168]).max(axis=1), np.abs(step[:, 171:]).max(axis=1))
    return step / np.maximum(1.0, np.maximum(turns / _MAX_TURN, shifts / _MAX_SHIFT))[:, None]
