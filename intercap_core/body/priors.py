"""Priors of equation 2, what is known about a body before it is seen, with analytic Jacobians.

E_theta_b and E_theta_f (:func:`rest_pose`), E_theta_h (:func:`hand_pose`), E_alpha
(:func:`bending`), E_beta and E_psi (:func:`shape`), and beyond the paper :func:`joint_limits`. They
are weighed and summed in :mod:`intercap_core.body_fit.body_priors`; VPoser's E_theta_b is in
:mod:`.vposer`.

Every function takes parameter vectors (B,P) (order of `BodyParameters.vector`) and gives rows that
add themselves to normal equations. Weights enter squared, as in SMPLify-X.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from intercap_core.body.joint_limits import LIMITS_DEG, REST_SPREAD_DEG
from intercap_core.body.parameters import NUM_POSE

# Elbows and knees (Bogo et al. 2016, SMPLify, "unnatural bending"): full-pose column, sign of the
# wrong way.
BENDING: tuple[tuple[int, int], ...] = ((55, 1), (58, -1), (12, -1), (15, -1))
_HAND_COLUMNS = (slice(75, 120), slice(120, 165))


@dataclass(frozen=True)
class DiagonalRows:
    """One parameter a residual: residuals (B,R), their slopes (B,R), parameter columns (R,)."""

    residuals: Tensor
    slopes: Tensor
    columns: Tensor

    def add_to(self, hessian: Tensor, gradient: Tensor, weight: float) -> None:
        """Add weight^2 J^T J to (B,P,P) and weight^2 J^T r to (B,P), in place."""
        diagonal = torch.diagonal(hessian, dim1=1, dim2=2)
        diagonal[:, self.columns] += weight**2 * self.slopes**2
        gradient[:, self.columns] += weight**2 * self.slopes * self.residuals

    def energy(self, weight: float) -> Tensor:
        """(B,) half the weighted sum of squares."""
        return 0.5 * weight**2 * (self.residuals**2).sum(1)


@dataclass(frozen=True)
class LinearRows:
    """residuals (B,R) with one Jacobian (R,C) for all bodies over the parameters columns (C,)."""

    residuals: Tensor
    jacobian: Tensor
    columns: Tensor

    def add_to(self, hessian: Tensor, gradient: Tensor, weight: float) -> None:
        """Add weight^2 J^T J to (B,P,P) and weight^2 J^T r to (B,P), in place."""
        square = weight**2 * self.jacobian.T @ self.jacobian
        hessian[:, self.columns[:, None], self.columns] += square
        gradient[:, self.columns] += weight**2 * self.residuals @ self.jacobian

    def energy(self, weight: float) -> Tensor:
        """(B,) half the weighted sum of squares."""
        return 0.5 * weight**2 * (self.residuals**2).sum(1)


def joint_limits(vector: Tensor) -> DiagonalRows:
    """How far each axis-angle component is outside its anatomical range, rad (beyond the paper).

    r = max(theta - upper, 0) + min(theta - lower, 0): zero inside, so it costs a healthy pose
    nothing. Ranges and their sources: `joint_limits.LIMITS_DEG`.
    """
    table = torch.deg2rad(torch.tensor(LIMITS_DEG, dtype=vector.dtype, device=vector.device))
    pose = vector[:, 3:NUM_POSE]
    lower, upper = table[1:, :, 0].reshape(-1), table[1:, :, 1].reshape(-1)
    residuals = (pose - upper).clamp(min=0) + (pose - lower).clamp(max=0)
    columns = torch.arange(3, NUM_POSE, device=vector.device)
    return DiagonalRows(residuals, (residuals != 0).to(vector.dtype), columns)


def bending(vector: Tensor) -> DiagonalRows:
    """E_alpha: elbows and knees do not bend backward, r = exp(sign * theta); its sum of squares."""
    columns = torch.tensor([c for c, _ in BENDING], device=vector.device)
    sign = torch.tensor([float(s) for _, s in BENDING], dtype=vector.dtype, device=vector.device)
    residuals = torch.exp(sign * vector[:, columns])
    return DiagonalRows(residuals, sign * residuals, columns)


def rest_pose(vector: Tensor, *, first: int = 1) -> DiagonalRows:
    """E_theta_b (21 body joints) and E_theta_f (jaw, eyes), from joint ``first`` on: a weak pull to
    standing at ease, r = (theta - mean) / spread.

    Means and spreads are broad guesses of everyday poses (`joint_limits.REST_SPREAD_DEG`): they
    only hold what nothing has seen.
    """
    columns = torch.arange(3 * first, 75, device=vector.device)
    table = torch.deg2rad(torch.tensor(REST_SPREAD_DEG, dtype=vector.dtype, device=vector.device))[
        first:25
    ].reshape(-1, 2)
    residuals = (vector[:, 3 * first : 75] - table[:, 0]) / table[:, 1]
    return DiagonalRows(residuals, (1 / table[:, 1]).expand_as(residuals), columns)


def hand_pose(
    vector: Tensor,
    mean: Tensor,
    components: Tensor,
    deviation: Tensor,
    *,
    side: int,
    count: int = 45,
) -> LinearRows:
    """E_theta_h: Gaussian over one hand's pose components, r = C (theta - mean) / deviation.

    mean (2,45), components (2,45,45) orthonormal rows, deviation (2,45) of the model; side 0 is the
    left hand; the first `count` components count.
    """
    at = _HAND_COLUMNS[side]
    jacobian = components[side, :count] / deviation[side, :count, None]
    residuals = (vector[:, at] - mean[side]) @ jacobian.T
    return LinearRows(residuals, jacobian, torch.arange(at.start, at.stop, device=vector.device))


def shape(vector: Tensor) -> DiagonalRows:
    """E_beta and E_psi: betas and expression are standard normal, r = value."""
    columns = torch.arange(NUM_POSE + 3, vector.shape[1], device=vector.device)
    residuals = vector[:, NUM_POSE + 3 :]
    return DiagonalRows(residuals, torch.ones_like(residuals), columns)
