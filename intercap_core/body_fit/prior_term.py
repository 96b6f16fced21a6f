"""Priors of the body (equation 2): E_theta_b, E_theta_h, E_theta_f, E_alpha, E_beta and E_psi.

:mod:`intercap_core.body.priors` has the rows of each prior; here they are weighted and summed. The
paper sets the weights lambda empirically. Here observations are weighted by their noise. Gaussian
priors are therefore in units of their own standard deviation, with weight 1.

- E_theta_b is VPoser if the user has it; the open default is a broad Gaussian about a person who
  stands at ease.
- E_psi, the prior of the expression, is the paper's curly E.
- E_beta is here if each frame has its own shape. For a shape that all frames share it is in
  :class:`.problem.ParameterLayout`.
- Beyond the paper: anatomical limits of the joints, with either pose prior.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
import torch
from torch import Tensor

from intercap_core.body import priors
from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import HAND_COLUMNS, NUM_POSE, POSE_COLUMNS, TRANSL
from intercap_core.body_fit.term_inputs import (
    Batch,
    BatchEquations,
    Bodies,
    CompiledTerm,
    TermInputs,
    contiguous,
)

# First columns of the 21 body joints and of each hand.
_BODY_START = POSE_COLUMNS["body_pose"].start
_HANDS = tuple(columns.start for columns in HAND_COLUMNS)

Rows = priors.DiagonalRows | priors.LinearRows


def prior_rows(model: BodyModel, vectors: Tensor, *, body_pose: bool) -> list[tuple[Rows, float]]:
    """Return the rows and weights of all priors but those of shape and expression.

    They are in this order: rest pose, joint limits, bending, left hand, right hand.

    Args:
        model: the body.
        vectors: (B, P) parameters.
        body_pose: include the open prior of the 21 body joints.
    """
    # some hand components hardly vary among grasps; at least 0.03 rad, tuned on the studio
    deviation = model.hand_deviation.clamp_min(0.03)
    own = (model.hand_mean, model.hand_components, deviation)
    # The ranges of joints are those of most people, not of all, so their limits are soft: an
    # excess of 4 degrees is one standard deviation (tuned on the studio).
    limits = 1 / math.radians(4)
    # The residual exp(sign theta) is 1 for a straight limb, which should cost little: the weight
    # is small (tuned on the studio).
    bending = 1 / 6
    return [
        (priors.rest_pose(vectors, first=1 if body_pose else JOINT_INDEX["jaw"]), 1.0),
        (priors.joint_limits(vectors), limits),
        (priors.bending(vectors), bending),
        *((priors.hand_pose(vectors, *own, side=side), 1.0) for side in (0, 1)),
    ]


def _standard_normal(model: BodyModel, shape: bool) -> slice:
    """Return the parameters with a standard normal prior: expression, and betas if ``shape``."""
    return slice(TRANSL.stop + (0 if shape else model.num_betas), None)


# --- compiled --------------------------------------------------------------------------------


class PriorArrays(NamedTuple):
    """The priors of P parameters."""

    mean: np.ndarray
    """(P,)"""
    own: np.ndarray
    """(P,) precision of each parameter; 0 for hands and parameters without a Gaussian prior."""
    hands: np.ndarray
    """(2, 45, 45) precision of the hands, left then right."""
    ranges: np.ndarray
    """(165, 2) lower and upper limit of each pose parameter, rad."""
    outside: float
    """Precision of the excess over the limits, 1/rad^2."""
    bends: np.ndarray
    """(R,) columns of elbows and knees."""
    sign: np.ndarray
    """(R,) sign of the unnatural direction."""
    bending: float
    """Squared weight of E_alpha."""
    pose: np.ndarray
    """(T, 63) mean of the learned prior; T = 0 without a learned prior."""
    pose_precision: np.ndarray
    """(T, 63, 63)"""

    @classmethod
    def of(cls, model: BodyModel, *, shape: bool, body_pose: bool) -> PriorArrays:
        """Return the priors without a learned one.

        Args:
            model: the body.
            shape: include the prior of the betas.
            body_pose: include the open prior of the 21 body joints.
        """
        zero = torch.zeros(1, model.num_parameters, dtype=model.dtype)
        terms = prior_rows(model, zero, body_pose=body_pose)
        alone = [(r, weight) for r, weight in terms if isinstance(r, priors.DiagonalRows)]
        hands = [r.jacobian for r, _ in terms if isinstance(r, priors.LinearRows)]
        (rest, _), (_, outside), (_, bending) = alone
        dtype = zero.numpy().dtype
        mean, own = np.zeros(zero.shape[1], dtype), np.zeros(zero.shape[1], dtype)
        at = rest.columns.numpy()
        mean[at] = (-rest.residuals / rest.slopes)[0].numpy()
        own[at] = rest.slopes[0].numpy() ** 2
        own[_standard_normal(model, shape)] = 1
        for columns, hand_mean in zip(HAND_COLUMNS, model.hand_mean.numpy(), strict=True):
            mean[columns] = hand_mean
        ranges = np.deg2rad(np.array(priors.LIMITS_DEG)).reshape(NUM_POSE, 2).astype(dtype)
        ranges[:3] = -np.inf, np.inf  # the global orientation has no prior
        return cls(
            mean=mean,
            own=own,
            hands=np.stack([(jacobian.T @ jacobian).numpy() for jacobian in hands]),
            ranges=ranges,
            outside=outside**2,
            bends=np.array([column for column, _ in priors.BENDING]),
            sign=np.array([sign for _, sign in priors.BENDING], dtype),
            bending=bending**2,
            pose=np.zeros((0, 63), dtype),
            pose_precision=np.zeros((0, 63, 63), dtype),
        )


class CompiledPriors:
    """All priors by the kernels below."""

    def __init__(self, model: BodyModel) -> None:
        self._model = model
        self._cached: dict[tuple[bool, bool], PriorArrays] = {}

    def prepare(self, inputs: TermInputs, bodies: Bodies, derivatives: bool) -> CompiledTerm:
        """Return the priors, which are the same at all bodies."""
        which = not inputs.one_shape, inputs.pose is None
        if which not in self._cached:
            self._cached[which] = PriorArrays.of(self._model, shape=which[0], body_pose=which[1])
        prior = self._cached[which]
        prior = prior._replace(hands=prior.hands * prior.hands.dtype.type(inputs.hand_share))
        if inputs.pose is not None:
            mean, precision = map(contiguous, inputs.pose)
            prior = prior._replace(pose=mean, pose_precision=precision)

        def used(frames: np.ndarray) -> np.ndarray:
            return np.zeros((len(frames), 0), bool)

        def add_cost(batch: Batch, cost: np.ndarray) -> None:
            none, fixed = np.zeros((1, 0, 0), cost.dtype), np.full(batch.vectors.shape[1], -1)
            add_priors(prior, batch.vectors, batch.frames, fixed, False, cost, none[0], none)

        def add(batch: Batch, equations: BatchEquations) -> None:
            add_priors(
                prior, batch.vectors, batch.frames, equations.place, True, equations.cost,
                equations.gradient, equations.hessian,
            )  # fmt: skip

        return CompiledTerm(None, used, add_cost, add)


@numba.njit(cache=True, nogil=True)
def _add_block(deviation, precision, first, place, gradient, hessian, derivatives):
    """Add a Gaussian of the m adjacent parameters from ``first`` on, and return its cost.

    deviation (m,): parameters minus mean. precision (m,m). place (P,): column of each parameter.
    """
    total = 0.0
    for i in range(len(deviation)):
        derivative = np.float64(0)
        for j in range(len(deviation)):
            derivative += precision[i, j] * deviation[j]
        total += 0.5 * derivative * deviation[i]
        p = place[first + i]
        if derivatives and p >= 0:
            gradient[p] += derivative
            for j in range(len(deviation)):
                if place[first + j] >= 0:
                    hessian[p, place[first + j]] += precision[i, j]
    return total


@numba.njit(cache=True, nogil=True)
def add_priors(prior, vectors, frames, place, derivatives, cost, gradient, hessian):
    """Add the priors at vectors (B,P) of the frames (B,) to the cost (B,).

    With ``derivatives``, add to gradient (B,n) and hessian (B,n,n) as well, by the column ``place``
    (P,) of each parameter, -1 = fixed.
    """
    for b in range(len(vectors)):
        x = vectors[b]
        g, h = gradient[b if derivatives else 0], hessian[b if derivatives else 0]
        total = 0.0
        for p in range(len(place)):
            deviation = x[p] - prior.mean[p]
            derivative, curve = prior.own[p] * deviation, prior.own[p]
            total += 0.5 * derivative * deviation
            if p < len(prior.ranges):
                beyond = max(x[p] - prior.ranges[p, 1], 0) + min(x[p] - prior.ranges[p, 0], 0)
                if beyond != 0:
                    total += 0.5 * prior.outside * beyond * beyond
                    derivative += prior.outside * beyond
                    curve += prior.outside
            if derivatives and place[p] >= 0:
                g[place[p]] += derivative
                h[place[p], place[p]] += curve
        for r in range(len(prior.bends)):
            p = place[prior.bends[r]]
            squared = prior.bending * np.exp(2 * prior.sign[r] * x[prior.bends[r]])
            total += 0.5 * squared
            if derivatives and p >= 0:
                g[p] += prior.sign[r] * squared
                h[p, p] += squared
        for side in range(2):
            first = _HANDS[side]
            deviation = x[first : first + 45] - prior.mean[first : first + 45]
            total += _add_block(deviation, prior.hands[side], first, place, g, h, derivatives)
        if len(prior.pose):
            t = frames[b]
            deviation = x[_BODY_START : _BODY_START + 63] - prior.pose[t]
            total += _add_block(
                deviation, prior.pose_precision[t], _BODY_START, place, g, h, derivatives
            )
        cost[b] += total
