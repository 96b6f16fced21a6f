"""Steps of the joint fit: one frame that cannot descend does not stop the others."""

from __future__ import annotations

import weakref

import numpy as np
import pytest

from intercap_core.joint.equations import BandedEquations
from intercap_core.joint.minimise import minimise
from intercap_core.joint.state import ALL, OBJECT, State

FRAMES, BROKEN = 9, 4


def _state(frames: int = FRAMES) -> State:
    return State(
        np.zeros((frames, 168)), np.zeros(10), np.zeros((frames, 10)),
        np.tile(np.eye(3), (frames, 1, 1)), np.full((frames, 3), 0.05),
    )  # fmt: skip


def _pulled_to_the_origin(broken: bool):
    """A quadratic energy of the object's place; in one frame its gradient has the wrong sign."""

    def linearise(state: State) -> BandedEquations:
        equations = BandedEquations(len(state))
        offset = np.concatenate([np.zeros((FRAMES, 3)), state.translation], axis=1)
        gradient = offset.copy()
        if broken:
            gradient[BROKEN] *= -100
        matrix = np.tile(np.eye(6), (FRAMES, 1, 1))
        equations.add_blocks("place", OBJECT, matrix, gradient, 0.5 * (offset**2).sum(axis=1))
        equations.hold(slice(0, OBJECT.start))
        return equations

    return linearise


def test_a_frame_that_cannot_descend_stalls_alone() -> None:
    whole = minimise(_pulled_to_the_origin(broken=False), _state(), max_steps=12)
    assert not whole.stalled.any() and whole.refused == 0
    minimum = minimise(_pulled_to_the_origin(broken=True), _state(), max_steps=12)
    far = np.linalg.norm(minimum.state.translation, axis=1)
    elsewhere = np.abs(np.arange(FRAMES) - BROKEN) > 1
    assert minimum.steps > 0 and minimum.stalled[BROKEN] and not minimum.stalled[elsewhere].any()
    assert far[elsewhere].max() < 0.001


def test_a_step_to_an_energy_that_is_not_finite_is_refused() -> None:
    sound = _pulled_to_the_origin(broken=False)

    def breaks(state: State) -> BandedEquations:
        equations = sound(state)
        if not np.allclose(state.translation[BROKEN], 0.05, atol=0.02):
            equations.energies["place"][BROKEN] = np.nan
        return equations

    minimum = minimise(breaks, _state(), max_steps=12)
    assert np.isfinite(minimum.equations.total) and minimum.steps > 0
    assert np.linalg.norm(minimum.state.translation[0]) < 0.001


def test_matrices_of_one_state_are_kept_at_a_time() -> None:
    """Also after a refused step."""
    broken, made, most = _pulled_to_the_origin(broken=True), [], []

    def counted(state: State) -> BandedEquations:
        most.append(sum(ref().bands.size > 0 for ref in made if ref() is not None))
        equations = broken(state)
        made.append(weakref.ref(equations))
        return equations

    assert minimise(counted, _state(), max_steps=12).refused > 1
    assert max(most) == 0


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_short_recordings_can_stall(frames: int) -> None:
    def rises(at: State) -> BandedEquations:
        equations = BandedEquations(frames)
        energy = np.linalg.norm(at.translation - 0.05, axis=1) + 1.0
        matrix = np.tile(np.eye(ALL.stop), (frames, 1, 1))
        equations.add_blocks("any", ALL, matrix, np.full((frames, ALL.stop), 0.1), energy)
        return equations

    minimum = minimise(rises, _state(frames), max_steps=6)
    assert minimum.steps == 0 and minimum.refused > 0 and minimum.stalled.all()
