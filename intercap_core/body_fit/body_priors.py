"""Priors of the body (equation 2): E_theta_b, E_theta_h, E_theta_f, E_alpha, E_beta and E_psi.

The terms themselves are in :mod:`intercap_core.body.priors`; here they are weighed and summed. With
observations weighed by their noise, Gaussian priors have weight one: they are in units of their own
spread, where the paper sets lambdas empirically. E_theta_b is VPoser where the user has it; the
open default is a broad Gaussian about standing at ease. E_psi, of the expression, is the paper's
curly E. E_beta of a shape that all frames share is in :mod:`intercap_core.body_fit.layout`. Beyond
the paper: anatomical limits of the joints, which hold with either pose prior.
"""

from __future__ import annotations

import torch
from torch import Tensor

from intercap_core.body import priors
from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import TRANSL
from intercap_core.body.vposer import PoseGaussian
from intercap_core.body_fit.body_constants import (
    BENDING_WEIGHT,
    LIMIT_WEIGHT,
    SMALLEST_HAND_DEVIATION,
)

_BODY_POSE = slice(3, 66)


def terms(
    model: BodyModel, vector: Tensor, *, body_pose: bool = True, hand_share: float = 1.0
) -> list[tuple[priors.DiagonalRows | priors.LinearRows, float]]:
    """All prior terms and weights at parameter vectors (B,P), shape and expression left out.

    ``body_pose``: with the open default's Gaussian of the 21 body joints. ``hand_share``: of an
    observation that E_theta_h is in one frame.
    """
    deviation = model.hand_deviation.clamp_min(SMALLEST_HAND_DEVIATION)
    own = (model.hand_mean, model.hand_components, deviation)
    hands = [(priors.hand_pose(vector, *own, side=side), hand_share**0.5) for side in (0, 1)]
    return [
        (priors.rest_pose(vector, first=1 if body_pose else JOINT_INDEX["jaw"]), 1.0),
        (priors.joint_limits(vector), LIMIT_WEIGHT),
        (priors.bending(vector), BENDING_WEIGHT),
        *hands,
    ]


def cost(
    model: BodyModel,
    vector: Tensor,
    *,
    shape: bool,
    pose: PoseGaussian | None = None,
    hand_share: float = 1.0,
) -> Tensor:
    """(B,) at (B,P); ``shape``: betas included (else they are the caller's), expression always;
    ``pose`` instead of the open prior of the body's pose; ``hand_share`` as in :func:`terms`."""
    total = 0.5 * (vector[:, quadratic(model, shape)] ** 2).sum(1)
    if pose is not None:
        total = total + pose.cost(vector[:, _BODY_POSE])
    for rows, weight in terms(model, vector, body_pose=pose is None, hand_share=hand_share):
        total = total + rows.energy(weight)
    return total


def assemble(
    model: BodyModel,
    vector: Tensor,
    *,
    shape: bool,
    pose: PoseGaussian | None = None,
    hand_share: float = 1.0,
) -> tuple[Tensor, Tensor, Tensor]:
    """Cost (B,), gradient (B,P) and Gauss-Newton Hessian (B,P,P) of all priors at (B,P)."""
    batch, size = vector.shape
    gradient, hessian = torch.zeros_like(vector), vector.new_zeros(batch, size, size)
    if pose is not None:
        difference = vector[:, _BODY_POSE] - pose.mean
        gradient[:, _BODY_POSE] += (pose.precision @ difference[..., None])[..., 0]
        hessian[:, _BODY_POSE, _BODY_POSE] += pose.precision
    for rows, weight in terms(model, vector, body_pose=pose is None, hand_share=hand_share):
        rows.add_to(hessian, gradient, weight)
    at = quadratic(model, shape)
    gradient[:, at] += vector[:, at]
    hessian.diagonal(dim1=1, dim2=2)[:, at] += 1
    total = cost(model, vector, shape=shape, pose=pose, hand_share=hand_share)
    return total, gradient, hessian


def quadratic(model: BodyModel, shape: bool) -> slice:
    return slice(TRANSL.stop + (0 if shape else model.num_betas), None)
