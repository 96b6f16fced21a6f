"""Levenberg-Marquardt over all frames at once, contact re-estimated between rounds."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.state import BODY_SHIFT, BODY_TURNS, OBJECT_SHIFT, OBJECT_TURN, State

# Damping of Levenberg-Marquardt, share of the diagonal. Tuned on the studio.
INITIAL_DAMPING = 1e-3
MIN_DAMPING = 1e-6
# A frame that ends with more hardly moves any more. Tuned on the studio.
HELD_DAMPING = 0.5
DAMPING_UP, DAMPING_DOWN = 10.0, 5.0  # factors after a rejected and an accepted step
# Largest change in one step, rad and metres: beyond it a linearisation of skinning is poor.
# Tuned on the studio.
MAX_STEP_TURN = 0.5
MAX_STEP_SHIFT = 0.1
# A step that gains less than this share of what the round has gained ends it. Tuned on the studio.
MIN_GAIN_SHARE = 0.03
# A refused step that would have gained less than this share of the energy, by its slope: the fit is
# at a minimum. Tuned on the studio.
NEGLIGIBLE_SHARE = 1e-3

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Minimum:
    """The final state, the equations there, the energy of each term at the start, the numbers of
    accepted ``steps`` and of ``refused`` ones, whether the last one gained little or would have,
    and the frames (T,) that were ``held``: whatever would have moved them raised the energy."""

    state: State
    equations: NormalEquations
    energy_before: dict[str, float]
    steps: int
    refused: int
    converged: bool
    held: np.ndarray


def minimise(
    linearise: Callable[[State], NormalEquations],
    state: State,
    *,
    max_steps: int,
) -> Minimum:
    """Try at most ``max_steps`` steps from ``state``, each accepted only if it lowers the energy.

    Every frame has its own damping, which grows where the energy of a refused step rose, so that a
    frame or a term that is badly linearised holds up its neighbourhood alone. Progress is measured
    against the round's own, since most of the energy is noise that no state explains. Refused steps
    are rare, so equations are made anew after one rather than kept for it.
    """
    accepted, refused, gained, converged = 0, 0, 0.0, False
    damping, moved = np.full(len(state), INITIAL_DAMPING), np.zeros(len(state), bool)
    here = linearise(state)
    before = here.energy
    for _ in range(max_steps):
        step = here.step(damping)
        if step is None:
            damping, refused = damping * DAMPING_UP, refused + 1
            here = linearise(state)
            continue
        trial = state.moved(limited(step))
        there = linearise(trial)
        log.info(
            "energy %.4g -> %.4g (damping %.0e to %.0e)",
            here.total,
            there.total,
            damping.min(),
            damping.max(),
        )
        if not there.total < here.total:
            rose, tried = _risen(there.by_frame - here.by_frame), damping
            damping, refused = np.where(rose, damping * DAMPING_UP**2, damping), refused + 1
            # of a quadratic energy, half of what its slope promises; nothing where damped much
            promised = -0.5 * float((here.gradient * step).sum())
            if promised < NEGLIGIBLE_SHARE * here.total and tried.max() < HELD_DAMPING:
                converged = True
                break
            del there  # two states' equations are never held at once
            here = linearise(state)
            continue
        gain = here.total - there.total
        gained += gain
        state, here, accepted = trial, there, accepted + 1
        moved |= damping < HELD_DAMPING
        damping = np.maximum(damping / DAMPING_DOWN, MIN_DAMPING)
        if gain < MIN_GAIN_SHARE * gained:
            converged = True
            break
    held = (damping >= HELD_DAMPING) & ~moved
    return Minimum(state, here, before, accepted, refused, converged, held)


def _risen(change: np.ndarray) -> np.ndarray:
    """Frames (T,) bool around which the energy rose by ``change`` (T,), or is no number; all of
    them where it rose nowhere in particular."""
    around = np.convolve(np.nan_to_num(change, nan=np.inf), np.ones(3))[1:-1]
    rose = ~(around <= 0)
    return rose if rose.any() else np.ones(len(change), bool)


def limited(step: np.ndarray) -> np.ndarray:
    """Limit every frame's step to the range in which the linearisation holds."""

    def largest(*columns: slice) -> np.ndarray:
        return np.maximum.reduce([np.abs(step[:, part]).max(axis=1) for part in columns])

    turns, shifts = largest(BODY_TURNS, OBJECT_TURN), largest(BODY_SHIFT, OBJECT_SHIFT)
    excess = np.maximum(turns / MAX_STEP_TURN, shifts / MAX_STEP_SHIFT)
    return step / np.maximum(1.0, excess)[:, None]
