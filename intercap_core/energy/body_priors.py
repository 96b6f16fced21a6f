"""Priors of the body's energy: E_theta_b, E_theta_h, E_theta_f, E_alpha, E_beta and E_psi of eq. 2.

The terms themselves are in :mod:`intercap_core.body.priors`; here they are weighed and summed. With
observations weighed by their noise, Gaussian priors have weight one: they are in units of their own
spread. The open default stands in for VPoser: a broad Gaussian about standing at ease and
anatomical limits.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from intercap_core.body import priors
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import TRANSL

_LIMIT_WEIGHT = 1 / math.radians(4)  # ranges are means plus two deviations: a soft edge
_BENDING_WEIGHT = 1 / 6  # exp(sign theta) = 1 at the straight limb, where it should cost little
_SMALLEST_HAND_DEVIATION = 0.03  # components that hardly vary among grasps still give a little


def terms(
    model: BodyModel, vector: Tensor
) -> list[tuple[priors.DiagonalRows | priors.LinearRows, float]]:
    """All prior terms and weights at parameter vectors (B,P), shape and expression left out."""
    deviation = model.hand_deviation.clamp_min(_SMALLEST_HAND_DEVIATION)
    own = (model.hand_mean, model.hand_components, deviation)
    hands = [(priors.hand_pose(vector, *own, side=side), 1.0) for side in (0, 1)]
    return [
        (priors.rest_pose(vector), 1.0),
        (priors.joint_limits(vector), _LIMIT_WEIGHT),
        (priors.bending(vector), _BENDING_WEIGHT),
        *hands,
    ]


def cost(model: BodyModel, vector: Tensor, *, shape: bool) -> Tensor:
    """(B,) at (B,P); ``shape``: betas included (else they are the caller's), expression always."""
    total = 0.5 * (vector[:, _quadratic(model, shape)] ** 2).sum(1)
    for rows, weight in terms(model, vector):
        total = total + rows.energy(weight)
    return total


def assemble(model: BodyModel, vector: Tensor, *, shape: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Cost (B,), gradient (B,P) and Gauss-Newton Hessian (B,P,P) of all priors at (B,P)."""
    batch, size = vector.shape
    gradient, hessian = torch.zeros_like(vector), vector.new_zeros(batch, size, size)
    for rows, weight in terms(model, vector):
        rows.add_to(hessian, gradient, weight)
    at = _quadratic(model, shape)
    gradient[:, at] += vector[:, at]
    hessian.diagonal(dim1=1, dim2=2)[:, at] += 1
    return cost(model, vector, shape=shape), gradient, hessian


def _quadratic(model: BodyModel, shape: bool) -> slice:
    return slice(TRANSL.stop + (0 if shape else model.num_betas), None)
