"""Normal equations of the joint fit against dense ones, their memory, and the steps of the fit."""

from __future__ import annotations

import tracemalloc
import weakref
from collections.abc import Callable

import numpy as np
import pytest

from intercap_core.joint.equations import BandedEquations
from intercap_core.joint.minimise import minimise
from intercap_core.joint.state import ALL, OBJECT, State

POINTS = 4
FRAMES, BROKEN = 9, 4


def _dense(equations: BandedEquations) -> np.ndarray:
    width, frames, size, _ = equations.bands.shape
    full = np.zeros((frames, size, frames, size))
    for k in range(width):
        for t in range(frames - k):
            full[t + k, :, t] = equations.bands[k, t]
            full[t, :, t + k] = equations.bands[k, t].T
    return full.reshape(frames * size, -1)


@pytest.mark.parametrize("stencil", [(1.0,), (-1.0, 1.0), (1.0, -2.0, 1.0)])
@pytest.mark.parametrize("frames", [1, 2, 5, 12])
def test_rows_over_frames_equal_a_dense_jacobian(frames, stencil):
    """Some points have weight in few frames."""
    rng = np.random.default_rng(frames)
    columns, steps = OBJECT, max(frames + 1 - len(stencil), 0)
    values = rng.normal(size=(frames, POINTS, 3, 6))
    weights = rng.random((steps, POINTS)) * (rng.random((steps, POINTS)) > 0.5)
    residuals = rng.normal(size=(steps, POINTS, 3))
    equations = BandedEquations(frames)
    equations.add_rows(
        "term", columns, lambda at, some: values[at, some], weights, residuals, stencil=stencil
    )
    jacobian = np.zeros((steps, POINTS, 3, frames, ALL.stop))
    for t in range(steps):
        for k, factor in enumerate(stencil):
            jacobian[t, :, :, t + k, columns] = factor * values[t + k]
    rows = jacobian.reshape(steps * POINTS * 3, frames * ALL.stop)
    weight = np.repeat(weights.ravel(), 3)
    np.testing.assert_allclose(_dense(equations), (rows.T * weight) @ rows, atol=1e-12)
    slope = (rows.T * weight) @ residuals.ravel()
    np.testing.assert_allclose(equations.gradient.ravel(), slope, atol=1e-12)
    np.testing.assert_allclose(equations.damped.ravel(), (rows**2).T @ weight, atol=1e-12)
    assert equations.total == pytest.approx(0.5 * float(weight @ residuals.ravel() ** 2))


def test_stiff_rows_are_not_damped():
    """Two tied frames move together, however strong the damping is."""
    equations = BandedEquations(2)
    values = np.broadcast_to(np.eye(ALL.stop), (2, 1, ALL.stop, ALL.stop))
    for stiff, stencil, weight in ((False, (1.0,), 1.0), (True, (-1.0, 1.0), 1e8)):
        count = 3 - len(stencil)
        equations.add_rows(
            "term",
            ALL,
            lambda at, some: values[at, some],
            np.full((count, 1), weight),
            np.ones((count, 1, ALL.stop)) * (not stiff),
            stencil=stencil,
            stiff=stiff,
        )
    step = equations.step(np.ones(2))
    assert step is not None
    np.testing.assert_allclose(step, -0.5, rtol=1e-6)
    assert not equations.bands.size  # a step consumes them


def test_equations_take_the_memory_of_their_bands():
    """Memory is linear in the frames; rows, computed for few frames at a time, need no more."""
    used = {}
    for frames in (50, 100):
        tracemalloc.start()
        equations = BandedEquations(frames)
        equations.add_rows(
            "term",
            ALL,
            lambda at, some: np.ones((at.stop - at.start, len(some), 3, ALL.stop)),
            np.ones((frames - 1, 50)),
            np.ones((frames - 1, 50, 3)),
            stencil=(-1.0, 1.0),
            stiff=True,
        )
        used[frames] = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    per_frame = (used[100] - used[50]) / 50
    assert per_frame < 1.1 * 3 * ALL.stop**2 * 8


def test_rows_are_computed_only_for_values_with_weight():
    asked: list[tuple[slice, list[int]]] = []

    def rows(at: slice, some: np.ndarray) -> np.ndarray:
        asked.append((at, some.tolist()))
        return np.ones((at.stop - at.start, len(some), 1, 6))

    weights = np.full((40, POINTS), 1e-15)
    weights[20, 2] = 1.0
    BandedEquations(40).add_rows("term", OBJECT, rows, weights, np.ones((40, POINTS, 1)))
    assert len(asked) == 1 and asked[0][1] == [2]
    assert asked[0][0].start <= 20 < asked[0][0].stop


# --- steps


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


class _Energy:
    """A problem whose equations are those of a function."""

    def __init__(self, linearise: Callable[[State], BandedEquations]) -> None:
        self.equations = linearise

    def energies(self, state: State) -> BandedEquations:
        """The energies of the equations, without matrices."""
        energies = BandedEquations(len(state), energies_only=True)
        energies.energies = self.equations(state).energies
        return energies


def test_frame_that_cannot_descend_stalls_alone():
    sound = minimise(_Energy(_pulled_to_the_origin(broken=False)), _state(), max_steps=12)
    assert not sound.stalled.any() and sound.refused == 0
    minimum = minimise(_Energy(_pulled_to_the_origin(broken=True)), _state(), max_steps=12)
    far = np.linalg.norm(minimum.state.translation, axis=1)
    elsewhere = np.abs(np.arange(FRAMES) - BROKEN) > 1
    assert minimum.steps > 0 and minimum.stalled[BROKEN] and not minimum.stalled[elsewhere].any()
    assert far[elsewhere].max() < 0.001


def test_step_to_a_non_finite_energy_is_refused():
    sound = _pulled_to_the_origin(broken=False)

    def breaks(state: State) -> BandedEquations:
        equations = sound(state)
        if not np.allclose(state.translation[BROKEN], 0.05, atol=0.02):
            equations.energies["place"][BROKEN] = np.nan
        return equations

    minimum = minimise(_Energy(breaks), _state(), max_steps=12)
    assert np.isfinite(minimum.energies["place"]).all() and minimum.steps > 0
    assert np.linalg.norm(minimum.state.translation[0]) < 0.001


def test_matrices_of_two_states_are_never_kept():
    """Also after a refused step."""
    broken, made, most = _pulled_to_the_origin(broken=True), [], []

    def counted(state: State) -> BandedEquations:
        most.append(sum(ref().bands.size > 0 for ref in made if ref() is not None))
        equations = broken(state)
        made.append(weakref.ref(equations))
        return equations

    assert minimise(_Energy(counted), _state(), max_steps=12).refused > 1
    assert max(most) == 0


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_short_recordings_can_stall(frames: int):
    def rises(at: State) -> BandedEquations:
        equations = BandedEquations(frames)
        energy = np.linalg.norm(at.translation - 0.05, axis=1) + 1.0
        matrix = np.tile(np.eye(ALL.stop), (frames, 1, 1))
        equations.add_blocks("any", ALL, matrix, np.full((frames, ALL.stop), 0.1), energy)
        return equations

    minimum = minimise(_Energy(rises), _state(frames), max_steps=6)
    assert minimum.steps == 0 and minimum.refused > 0 and minimum.stalled.all()
