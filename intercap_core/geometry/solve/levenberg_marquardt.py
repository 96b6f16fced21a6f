"""Levenberg-Marquardt on many small problems at once, optionally coupled by shared parameters.

Every frame b has its own parameters x_b (n,); all frames may share parameters y (m,). The energy
is sum_b f_b(x_b, y). With m = 0 the frames are independent: each has its own damping, accepts or
rejects its own steps and stops on its own. With m > 0 the matrix of the normal equations has the
shape of an arrow. They are solved exactly by eliminating the frames (Schur complement):

    | H_1         B_1 |   | dx_1 |     | g_1   |
    |     ...     ... | . | ...  | = - | ...   |
    | B_1^T ... sum C |   | dy   |     | sum c |

For frames that are coupled in time see :mod:`.banded`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

# Range of damping factors. A frame stops at the maximum; with shared parameters all stop together.
_DAMPING_RANGE = (1e-8, 1e8)


class NormalEquations(NamedTuple):
    """One linearisation of b frames with n own and m shared parameters.

    A frame's own columns come first, the shared ones last. The energy is the sum over frames, so a
    prior on shared parameters has to be distributed over the frames.
    """

    cost: Tensor
    """(b,) f_b."""
    gradient: Tensor
    """(b, n+m) J^T W r of each frame alone."""
    hessian: Tensor
    """(b, n+m, n+m) J^T W J of each frame alone."""


class Problem(Protocol):
    """Energy to minimise. ``index`` (b,) selects frames out of B."""

    def linearise(self, own: Tensor, shared: Tensor, index: Tensor) -> NormalEquations:
        """Return the normal equations at own (b, n) and shared (m,)."""
        ...

    def cost(self, own: Tensor, shared: Tensor, index: Tensor) -> Tensor:
        """Return f_b (b,) at own (b, n) and shared (m,), the same as ``linearise`` returns."""
        ...


@dataclass
class Solution:
    """Result of :func:`minimise`."""

    own: Tensor
    """(B, n) parameters of each frame."""
    shared: Tensor
    """(m,) parameters shared by all frames."""
    cost: Tensor
    """(B,) f_b at the solution."""
    converged: Tensor
    """(B,) bool: the last step, or its decrease of the cost, was below the tolerance."""
    trials: int
    """Number of steps tried."""
    normal: NormalEquations | None = None
    """Linearisation at the solution, if requested. The Hessian's inverse is the covariance of
    unit-variance residuals."""


def minimise(
    problem: Problem,
    own: Tensor,
    shared: Tensor | None = None,
    *,
    max_trials: int = 20,
    damping: float = 1e-3,
    step_tolerance: float = 1e-5,
    cost_tolerance: float = 1e-6,
    keep_normal: bool = False,
) -> Solution:
    """Minimise sum_b f_b(x_b, y).

    A step is damped by a multiple of the Hessian's diagonal (Marquardt 1963). The factor of a frame
    decreases after an accepted step and increases after a failed one. A frame has converged if its
    accepted step is below ``step_tolerance`` in every parameter, or lowers its cost by less than
    the share ``cost_tolerance``. With shared parameters all frames converge together, if the shared
    step is also below 100 ``step_tolerance``. Factorisations are in float64 for every type of the
    parameters. A frame whose Hessian cannot be factorised keeps its parameters, and its damping
    increases.

    Args:
        problem: the energy.
        own: (B, n) start.
        shared: (m,) start; None = no shared parameters.
        max_trials: largest number of steps that are tried.
        damping: damping factor at the start.
        step_tolerance: in units of the parameters.
        cost_tolerance: relative decrease of the cost.
        keep_normal: return the normal equations at the solution.
    """
    count = own.shape[0]
    own = own.clone()
    y = own.new_zeros(0) if shared is None else shared.clone()
    everyone = torch.arange(count)
    normal = problem.linearise(own, y, everyone)
    cost = normal.cost.clone()
    lam = torch.full((count,), damping, dtype=torch.float64)
    stale = torch.zeros(count, dtype=torch.bool)
    done = torch.zeros_like(stale)
    converged = torch.zeros_like(stale)
    trials = 0
    while trials < max_trials and not bool(done.all()):
        normal = _refresh(problem, normal, own, y, torch.nonzero(stale & ~done)[:, 0])
        stale[:] = False
        index = torch.nonzero(~done)[:, 0]
        at = normal if len(index) == count else NormalEquations(*(part[index] for part in normal))
        step, shared_step, solved = _damped_step(at, lam[index], len(y))
        trials += 1
        trial, trial_y = own[index] + step.to(own.dtype), y + shared_step.to(y.dtype)
        new, before = problem.cost(trial, trial_y, index), cost[index]
        good = solved & (new <= before)
        if len(y):
            trial, new, good = _keep_the_better(problem, own, trial, trial_y, new, good)
            good &= new.double().sum() <= before.double().sum()
        small = (step.abs() < step_tolerance).all(1)
        small |= before - new <= cost_tolerance * before.abs()
        lam[index] *= torch.where(good, 0.2, 8.0)
        lam.clamp_(*_DAMPING_RANGE)
        stuck = lam[index] >= _DAMPING_RANGE[1]
        if len(y):
            if bool(good.any()):
                own, y, cost = trial, trial_y, new
                stale[:] = True
                settled = bool((small | ~good).all()) and bool(
                    (shared_step.abs() < 100 * step_tolerance).all()
                )
                converged[:], done[:] = settled, settled
            done |= stuck.all()
        else:
            accepted = index[good]
            own[accepted], cost[accepted] = trial[good], new[good]
            stale[accepted] = True
            converged[index[good & small]] = True
            done[index] = (good & small) | stuck
    result = Solution(own, y, cost, converged, trials)
    if keep_normal:
        result.normal = problem.linearise(own, y, everyone)
    return result


def _refresh(
    problem: Problem, normal: NormalEquations, own: Tensor, y: Tensor, index: Tensor
) -> NormalEquations:
    """Update the linearisation of the frames in ``index``."""
    if len(index) == len(own):
        return problem.linearise(own, y, index)
    if len(index):
        for kept, fresh in zip(normal, problem.linearise(own[index], y, index), strict=True):
            kept[index] = fresh
    return normal


def _keep_the_better(
    problem: Problem, own: Tensor, trial: Tensor, trial_y: Tensor, new: Tensor, good: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Replace failed steps by the old own parameters if these cost less at the new shared ones.

    Args:
        problem: the energy.
        own: (B, n) parameters before the step.
        trial: (B, n) parameters after it, changed in place.
        trial_y: (m,) shared parameters after it.
        new: (B,) cost at ``trial`` and ``trial_y``, changed in place.
        good: (B,) bool, the step lowered the frame's cost.

    Returns:
        ``trial``, ``new``, and ``good`` after the replacement.
    """
    bad = torch.nonzero(~good)[:, 0]
    if len(bad):
        stayed = problem.cost(own[bad], trial_y, bad)
        better = stayed <= new[bad]
        trial[bad] = torch.where(better[:, None], own[bad], trial[bad])
        new[bad] = torch.minimum(stayed, new[bad])
        good = good.clone()
        good[bad] = ~better
    return trial, new, good


def _damped_step(
    normal: NormalEquations, lam: Tensor, num_shared: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Solve the damped normal equations; lam (b,): damping factors.

    Returns:
        (b, n) own steps.
        (m,) shared step.
        (b,) bool, the frame's own block was factorised.
    """
    gradient, n = normal.gradient, normal.gradient.shape[1] - num_shared
    a = normal.hessian[:, :n, :n].double()
    if a.dtype == normal.hessian.dtype:
        a = a.clone()
    diagonal = a.diagonal(dim1=1, dim2=2)
    diagonal += lam[:, None] * diagonal + 1e-9
    factor, info = torch.linalg.cholesky_ex(a)
    right = torch.cat([gradient[:, :n, None], normal.hessian[:, :n, n:]], 2).double()
    solved = info == 0
    if not bool(solved.all()):  # such a frame keeps its parameters while its damping grows
        eye = torch.eye(n, dtype=a.dtype)
        factor = torch.where(solved[:, None, None], factor, eye)
        right = torch.where(solved[:, None, None], right, torch.zeros_like(right))
    # H = L L^T; ``half`` = L^-1 [g B] eliminates the frames from the equations of y
    half = torch.linalg.solve_triangular(factor, right, upper=False)
    shared_step = right.new_zeros(num_shared)
    if num_shared:
        flat = half.flatten(0, 1)
        eliminated = flat[:, 1:].T @ flat
        schur = normal.hessian[:, n:, n:].sum(0, dtype=a.dtype) - eliminated[:, 1:]
        schur.diagonal().add_(lam.mean() * schur.diagonal().abs() + 1e-9)
        shared_step = -torch.linalg.solve(
            schur, gradient[:, n:].sum(0, dtype=a.dtype) - eliminated[:, 0]
        )
    remains = half[..., :1] + half[..., 1:] @ shared_step[:, None]
    step = -torch.linalg.solve_triangular(factor.mT, remains, upper=True)[..., 0]
    return step, shared_step, solved
