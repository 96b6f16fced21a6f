"""Exact solves of normal equations that couple neighbouring frames, in blocks.

A system of T frames with n parameters each, where frame t meets frames up to t + w (w = 0 none,
1 velocity, 2 acceleration), and m parameters shared by all:

    | A    B^T |   | x |   | g |        A block-banded (T n x T n), symmetric positive definite
    | B    C   | . | y | = | c |        B (m x T n), C (m x m)

Block Cholesky over time and a Schur complement for the shared part: O(T (w + 1)^2 n^3) work and
O(T (w + 1) n^2) memory.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class BandedSystem:
    """Blocks of a symmetric matrix.

    bands (w+1, T, n, n): ``bands[k, t]`` is block (t + k, t), rows of frame t + k, columns of
    frame t; ``bands[0]`` is symmetric, and the last k entries of ``bands[k]`` are not read.
    border (T, m, n) and corner (m, m): the shared parameters' rows, or None without any.
    """

    bands: Tensor
    border: Tensor | None = None
    corner: Tensor | None = None

    def __post_init__(self) -> None:
        w1, t, n, n2 = self.bands.shape
        if n != n2 or w1 > t:
            raise ValueError(f"bands have shape {tuple(self.bands.shape)}, expected (w+1, T, n, n)")
        if (self.border is None) != (self.corner is None):
            raise ValueError("border and corner come together")
        if self.border is not None and self.border.shape[::2] != (t, n):
            raise ValueError(f"border has shape {tuple(self.border.shape)}, expected ({t}, m, {n})")

    @property
    def num_shared(self) -> int:
        return 0 if self.corner is None else self.corner.shape[0]

    def dense(self) -> Tensor:
        """The whole matrix (T n + m, T n + m); for tests and small systems."""
        w1, t, n, _ = self.bands.shape
        m = self.num_shared
        full = self.bands.new_zeros(t * n + m, t * n + m)
        for k in range(w1):
            for i in range(t - k):
                rows, columns = slice((i + k) * n, (i + k + 1) * n), slice(i * n, (i + 1) * n)
                full[rows, columns] = self.bands[k, i]
                full[columns, rows] = self.bands[k, i].T
        if self.border is not None and self.corner is not None:
            b = self.border.transpose(0, 1).reshape(m, t * n)
            full[t * n :, : t * n], full[: t * n, t * n :] = b, b.T
            full[t * n :, t * n :] = self.corner
        return full

    def damped(self, damping: float) -> BandedSystem:
        """The matrix with its diagonal times 1 + damping (Marquardt 1963)."""
        bands = self.bands.clone()
        bands[0].diagonal(dim1=1, dim2=2).mul_(1 + damping)
        corner = self.corner
        if corner is not None:
            corner = corner.clone()
            corner.diagonal().mul_(1 + damping)
        return BandedSystem(bands, self.border, corner)

    def factorise(self) -> BandedFactor | None:
        """The Cholesky factor, or None where the matrix is not positive definite."""
        bands = self.bands
        w1, count = bands.shape[:2]
        lower = torch.zeros_like(bands)
        if w1 == 1:
            lower[0], info = torch.linalg.cholesky_ex(bands[0])
            return None if bool(info.any()) else self._with_corner(lower)
        for t in range(count):
            # lower[k, t - k] is block (t, t - k); finish row t from its farthest column on
            for k in range(min(w1 - 1, t), 0, -1):
                block = bands[k, t - k]
                for j in range(k + 1, min(w1 - 1, t) + 1):
                    block = block - lower[j, t - j] @ lower[j - k, t - j].T
                lower[k, t - k] = torch.linalg.solve_triangular(
                    lower[0, t - k].T, block, upper=True, left=False
                )
            block = bands[0, t]
            for k in range(1, min(w1 - 1, t) + 1):
                block = block - lower[k, t - k] @ lower[k, t - k].T
            lower[0, t], info = torch.linalg.cholesky_ex(block)
            if bool(info):
                return None
        return self._with_corner(lower)

    def _with_corner(self, lower: Tensor) -> BandedFactor | None:
        factor = BandedFactor(lower)
        if self.border is None or self.corner is None:
            return factor
        back = factor.solve_frames(self.border.transpose(1, 2))
        schur = self.corner - torch.einsum("tmn,tnk->mk", self.border, back)
        schur_factor, info = torch.linalg.cholesky_ex(schur)
        return None if bool(info) else BandedFactor(lower, self.border, back, schur_factor)


@dataclass(frozen=True)
class BandedFactor:
    """lower (w+1, T, n, n): the factor's blocks, laid out as `BandedSystem.bands`.

    border (T, m, n), back (T, n, m) = A^-1 B^T and schur (m, m), the Cholesky factor of the Schur
    complement; None without shared parameters.
    """

    lower: Tensor
    border: Tensor | None = None
    back: Tensor | None = None
    schur: Tensor | None = None

    def solve_frames(self, right: Tensor) -> Tensor:
        """A^-1 right for right (T, n, r), the shared parameters left out."""
        lower = self.lower
        w1, count = lower.shape[:2]
        if w1 == 1:
            return torch.cholesky_solve(right, lower[0])
        x = right.clone()
        for t in range(count):
            for k in range(1, min(w1 - 1, t) + 1):
                x[t] -= lower[k, t - k] @ x[t - k]
            x[t] = torch.linalg.solve_triangular(lower[0, t], x[t], upper=False)
        for t in reversed(range(count)):
            for k in range(1, min(w1 - 1, count - 1 - t) + 1):
                x[t] -= lower[k, t].T @ x[t + k]
            x[t] = torch.linalg.solve_triangular(lower[0, t].T, x[t], upper=True)
        return x

    def solve(self, right: Tensor, shared: Tensor | None = None) -> tuple[Tensor, Tensor | None]:
        """x (T, n) and y (m,) of the system for right (T, n) and shared (m,)."""
        x = self.solve_frames(right[..., None])[..., 0]
        if self.border is None or self.back is None or self.schur is None:
            return x, None
        if shared is None:
            raise ValueError("the system has shared parameters: give their right-hand side")
        rest = shared - torch.einsum("tmn,tn->m", self.border, x)
        y = torch.cholesky_solve(rest[:, None], self.schur)[:, 0]
        return x - self.back @ y, y

    def covariance(self) -> Tensor:
        """Diagonal blocks (T, n, n) of the inverse matrix, shared parameters marginalised.

        The recursion of Takahashi et al. 1973 (Erisman and Tinney 1975) from the last frame back:
        Z = D^-1 L^-1 + (I - L^T) Z within the band, here in blocks.
        """
        w1, count, n = self.lower.shape[:3]
        # z[k, t] is block (t + k, t) of the inverse
        z = torch.zeros_like(self.lower)
        eye = torch.eye(n, dtype=z.dtype, device=z.device)

        def block(row: int, column: int) -> Tensor:
            return z[row - column, column] if row >= column else z[column - row, row].T

        for t in reversed(range(count)):
            reach = range(1, min(w1 - 1, count - 1 - t) + 1)
            inverse = torch.linalg.solve_triangular(self.lower[0, t], eye, upper=False)
            scaled = {k: self.lower[k, t] @ inverse for k in reach}  # L_(t+k),t L_tt^-1
            for k in reach:
                z[k, t] = -sum((block(t + k, t + j) @ scaled[j] for j in reach), 0 * eye)
            z[0, t] = inverse.T @ inverse - sum((scaled[k].T @ z[k, t] for k in reach), 0 * eye)
        result = z[0]
        if self.back is not None and self.schur is not None:
            half = torch.linalg.solve_triangular(self.schur, self.back.transpose(1, 2), upper=False)
            result = result + half.transpose(1, 2) @ half
        return result


@dataclass(frozen=True)
class CoupledEquations:
    """Linearisation of coupled frames: cost, gradients (T, n) and (m,) or None, and the matrix."""

    cost: float
    gradient: Tensor
    shared_gradient: Tensor | None
    system: BandedSystem


def minimise_coupled(
    linearise: Callable[[Tensor, Tensor], CoupledEquations],
    cost: Callable[[Tensor, Tensor], float],
    own: Tensor,
    shared: Tensor,
    *,
    max_trials: int = 20,
    damping: float = 1e-4,
    cost_tolerance: float = 1e-6,
) -> tuple[Tensor, Tensor, float, int]:
    """Levenberg-Marquardt of one energy over coupled frames, from own (T, n) and shared (m,).

    ``linearise`` gives the normal equations J^T W J, J^T W r at a point, ``cost`` the energy alone.
    Stops when a step lowers the cost by less than ``cost_tolerance`` of it, or none is found.
    Returns own, shared, the cost and the number of accepted steps.
    """
    normal = linearise(own, shared)
    accepted = 0
    for _ in range(max_trials):
        factor = normal.system.damped(damping).factorise()
        if factor is None:
            damping = max(10 * damping, 1e-6)
            continue
        step, shared_step = factor.solve(-normal.gradient, _negated(normal.shared_gradient))
        trial = own + step.to(own.dtype)
        trial_shared = shared if shared_step is None else shared + shared_step.to(shared.dtype)
        new = cost(trial, trial_shared)
        if not new <= normal.cost:
            damping = max(8 * damping, 1e-6)
            if damping > 1e8:
                break
            continue
        own, shared, damping = trial, trial_shared, max(0.2 * damping, 1e-9)
        accepted += 1
        if normal.cost - new <= cost_tolerance * abs(normal.cost):
            return own, shared, new, accepted
        normal = linearise(own, shared)
    return own, shared, normal.cost, accepted


def _negated(values: Tensor | None) -> Tensor | None:
    return None if values is None else -values
