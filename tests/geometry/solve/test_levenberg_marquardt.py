"""Batched Levenberg-Marquardt: independent frames, tied frames, hard starts."""

from __future__ import annotations

import torch
from torch import Tensor

from intercap_core.geometry.solve import levenberg_marquardt
from intercap_core.geometry.solve.levenberg_marquardt import NormalEquations, minimise


class Rosenbrock:
    """f_b = ((x1 - x0^2)^2 * 100 + (1 - x0)^2) / 2, the classical bent valley; counts its work."""

    def __init__(self) -> None:
        self.linearised = 0

    def _residuals(self, x: Tensor) -> Tensor:
        return torch.stack([10 * (x[:, 1] - x[:, 0] ** 2), 1 - x[:, 0]], 1)

    def cost(self, own: Tensor, shared: Tensor, index: Tensor) -> Tensor:
        return 0.5 * (self._residuals(own) ** 2).sum(1)

    def linearise(self, own: Tensor, shared: Tensor, index: Tensor) -> NormalEquations:
        self.linearised += len(index)
        j = own.new_zeros(len(own), 2, 2)
        j[:, 0, 0], j[:, 0, 1], j[:, 1, 0] = -20 * own[:, 0], 10.0, -1.0
        r = self._residuals(own)
        return NormalEquations(
            0.5 * (r**2).sum(1), (j * r[..., None]).sum(1), j.transpose(1, 2) @ j
        )


class Exponentials:
    """y_b(t) = a_b exp(k t) with one k for all frames, weights that differ by frame."""

    def __init__(self, data: Tensor, times: Tensor, weights: Tensor) -> None:
        self.data, self.times, self.weights = data, times, weights

    def _parts(self, own: Tensor, shared: Tensor, index: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        e = (shared[0] * self.times).exp()[None]
        return own * e - self.data[index], e.expand(len(own), -1), own * e * self.times

    def cost(self, own: Tensor, shared: Tensor, index: Tensor) -> Tensor:
        r, _, _ = self._parts(own, shared, index)
        return 0.5 * self.weights[index] * (r**2).sum(1)

    def linearise(self, own: Tensor, shared: Tensor, index: Tensor) -> NormalEquations:
        r, ja, jk = self._parts(own, shared, index)
        j = torch.stack([ja, jk], 2)
        w = self.weights[index]
        return NormalEquations(
            0.5 * w * (r**2).sum(1),
            w[:, None] * (j * r[..., None]).sum(1),
            w[:, None, None] * (j.transpose(1, 2) @ j),
        )


def test_independent_frames_converge_separately() -> None:
    start = torch.tensor([[-1.2, 1.0], [1.0, 1.0], [3.0, -4.0], [0.0, 0.0]], dtype=torch.float64)
    problem = Rosenbrock()
    found = minimise(problem, start, max_trials=80, cost_tolerance=0, step_tolerance=1e-9)
    torch.testing.assert_close(found.own, torch.ones_like(start), atol=1e-6, rtol=0)
    assert bool(found.converged.all())
    assert problem.linearised < 3 * found.trials  # finished frames cost nothing more


def test_a_frame_does_not_depend_on_its_neighbours() -> None:
    start = torch.tensor([[-1.2, 1.0], [3.0, -4.0]], dtype=torch.float64)
    together = minimise(Rosenbrock(), start, max_trials=9).own
    alone = minimise(Rosenbrock(), start[1:], max_trials=9).own
    torch.testing.assert_close(together[1:], alone, atol=0, rtol=0)


def test_shared_parameter_is_found_with_the_frames() -> None:
    times = torch.linspace(0, 1, 12, dtype=torch.float64)
    a = torch.tensor([[0.5], [2.0], [-1.0]], dtype=torch.float64)
    problem = Exponentials(
        a * torch.exp(1.3 * times), times, torch.tensor([1.0, 4.0, 0.2]).double()
    )
    found = minimise(
        problem, torch.ones_like(a), torch.zeros(1).double(), max_trials=40, cost_tolerance=0
    )
    torch.testing.assert_close(found.own, a, atol=1e-7, rtol=0)
    torch.testing.assert_close(found.shared, torch.tensor([1.3]).double(), atol=1e-7, rtol=0)
    assert bool(found.converged.all())


def test_the_arrow_step_equals_the_dense_step() -> None:
    times = torch.linspace(0, 1, 6, dtype=torch.float64)
    a = torch.tensor([[0.5], [2.0], [-1.0]], dtype=torch.float64)
    problem = Exponentials(a * torch.exp(0.5 * times), times, torch.ones(3).double())
    own, shared = a + 0.05, torch.tensor([0.45]).double()  # so near that the full step is taken
    normal = problem.linearise(own, shared, torch.arange(3))
    dense = torch.zeros(4, 4, dtype=torch.float64)
    dense[:3, :3] = torch.diag(normal.hessian[:, 0, 0])
    dense[:3, 3] = dense[3, :3] = normal.hessian[:, 0, 1]
    dense[3, 3] = normal.hessian[:, 1, 1].sum()
    right = torch.cat([normal.gradient[:, 0], normal.gradient[:, 1].sum()[None]])
    expected = -torch.linalg.solve(dense, right)
    found = minimise(problem, own, shared, max_trials=1, damping=0.0)
    torch.testing.assert_close(found.own[:, 0], own[:, 0] + expected[:3], atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(found.shared, shared + expected[3:], atol=1e-6, rtol=1e-6)


def test_blocks_of_frames_give_the_same_result(monkeypatch) -> None:
    times = torch.linspace(0, 1, 12, dtype=torch.float64)
    a = torch.linspace(-2, 2, 7, dtype=torch.float64)[:, None]
    problem = Exponentials(a * torch.exp(1.3 * times), times, torch.linspace(0.2, 4, 7).double())
    y, valley = torch.zeros(1).double(), torch.linspace(-3, 3, 14).double().reshape(7, 2)
    results = []
    for frames, kept in ((128, 128), (3, 128), (3, 3)):
        monkeypatch.setattr(levenberg_marquardt, "BLOCK_FRAMES", frames)
        monkeypatch.setattr(levenberg_marquardt, "KEPT_FRAMES", kept)
        results.append(
            (
                minimise(problem, torch.ones_like(a), y, max_trials=5),
                minimise(Rosenbrock(), valley, max_trials=9),
            )
        )
    for whole, *others in zip(*results, strict=True):
        for blocks in others:
            torch.testing.assert_close(blocks.own, whole.own, atol=1e-9, rtol=0)
            torch.testing.assert_close(blocks.shared, whole.shared, atol=1e-9, rtol=0)
            torch.testing.assert_close(blocks.cost, whole.cost, atol=1e-9, rtol=1e-6)
            assert blocks.trials == whole.trials


def test_cost_never_rises_and_a_broken_frame_stays() -> None:
    class Broken(Rosenbrock):
        def linearise(self, own: Tensor, shared: Tensor, index: Tensor) -> NormalEquations:
            normal = super().linearise(own, shared, index)
            normal.hessian[index == 1] = -torch.eye(2, dtype=torch.float64)
            return normal

    start = torch.tensor([[-1.2, 1.0], [2.0, 2.0]], dtype=torch.float64)
    found = minimise(Broken(), start, max_trials=30)
    assert found.cost[0] < 1e-6
    torch.testing.assert_close(found.own[1], start[1], atol=0, rtol=0)
    assert not bool(found.converged[1])
