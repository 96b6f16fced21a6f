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
# Frames that are linearised at once. The normal equations of a body with hands and face, their
# factors and solutions take 1.3 MB a frame.
BLOCK_FRAMES = 128
# Blocks are eliminated a second time in longer recordings, since their solutions for unit steps of
# the shared parameters take 60 kB a frame.
KEPT_FRAMES = 512


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
    """Largest number of steps tried in a frame."""


def minimise(
    problem: Problem,
    own: Tensor,
    shared: Tensor | None = None,
    *,
    max_trials: int = 20,
    damping: float = 1e-3,
    step_tolerance: float = 1e-5,
    cost_tolerance: float = 1e-6,
) -> Solution:
    """Minimise sum_b f_b(x_b, y).

    A step is damped by a multiple of the Hessian's diagonal (Marquardt 1963). The factor of a frame
    decreases after an accepted step and increases after a failed one. A frame has converged if its
    accepted step is below ``step_tolerance`` in every parameter, or lowers its cost by less than
    the share ``cost_tolerance``. With shared parameters all frames converge together, if the shared
    step is also below 100 ``step_tolerance``. Factorisations are in float64 for every type of the
    parameters. A frame whose Hessian cannot be factorised keeps its parameters, and its damping
    increases.

    Memory is bounded by linearising ``BLOCK_FRAMES`` frames at once. Frames without shared
    parameters are minimised block by block.

    Args:
        problem: the energy.
        own: (B, n) start.
        shared: (m,) start; None = no shared parameters.
        max_trials: largest number of steps that are tried.
        damping: damping factor at the start.
        step_tolerance: in units of the parameters.
        cost_tolerance: relative decrease of the cost.
    """
    y = own.new_zeros(0) if shared is None else shared.clone()
    everyone = torch.arange(len(own))
    parts = [
        _minimise(problem, own[at], y, at, max_trials, damping, step_tolerance, cost_tolerance)
        for at in ([everyone] if len(y) else _blocks(everyone))
    ]
    if len(parts) == 1:
        return parts[0]
    joined = (torch.cat([getattr(part, name) for part in parts])
              for name in ("own", "cost", "converged"))  # fmt: skip
    own, cost, converged = joined
    return Solution(own, y, cost, converged, max(part.trials for part in parts))


def _minimise(
    problem: Problem,
    own: Tensor,
    y: Tensor,
    frames: Tensor,
    max_trials: int,
    damping: float,
    step_tolerance: float,
    cost_tolerance: float,
) -> Solution:
    """Minimise over the ``frames`` (b,); see :func:`minimise`."""
    own = own.clone()
    linear = _Linearisation(problem, own, y, frames)
    cost = linear.cost()
    lam = torch.full((len(own),), damping, dtype=torch.float64)
    stale = torch.zeros(len(own), dtype=torch.bool)
    done = torch.zeros_like(stale)
    converged = torch.zeros_like(stale)
    trials = 0
    while trials < max_trials and not bool(done.all()):
        linear.refresh(own, y, torch.nonzero(stale & ~done)[:, 0])
        stale[:] = False
        index = torch.nonzero(~done)[:, 0]
        step, shared_step, solved = linear.damped_step(lam, index)
        trials += 1
        trial, trial_y = own[index] + step.to(own.dtype), y + shared_step.to(y.dtype)
        new, before = _cost(problem, trial, trial_y, frames[index]), cost[index]
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
    return Solution(own, y, cost, converged, trials)


def _blocks(index: Tensor) -> list[Tensor]:
    return list(index.split(BLOCK_FRAMES))


def _cost(problem: Problem, own: Tensor, y: Tensor, frames: Tensor) -> Tensor:
    """Return the cost (b,) of the ``frames`` (b,), evaluated block by block."""
    parts = zip(own.split(BLOCK_FRAMES), _blocks(frames), strict=True)
    return torch.cat([own.new_zeros(0), *(problem.cost(part, y, at) for part, at in parts)])


class _Linearisation:
    """Normal equations of the ``frames`` (b,), which are kept if they are a single block."""

    def __init__(self, problem: Problem, own: Tensor, y: Tensor, frames: Tensor) -> None:
        self._problem, self._frames = problem, frames
        self._at = own, y
        self._kept: NormalEquations | None = None
        if len(frames) <= BLOCK_FRAMES:
            self._kept = problem.linearise(own, y, frames)

    def cost(self) -> Tensor:
        """Return the cost (b,) at the start."""
        if self._kept is not None:
            return self._kept.cost.clone()
        return _cost(self._problem, *self._at, self._frames)

    def refresh(self, own: Tensor, y: Tensor, index: Tensor) -> None:
        """Take new parameters, of which those of the frames ``index`` have changed."""
        self._at = own, y
        if self._kept is None or not len(index):
            return
        fresh = self._problem.linearise(own[index], y, self._frames[index])
        if len(index) == len(own):
            self._kept = fresh
            return
        for kept, part in zip(self._kept, fresh, strict=True):
            kept[index] = part

    def damped_step(self, lam: Tensor, index: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Solve the damped normal equations; lam (b,): damping factors.

        Returns:
            (k, n) own steps of the frames ``index`` (k,).
            (m,) shared step.
            (k,) bool, the frame's own block was factorised.
        """
        own, y = self._at
        normal = self._kept
        if normal is not None:
            if len(index) < len(own):
                normal = NormalEquations(*(part[index] for part in normal))
            block = _Eliminated.of(normal, lam[index], len(y))
            shared_step = _shared_step(block.schur, block.right, lam[index])
            return block.step(shared_step), shared_step, block.solved
        # solutions for unit steps of y are kept instead of the normal equations and their factors
        keep = len(index) <= KEPT_FRAMES
        schur, right = lam.new_zeros(len(y), len(y)), lam.new_zeros(len(y))
        solutions, solved = [], []
        for at in _blocks(index):
            block = self._eliminated(at, lam)
            schur += block.schur
            right += block.right
            solutions += [block.solution().to(own.dtype)] if keep else []
            solved.append(block.solved)
            del block  # before the next one is computed
        shared_step = _shared_step(schur, right, lam[index])
        if keep:
            unit = torch.cat([shared_step.new_ones(1), shared_step])
            steps = [-(solution.double() @ unit) for solution in solutions]
        else:
            steps = [self._eliminated(at, lam).step(shared_step) for at in _blocks(index)]
        return torch.cat(steps), shared_step, torch.cat(solved)

    def _eliminated(self, index: Tensor, lam: Tensor) -> _Eliminated:
        """Linearise the frames ``index`` and eliminate their own parameters."""
        own, y = self._at
        normal = self._problem.linearise(own[index], y, self._frames[index])
        return _Eliminated.of(normal, lam[index], len(y))


class _Eliminated(NamedTuple):
    """Damped normal equations of b frames, whose own parameters are eliminated."""

    factor: Tensor
    """(b, n, n) Cholesky factor L of the own block H = L L^T."""
    half: Tensor
    """(b, n, 1 + m) L^-1 [g B]."""
    solved: Tensor
    """(b,) bool, the own block was factorised."""
    schur: Tensor
    """(m, m) sum of C - B^T H^-1 B."""
    right: Tensor
    """(m,) sum of c - B^T H^-1 g."""

    @classmethod
    def of(cls, normal: NormalEquations, lam: Tensor, num_shared: int) -> _Eliminated:
        """Eliminate the own parameters; lam (b,): damping factors."""
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
        half = torch.linalg.solve_triangular(factor, right, upper=False)
        flat = half.flatten(0, 1)
        eliminated = flat[:, 1:].T @ flat
        schur = normal.hessian[:, n:, n:].sum(0, dtype=a.dtype) - eliminated[:, 1:]
        own_right = gradient[:, n:].sum(0, dtype=a.dtype) - eliminated[:, 0]
        return cls(factor, half, solved, schur, own_right)

    def step(self, shared_step: Tensor) -> Tensor:
        """Return the own steps (b, n) that follow from the shared step (m,)."""
        remains = self.half[..., :1] + self.half[..., 1:] @ shared_step[:, None]
        return -torch.linalg.solve_triangular(self.factor.mT, remains, upper=True)[..., 0]

    def solution(self) -> Tensor:
        """Return H^-1 [g B] (b, n, 1 + m)."""
        return torch.linalg.solve_triangular(self.factor.mT, self.half, upper=True)


def _shared_step(schur: Tensor, right: Tensor, lam: Tensor) -> Tensor:
    """Return the shared step (m,); lam: damping factors of all frames."""
    if not len(right):
        return right
    damped = schur.clone()
    damped.diagonal().add_(lam.mean() * schur.diagonal().abs() + 1e-9)
    return -torch.linalg.solve(damped, right)


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
        stayed = _cost(problem, own[bad], trial_y, bad)
        better = stayed <= new[bad]
        trial[bad] = torch.where(better[:, None], own[bad], trial[bad])
        new[bad] = torch.minimum(stayed, new[bad])
        good = good.clone()
        good[bad] = ~better
    return trial, new, good
