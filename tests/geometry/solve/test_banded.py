"""Block-banded systems against dense solves."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.geometry.solve.banded import solve_banded

FRAMES, SIZE = 7, 4


def _system(
    bandwidth: int, reach: tuple[int, int, int, int] = (3, 3, 3, 3)
) -> tuple[np.ndarray, np.ndarray]:
    """J^T J of random residuals, each touching up to w + 1 neighbouring frames: bands and dense.

    Parameter i is coupled with at most ``reach[i]`` frames before and after.
    """
    rng = np.random.default_rng(bandwidth * 10)
    full = 0.1 * np.eye(FRAMES * SIZE)
    for width in range(1, bandwidth + 2):
        for t in range(FRAMES - width + 1):
            j = np.zeros((2 * SIZE, FRAMES, SIZE))
            j[:, t : t + width] = rng.standard_normal((2 * SIZE, width, SIZE))
            j[..., np.array(reach) < width - 1] = 0
            j = j.reshape(2 * SIZE, -1)
            full += j.T @ j
    blocks = full.reshape(FRAMES, SIZE, FRAMES, SIZE).transpose(0, 2, 1, 3)
    bands = np.zeros((bandwidth + 1, FRAMES, SIZE, SIZE))
    for k in range(bandwidth + 1):
        for t in range(FRAMES - k):
            bands[k, t] = blocks[t + k, t]
    return bands, full


@pytest.mark.parametrize("reach", [(3, 3, 3, 3), (2, 0, 1, 2), (1, 3, 0, 2), (0, 0, 0, 0)])
@pytest.mark.parametrize("bandwidth", [0, 1, 2, 3])
def test_solutions_match_the_dense_solve(bandwidth: int, reach: tuple[int, int, int, int]) -> None:
    bands, dense = _system(bandwidth, reach)
    np.testing.assert_allclose(dense, dense.T)
    right = np.random.default_rng(1).standard_normal((FRAMES, SIZE, 2))
    found = solve_banded(bands, right)
    assert found is not None
    expected = np.linalg.solve(dense, right.reshape(FRAMES * SIZE, 2))
    np.testing.assert_allclose(found.reshape(-1, 2), expected, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("bandwidth", [0, 1, 2])
def test_an_indefinite_matrix_has_no_solution(bandwidth: int) -> None:
    bands, _ = _system(bandwidth)
    bands[0, 3] -= 1e4 * np.eye(SIZE)
    assert solve_banded(bands, np.zeros((FRAMES, SIZE, 1))) is None


def test_shapes_are_checked() -> None:
    with pytest.raises(ValueError, match="expected"):
        solve_banded(np.zeros((2, 5, 3, 4)), np.zeros((5, 3, 1)))
