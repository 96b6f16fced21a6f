"""How far off a fitted joint may be, stated from the normal equations."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import TRANSL
from intercap_core.body_fit.constants import (
    MODEL_SIGMA_M,
)
from intercap_core.body_fit.schedule import Fit

_CHUNK = 16
_NUM_JOINTS = 55


def joint_covariance(model: BodyModel, fit: Fit) -> Tensor:
    """Covariance (N,55,3,3) of each joint's position, master frame, square metres.

    With own parameters o and shared ones s of blocks H of the whitened energy's Hessian, that of a
    joint J(o, s) is

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
    model_error = MODEL_SIGMA_M**2 * torch.eye(3).to(information)
    result = information.new_zeros(len(fit.vectors), _NUM_JOINTS, 3, 3)
    for at, (factor, answer, _) in zip(_chunks(len(fit.vectors)), at_rest, strict=True):
        lin = model.linearise(
            model.parameters(fit.vectors[at]), vertex_ids=np.array([0]), joints=True
        )
        full = lin.full()[:, 1:].double().flatten(1, 2)
        by_own = full[..., fit.columns]
        by_shared = -by_own @ answer
        if fit.one_shape:
            by_shared[..., : len(betas)] += full[..., betas]
        excess = fit.excess[at, None, None, None].double()
        found = _covariance(factor, by_own) * excess + _covariance(shared_factor, by_shared)
        result[at] = found + model_error
    return result


def deviation(covariance: np.ndarray) -> np.ndarray:
    """Standard deviation (...) along one coordinate, in the mean square, of covariances
    (...,3,3)."""
    return np.sqrt(np.trace(covariance, axis1=-2, axis2=-1) / 3)


def widened(covariance: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Covariances (...,3,3) grown alike in all directions until their deviation is ``sigma`` (...).

    What widens it, flags and bridges, has no direction.
    """
    more = sigma**2 - deviation(covariance) ** 2
    return covariance + more[..., None, None] * np.eye(3)


def _eliminated(hessian: Tensor, own: int) -> tuple[Tensor, Tensor, Tensor]:
    """Cholesky factor of H_oo, H_oo^-1 H_os and H_ss - H_so H_oo^-1 H_os of (B,n+m,n+m)."""
    hessian = hessian.double()
    factor = torch.linalg.cholesky(hessian[:, :own, :own])
    mixed = hessian[:, :own, own:]
    answer = torch.cholesky_solve(mixed, factor)
    return factor, answer, hessian[:, own:, own:] - mixed.transpose(1, 2) @ answer


def _covariance(factor: Tensor, by: Tensor) -> Tensor:
    """Covariance (B,55,3,3) of rows ``by`` (B,165,n), three a joint, under the information whose
    Cholesky factor (B,n,n) or (n,n) is given."""
    half = torch.linalg.solve_triangular(factor, by.transpose(1, 2), upper=False)
    half = half.reshape(len(by), -1, _NUM_JOINTS, 3).transpose(1, 2)
    return half.transpose(2, 3) @ half


def _chunks(count: int) -> list[slice]:
    return [slice(start, start + _CHUNK) for start in range(0, count, _CHUNK)]
