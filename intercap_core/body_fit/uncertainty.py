"""Standard deviation of fitted joints, from the normal equations."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.joints import NUM_JOINTS
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import TRANSL
from intercap_core.body_fit.quality import joint_excess
from intercap_core.body_fit.schedule import BodyFit
from intercap_core.geometry.solve.levenberg_marquardt import BLOCK_FRAMES

# Error of a joint that ten shape components leave, metres along one coordinate: 1.3 mm in the mean
# over adults that the open body was not made from, measured (docs/body.md).
_MODEL_SIGMA_M = 0.001
CHUNK_FRAMES = 16  # frames whose derivatives are computed at once, limited by memory


class Covariances(NamedTuple):
    """Covariances of a fit of N frames with m shared parameters."""

    joints: Tensor
    """(N, 55, 3, 3) of each joint's position, master frame, square metres."""
    shared: Tensor
    """(m, m) of the shared parameters, in the order of :mod:`.problem`."""


def fit_covariances(model: BodyModel, fit: BodyFit) -> Covariances:
    """Return the covariances of joints and shared parameters.

    With own parameters o of a frame, shared parameters s, and the blocks H of the Gauss-Newton
    matrix of the frame's energy, the covariance of a joint J(o, s) is

        J_o H_oo^-1 J_o' e  +  G S^-1 G'  +  sigma_m^2 I,   G = J_s - J_o H_oo^-1 H_os

    The first term is the covariance if shape, offsets and coverings are known, scaled by the
    excess e of the residuals of the joint's part (:func:`.quality.joint_excess`). The second is
    that of the shared parameters, with the information S_ij = mean over frames of (H_ss - H_so
    H_oo^-1 H_os)_ij / sqrt(k_i k_j). k are the
    counts of the shared priors (:meth:`.problem.ParameterLayout.prior`). Errors of shared
    parameters are the same in every frame, so a recording counts as 1 / k independent frames, not
    as its number of frames. sigma_m is the error of the body model. S^-1 is the covariance of the
    shared parameters.
    """
    own = len(fit.columns)
    betas = torch.arange(TRANSL.stop, TRANSL.stop + model.num_betas)
    count = len(fit.vectors)

    @lru_cache(maxsize=1)
    def at_rest(block: int) -> list[tuple[Tensor, Tensor, Tensor]]:  # 0.4 MB a frame
        hessian = fit.hessian[block : block + BLOCK_FRAMES]
        return [_eliminated(hessian[at], own) for at in _chunks(len(hessian))]

    blocks = range(0, count, BLOCK_FRAMES)
    information = sum(torch.cat([schur for _, _, schur in at_rest(b)]).sum(0) for b in blocks)
    assert isinstance(information, Tensor)
    information = information / count
    counts = fit.shared_counts.double()
    information = information / (counts[:, None] * counts[None]).sqrt()
    shared_factor = torch.linalg.cholesky(information)
    model_error = _MODEL_SIGMA_M**2 * torch.eye(3).to(information)
    result = information.new_zeros(len(fit.vectors), NUM_JOINTS, 3, 3)
    excess = joint_excess(fit.parts).double()[..., None, None]
    for at in _chunks(count):
        block = at.start - at.start % BLOCK_FRAMES
        factor, answer, _ = at_rest(block)[(at.start - block) // CHUNK_FRAMES]
        # one vertex in place of all, which is dropped below, then the joints
        lin = model.linearise(
            model.parameters(fit.vectors[at]), vertex_ids=np.array([0]), joints=True
        )
        full = lin.full()[:, 1:].double().flatten(1, 2)
        by_own = full[..., fit.columns]
        by_shared = -by_own @ answer
        if fit.one_shape:
            by_shared[..., : len(betas)] += full[..., betas]
        own_error = _covariance(factor, by_own) * excess[at]
        result[at] = own_error + _covariance(shared_factor, by_shared) + model_error
    return Covariances(result, torch.cholesky_inverse(shared_factor))


def deviation(covariance: np.ndarray) -> np.ndarray:
    """Return the root mean square standard deviation (...) of covariances (..., 3, 3)."""
    return np.sqrt(np.trace(covariance, axis1=-2, axis2=-1) / 3)


def widen(covariance: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Return covariances (..., 3, 3) with the same variance added in all directions.

    It is chosen such that the :func:`deviation` becomes ``sigma`` (...).
    """
    more = sigma**2 - deviation(covariance) ** 2
    return covariance + more[..., None, None] * np.eye(3)


def _eliminated(hessian: Tensor, own: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the Cholesky factor of H_oo, H_oo^-1 H_os and H_ss - H_so H_oo^-1 H_os.

    own: number of own parameters, the first rows and columns of hessian (b, n + m, n + m).
    """
    hessian = hessian.double()
    factor = torch.linalg.cholesky(hessian[:, :own, :own])
    mixed = hessian[:, :own, own:]
    answer = torch.cholesky_solve(mixed, factor)
    return factor, answer, hessian[:, own:, own:] - mixed.transpose(1, 2) @ answer


def _covariance(factor: Tensor, by: Tensor) -> Tensor:
    """Return the covariance (B, 55, 3, 3) of rows ``by`` (B, 165, n), three for each joint.

    factor (B, n, n) or (n, n): Cholesky factor of the information.
    """
    half = torch.linalg.solve_triangular(factor, by.transpose(1, 2), upper=False)
    half = half.reshape(len(by), -1, NUM_JOINTS, 3).transpose(1, 2)
    return half.transpose(2, 3) @ half


def _chunks(count: int) -> list[slice]:
    """Divide frames into chunks."""
    return [slice(start, start + CHUNK_FRAMES) for start in range(0, count, CHUNK_FRAMES)]
