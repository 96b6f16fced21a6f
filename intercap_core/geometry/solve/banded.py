"""Exact solution of normal equations that couple neighbouring frames, by block Cholesky.

A system has T frames with n parameters each. Frame t is coupled with frames up to t + w: w = 0
without temporal terms, 1 with velocities, 2 with accelerations. Its matrix (T n x T n) is
block-banded, symmetric and positive definite. The block Cholesky factorisation over time takes
O(T (w + 1)^2 n^3) operations and O(T (w + 1) n^2) memory.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from scipy.linalg import get_blas_funcs
from torch import Tensor


@dataclass(frozen=True)
class BandedSystem:
    """Blocks of a symmetric matrix."""

    bands: Tensor
    """(w+1, T, n, n): ``bands[k, t]`` is block (t + k, t), rows of frame t + k, columns of frame t.
    ``bands[0]`` is symmetric, and the last k entries of ``bands[k]`` are not read."""

    def __post_init__(self) -> None:
        w1, t, n, n2 = self.bands.shape
        if n != n2 or w1 > t:
            raise ValueError(f"bands have shape {tuple(self.bands.shape)}, expected (w+1, T, n, n)")

    def factorise(self, *, in_place: bool = False) -> BandedFactor | None:
        """Return the Cholesky factor, or None if the matrix is not positive definite.

        ``in_place`` overwrites ``bands`` by the factor.
        """
        lower = self.bands if in_place else self.bands.clone()
        w1, count = lower.shape[:2]
        if w1 == 1:
            lower[0], info = torch.linalg.cholesky_ex(lower[0])
            return None if bool(info.any()) else BandedFactor(lower)
        (syrk,) = get_blas_funcs(("syrk",), dtype=lower.numpy().dtype)
        for t in range(count):
            # lower[k, t - k] is block (t, t - k); finish row t from its farthest column on
            for k in range(min(w1 - 1, t), 0, -1):
                block = lower[k, t - k]
                for j in range(k + 1, min(w1 - 1, t) + 1):
                    block -= lower[j, t - j] @ lower[j - k, t - j].T
                lower[k, t - k] = torch.linalg.solve_triangular(
                    lower[0, t - k].T, block, upper=True, left=False
                )
            own = lower[0, t].numpy()
            for k in range(1, min(w1 - 1, t) + 1):
                # only the lower triangle, which cholesky_ex reads; BLAS stores by columns
                rows = lower[k, t - k].numpy()
                own = syrk(-1.0, rows.T, beta=1.0, c=own.T, trans=1, overwrite_c=1).T
            lower[0, t], info = torch.linalg.cholesky_ex(torch.from_numpy(own))
            if bool(info):
                return None
        return BandedFactor(lower)


@dataclass(frozen=True)
class BandedFactor:
    """Cholesky factor of a :class:`BandedSystem`."""

    lower: Tensor
    """(w+1, T, n, n), laid out as `BandedSystem.bands`."""

    def solve(self, right: Tensor) -> Tensor:
        """Return the solutions x (T, n) or (T, n, k) for one or k right-hand sides."""
        if right.ndim == 2:
            return self.solve(right[..., None])[..., 0]
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
