"""The priors of equation 2 in :mod:`.body_priors`, compiled: into each body's normal equations."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
import torch

from intercap_core.body import priors
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import NUM_POSE
from intercap_core.body.priors import LIMITS_DEG
from intercap_core.body_fit import body_priors

_HANDS = (75, 120)  # first column of each hand
_BODY = 3  # first column of the 21 body joints


class Priors(NamedTuple):
    """Of P parameters: precision (P,) of each alone and of hands (2,45,45) about mean (P,); ranges
    (165,2) of the pose and the precision outside; columns that bend (R,), in the way of sign (R,),
    and what that weighs, squared.

    Poses about which a learned prior expects each of T frames: (T,63), precision (T,63,63); of no
    frame where there is none.
    """

    mean: np.ndarray
    own: np.ndarray
    hands: np.ndarray
    ranges: np.ndarray
    outside: float
    bends: np.ndarray
    sign: np.ndarray
    bending: float
    pose: np.ndarray
    pose_precision: np.ndarray

    @classmethod
    def of(cls, model: BodyModel, *, shape: bool, body_pose: bool = True) -> Priors:
        """Those of :func:`.body_priors.cost`, no learned one; ``body_pose``: with the open prior of
        the 21 body joints."""
        zero = torch.zeros(1, model.num_parameters, dtype=model.dtype)
        terms = body_priors.terms(model, zero, body_pose=body_pose)
        alone = [(r, weight) for r, weight in terms if isinstance(r, priors.DiagonalRows)]
        hands = [r.jacobian for r, _ in terms if isinstance(r, priors.LinearRows)]
        (rest, _), (_, outside), (_, bending) = alone
        dtype = zero.numpy().dtype
        mean, own = np.zeros(zero.shape[1], dtype), np.zeros(zero.shape[1], dtype)
        at = rest.columns.numpy()
        mean[at] = (-rest.residuals / rest.slopes)[0].numpy()
        own[at] = rest.slopes[0].numpy() ** 2
        own[body_priors.quadratic(model, shape)] = 1
        for first, hand_mean in zip(_HANDS, model.hand_mean.numpy(), strict=True):
            mean[first : first + 45] = hand_mean
        ranges = np.deg2rad(np.array(LIMITS_DEG)).reshape(NUM_POSE, 2).astype(dtype)
        ranges[:3] = -np.inf, np.inf  # global position and orientation have no prior
        return cls(
            mean, own, np.stack([(jacobian.T @ jacobian).numpy() for jacobian in hands]),
            ranges, outside**2, np.array([c for c, _ in priors.BENDING]),
            np.array([s for _, s in priors.BENDING], dtype), bending**2,
            np.zeros((0, 63), dtype), np.zeros((0, 63, 63), dtype),
        )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def _add_block(deviation, precision, first, place, gradient, hessian, derivatives):
    """Add the Gaussian of neighbouring parameters, ``deviation`` (m,) from its mean; its cost."""
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
    """Add the priors at vectors (B,P) to the cost (B,) and, if ``derivatives``, to gradient (B,n)
    and hessian (B,n,n), by ``place`` (P,), each parameter's column, -1 = fixed. frames (B,)."""
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
            deviation = x[_BODY : _BODY + 63] - prior.pose[t]
            total += _add_block(deviation, prior.pose_precision[t], _BODY, place, g, h, derivatives)
        cost[b] += total
