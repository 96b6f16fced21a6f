"""Block-banded systems against dense solves."""

from __future__ import annotations

import pytest
import torch

from intercap_core.solve.banded import BandedSystem, CoupledEquations, minimise_coupled


def _system(bandwidth: int, frames: int = 7, n: int = 4, shared: int = 0) -> BandedSystem:
    """J^T J of random residuals, each touching up to w + 1 neighbouring frames."""
    generator = torch.Generator().manual_seed(bandwidth * 10 + shared)
    size = frames * n + shared
    full = 0.1 * torch.eye(size, dtype=torch.float64)
    for t in range(frames - bandwidth):
        j = torch.zeros(2 * n, size, dtype=torch.float64)
        width = (bandwidth + 1) * n
        j[:, t * n : t * n + width] = torch.randn(
            2 * n, width, dtype=torch.float64, generator=generator
        )
        if shared:
            j[:, frames * n :] = torch.randn(
                2 * n, shared, dtype=torch.float64, generator=generator
            )
        full += j.T @ j
    bands = torch.zeros(bandwidth + 1, frames, n, n, dtype=torch.float64)
    for k in range(bandwidth + 1):
        for t in range(frames - k):
            bands[k, t] = full[(t + k) * n : (t + k + 1) * n, t * n : (t + 1) * n]
    if not shared:
        return BandedSystem(bands)
    border = full[frames * n :, : frames * n].reshape(shared, frames, n).transpose(0, 1)
    return BandedSystem(bands, border, full[frames * n :, frames * n :])


CASES = [(0, 0), (1, 0), (2, 0), (3, 0), (0, 3), (1, 3), (2, 3)]


@pytest.mark.parametrize(("bandwidth", "shared"), CASES)
def test_solution_matches_the_dense_solve(bandwidth: int, shared: int) -> None:
    system = _system(bandwidth, shared=shared)
    dense = system.dense()
    torch.testing.assert_close(dense, dense.T)
    right = torch.randn(len(dense), dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    factor = system.factorise()
    assert factor is not None
    x, y = factor.solve(right[:28].reshape(7, 4), right[28:] if shared else None)
    found = x.reshape(-1) if y is None else torch.cat([x.reshape(-1), y])
    torch.testing.assert_close(found, torch.linalg.solve(dense, right), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize(("bandwidth", "shared"), CASES)
def test_covariance_is_the_inverse_s_diagonal_blocks(bandwidth: int, shared: int) -> None:
    system = _system(bandwidth, shared=shared)
    inverse = torch.linalg.inv(system.dense())
    factor = system.factorise()
    assert factor is not None
    for t, found in enumerate(factor.covariance()):
        at = slice(4 * t, 4 * t + 4)
        torch.testing.assert_close(found, inverse[at, at], rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize(("bandwidth", "shared"), [(0, 0), (2, 0), (1, 2)])
def test_an_indefinite_matrix_has_no_factor(bandwidth: int, shared: int) -> None:
    system = _system(bandwidth, shared=shared)
    system.bands[0, 3] -= 1e4 * torch.eye(4, dtype=torch.float64)
    assert system.factorise() is None


def test_shapes_are_checked() -> None:
    with pytest.raises(ValueError, match="expected"):
        BandedSystem(torch.zeros(2, 5, 3, 4))
    with pytest.raises(ValueError, match="together"):
        BandedSystem(torch.zeros(1, 5, 3, 3), border=torch.zeros(5, 2, 3))


def test_a_coupled_nonlinear_problem_reaches_the_known_minimum() -> None:
    """Smooth circles of a shared radius through exact data: angles and radius come back."""
    frames = 40
    angle = torch.linspace(0, 2.0, frames, dtype=torch.float64)
    data = 1.7 * torch.stack([angle.cos(), angle.sin()], 1)

    def residuals(own: torch.Tensor, shared: torch.Tensor) -> torch.Tensor:
        return shared * torch.stack([own[:, 0].cos(), own[:, 0].sin()], 1) - data

    def smooth(own: torch.Tensor) -> torch.Tensor:
        return 0.3 * (own[2:, 0] - 2 * own[1:-1, 0] + own[:-2, 0])

    def cost(own: torch.Tensor, shared: torch.Tensor) -> float:
        return 0.5 * float((residuals(own, shared) ** 2).sum() + (smooth(own) ** 2).sum())

    def linearise(own: torch.Tensor, shared: torch.Tensor) -> CoupledEquations:
        r, a = residuals(own, shared), own[:, 0]
        by_angle = shared * torch.stack([-a.sin(), a.cos()], 1)
        by_radius = torch.stack([a.cos(), a.sin()], 1)
        bands = torch.zeros(3, frames, 1, 1, dtype=torch.float64)
        bands[0, :, 0, 0] = (by_angle**2).sum(1)
        gradient = (by_angle * r).sum(1, keepdim=True)
        row, s = 0.3 * torch.tensor([1.0, -2, 1]).double(), smooth(own)
        for k in range(3):
            for i in range(3 - k):
                bands[k, i : i + frames - 2, 0, 0] += row[i] * row[i + k]
            gradient[k : k + frames - 2, 0] += row[k] * s
        border = (by_angle * by_radius).sum(1)[:, None, None]
        corner = (by_radius**2).sum()[None, None]
        shared_gradient = (by_radius * r).sum()[None]
        return CoupledEquations(
            cost(own, shared), gradient, shared_gradient, BandedSystem(bands, border, corner)
        )

    start = angle[:, None] + 0.4 * torch.sin(5 * angle[:, None])
    own, shared, value, _ = minimise_coupled(
        linearise, cost, start, torch.ones(1).double(), cost_tolerance=1e-14
    )
    assert value < 1e-12
    torch.testing.assert_close(own[:, 0], angle, atol=1e-5, rtol=0)
    torch.testing.assert_close(shared, torch.tensor([1.7]).double(), atol=1e-5, rtol=0)
