"""Steps of the joint fit: one frame that cannot descend does not stop the others."""

from __future__ import annotations

import weakref

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.minimise import minimise
from intercap_core.joint.state import ALL, OBJECT, State

FRAMES, BROKEN = 9, 4


def _state() -> State:
    return State(
        np.zeros((FRAMES, 168)),
        np.zeros(10),
        np.zeros((FRAMES, 10)),
        np.tile(Rotation.identity().as_matrix(), (FRAMES, 1, 1)),
        np.full((FRAMES, 3), 0.05),
    )


def _pulled_to_the_origin(lies: bool):
    """A quadratic energy of the object's place; in one frame its slope has the wrong sign."""

    def linearise(state: State) -> NormalEquations:
        equations = NormalEquations(len(state))
        offset = np.concatenate([np.zeros((FRAMES, 3)), state.translation], axis=1)
        gradient = offset.copy()
        if lies:
            gradient[BROKEN] *= -100
        matrix = np.tile(np.eye(6), (FRAMES, 1, 1))
        energy = 0.5 * (offset**2).sum(axis=1)
        equations.add_blocks("place", OBJECT, matrix, gradient, energy)
        body = slice(0, OBJECT.start)
        still = np.tile(np.eye(body.stop), (FRAMES, 1, 1))
        none = np.zeros((FRAMES, body.stop))
        equations.add_blocks("body", body, still, none, np.zeros(FRAMES))
        return equations

    return linearise


def test_a_frame_that_cannot_descend_is_held_and_the_others_go_on() -> None:
    whole = minimise(_pulled_to_the_origin(lies=False), _state(), max_steps=12)
    assert not whole.held.any() and whole.refused == 0
    found = minimise(_pulled_to_the_origin(lies=True), _state(), max_steps=12)
    far = np.linalg.norm(found.state.translation, axis=1)
    elsewhere = np.abs(np.arange(FRAMES) - BROKEN) > 1
    assert found.steps > 0 and found.held[BROKEN] and not found.held[elsewhere].any()
    assert far[elsewhere].max() < 0.001


def test_an_energy_that_is_no_number_in_a_frame_is_refused() -> None:
    honest = _pulled_to_the_origin(lies=False)

    def breaks(state: State) -> NormalEquations:
        equations = honest(state)
        if not np.allclose(state.translation[BROKEN], 0.05, atol=0.02):
            equations.energies["place"][BROKEN] = np.nan
        return equations

    found = minimise(breaks, _state(), max_steps=12)
    assert np.isfinite(found.equations.total) and found.steps > 0
    assert np.linalg.norm(found.state.translation[0]) < 0.001


def test_one_state_s_matrices_are_held_at_a_time() -> None:
    """Also after a step that was refused."""
    broken, made, most = _pulled_to_the_origin(lies=True), [], []

    def counted(state: State) -> NormalEquations:
        most.append(sum(seen().bands.size > 0 for seen in made if seen() is not None))
        equations = broken(state)
        made.append(weakref.ref(equations))
        return equations

    assert minimise(counted, _state(), max_steps=12).refused > 1
    assert max(most) == 0


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_a_few_frames_can_be_refused_too(frames: int) -> None:
    state = _state()
    few = State(
        state.body[:frames],
        state.betas,
        state.expression[:frames],
        state.rotation[:frames],
        state.translation[:frames],
    )

    def rises(at: State) -> NormalEquations:
        equations = NormalEquations(frames)
        offset = np.full((frames, ALL.stop), 0.1)
        energy = np.linalg.norm(at.translation - 0.05, axis=1) + 1.0
        matrix = np.tile(np.eye(ALL.stop), (frames, 1, 1))
        equations.add_blocks("any", ALL, matrix, offset, energy)
        return equations

    found = minimise(rises, few, max_steps=6)
    assert found.steps == 0 and found.refused > 0 and found.held.all()
