"""Block-banded systems against dense solves."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from intercap_core.geometry.solve.banded import BandedSystem

FRAMES, SIZE = 7, 4


def _system(bandwidth: int) -> tuple[BandedSystem, Tensor]:
    """J^T J of random residuals, each touching up to w + 1 neighbouring frames; and dense."""
    generator = torch.Generator().manual_seed(bandwidth * 10)
    full = 0.1 * torch.eye(FRAMES * SIZE, dtype=torch.float64)
    for t in range(FRAMES - bandwidth):
        j = torch.zeros(2 * SIZE, FRAMES * SIZE, dtype=torch.float64)
        width = (bandwidth + 1) * SIZE
        j[:, t * SIZE : t * SIZE + width] = torch.randn(
            2 * SIZE, width, dtype=torch.float64, generator=generator
        )
        full += j.T @ j
    blocks = full.reshape(FRAMES, SIZE, FRAMES, SIZE).transpose(1, 2)
    bands = torch.zeros(bandwidth + 1, FRAMES, SIZE, SIZE, dtype=torch.float64)
    for k in range(bandwidth + 1):
        for t in range(FRAMES - k):
            bands[k, t] = blocks[t + k, t]
    return BandedSystem(bands), full


@pytest.mark.parametrize("bandwidth", [0, 1, 2, 3])
def test_solution_matches_the_dense_solve(bandwidth: int) -> None:
    system, dense = _system(bandwidth)
    torch.testing.assert_close(dense, dense.T)
    right = torch.randn(len(dense), dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    factor = system.factorise()
    assert factor is not None
    found = factor.solve(right.reshape(FRAMES, SIZE)).reshape(-1)
    torch.testing.assert_close(found, torch.linalg.solve(dense, right), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("bandwidth", [0, 1, 2, 3])
def test_factorising_in_place_gives_the_same_factor(bandwidth: int) -> None:
    system, _ = _system(bandwidth)
    before = system.bands.clone()
    apart = system.factorise()
    assert apart is not None and torch.equal(system.bands, before)
    within = system.factorise(in_place=True)
    assert within is not None and within.lower.data_ptr() == system.bands.data_ptr()
    assert torch.equal(within.lower, apart.lower)


@pytest.mark.parametrize("bandwidth", [0, 1, 2])
def test_an_indefinite_matrix_has_no_factor(bandwidth: int) -> None:
    system, _ = _system(bandwidth)
    system.bands[0, 3] -= 1e4 * torch.eye(SIZE, dtype=torch.float64)
    assert system.factorise() is None


def test_shapes_are_checked() -> None:
    with pytest.raises(ValueError, match="expected"):
        BandedSystem(torch.zeros(2, 5, 3, 4))
