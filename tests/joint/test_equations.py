"""The joint fit's normal equations against dense ones, and the memory that they take."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from intercap_core.joint.equations import BandedEquations
from intercap_core.joint.state import ALL, OBJECT

POINTS = 4


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
def test_differences_over_frames_are_those_of_one_dense_jacobian(frames, stencil) -> None:
    """Some points have weight in a few frames alone."""
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


def test_what_is_stiff_is_not_damped() -> None:
    """Two frames tied together move on as one, however strong the damping is."""
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
    assert not equations.bands.size  # spent, so that two states' are never held at once


def test_equations_take_the_memory_of_their_bands() -> None:
    """Linear in the frames, and no more for the rows, which are made for a few frames at a time."""
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


def test_rows_are_made_for_what_has_weight_alone() -> None:
    asked: list[tuple[slice, list[int]]] = []

    def rows(at: slice, some: np.ndarray) -> np.ndarray:
        asked.append((at, some.tolist()))
        return np.ones((at.stop - at.start, len(some), 1, 6))

    weights = np.full((40, POINTS), 1e-15)
    weights[20, 2] = 1.0
    BandedEquations(40).add_rows("term", OBJECT, rows, weights, np.ones((40, POINTS, 1)))
    assert len(asked) == 1 and asked[0][1] == [2]
    assert asked[0][0].start <= 20 < asked[0][0].stop
