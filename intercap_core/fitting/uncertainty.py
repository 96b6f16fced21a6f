"""How far off a fitted joint may be, stated from the normal equations."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import TRANSL
from intercap_core.fitting.schedule import Fit

# What ten shape components cannot say about a person's joints: 1.3 mm off in the mean over adults
# that the open body was not made from (docs/body.md), along one coordinate.
_MODEL_M = 0.001
_CHUNK = 16
_NUM_JOINTS = 55


def joint_sigma(model: BodyModel, fit: Fit) -> Tensor:
    """Standard deviation (N,55) of each joint's coordinates, metres.

    With own parameters o and shared ones s of blocks H of the whitened energy's Hessian, a joint
    J(o, s) has the covariance

        J_o H_oo^-1 J_o' e  +  G S^-1 G',   G = J_s - J_o H_oo^-1 H_os

    The first is that of a frame whose shape, offsets and coverings are known, scaled by the
    ``excess`` e of its residuals. S is the mean over frames of H_ss - H_so H_oo^-1 H_os: what is
    wrong about them is the same in every frame, so that a recording is worth as many independent
    frames as its priors are made to count for, not as many as it has.
    """
    own = len(fit.columns)
    betas = torch.arange(TRANSL.stop, TRANSL.stop + model.num_betas, device=fit.vectors.device)
    at_rest = [_eliminated(fit.hessian[at], own) for at in _chunks(len(fit.vectors))]
    information = torch.cat([schur for _, _, schur in at_rest]).mean(0)
    counts = fit.shared_counts.double()
    information = information / (counts[:, None] * counts[None]).sqrt()
    shared_factor = torch.linalg.cholesky(information)
    sigma = fit.vectors.new_zeros(len(fit.vectors), _NUM_JOINTS)
    for at, (factor, answer, _) in zip(_chunks(len(fit.vectors)), at_rest, strict=True):
        lin = model.linearise(
            model.parameters(fit.vectors[at]), vertex_ids=np.array([0]), joints=True
        )
        full = lin.full()[:, 1:].double().flatten(1, 2)
        by_own = full[..., fit.columns]
        by_shared = -by_own @ answer
        if fit.one_shape:
            by_shared[..., : len(betas)] += full[..., betas]
        excess = fit.excess[at, None].double()
        variance = _mean_square(factor, by_own) * excess + _mean_square(shared_factor, by_shared)
        sigma[at] = (variance + _MODEL_M**2).sqrt().to(sigma.dtype)
    return sigma


def _eliminated(hessian: Tensor, own: int) -> tuple[Tensor, Tensor, Tensor]:
    """Cholesky factor of H_oo, H_oo^-1 H_os and H_ss - H_so H_oo^-1 H_os of (B,n+m,n+m)."""
    hessian = hessian.double()
    factor = torch.linalg.cholesky(hessian[:, :own, :own])
    mixed = hessian[:, :own, own:]
    answer = torch.cholesky_solve(mixed, factor)
    return factor, answer, hessian[:, own:, own:] - mixed.transpose(1, 2) @ answer


def _mean_square(factor: Tensor, by: Tensor) -> Tensor:
    """Variance (B,55), the mean of three coordinates', of rows ``by`` (B,165,n) under the
    information whose Cholesky factor (B,n,n) or (n,n) is given."""
    half = torch.linalg.solve_triangular(factor, by.transpose(1, 2), upper=False)
    return (half**2).sum(1).reshape(len(by), _NUM_JOINTS, 3).mean(2)


def _chunks(count: int) -> list[slice]:
    return [slice(start, start + _CHUNK) for start in range(0, count, _CHUNK)]
