"""The body's energy E_B (equation 2 with 3 to 5) in PyTorch, as rows of residuals.

It is differentiable by autograd, which the paper's recipe of the joint stage needs. Tests compare
the compiled terms of :mod:`intercap_core.body_fit.terms` with it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from intercap_core.body.parameters import TRANSL
from intercap_core.body_fit import cloud_term, keypoint_term, self_term
from intercap_core.body_fit.prior_term import prior_rows
from intercap_core.body_fit.problem import BodyProblem
from intercap_core.body_fit.term_inputs import Bodies
from intercap_core.geometry.solve.robust import OUTLIER_SIGMAS, geman_mcclure


class Rows(NamedTuple):
    """R residuals of b bodies: the cost is the sum of weight rho(|r|^2) / 2."""

    residual: Tensor
    """(R, D)"""
    weight: Tensor
    """(R,)"""
    body: Tensor
    """(R,) index of the body."""
    scale: float | None = None
    """Scale of Geman and McClure's rho; None = rho is the identity."""

    @classmethod
    def of_bodies(cls, residual: Tensor, weight: Tensor, scale: float | None = None) -> Rows:
        """Return the rows of residuals (b, ..., D) with weights (b, ...)."""
        body = torch.arange(len(weight)).repeat_interleave(weight[0].numel())
        return cls(residual.flatten(0, -2), weight.flatten(), body, scale)

    def cost(self, bodies: int) -> Tensor:
        """Return the cost (b,) of each body."""
        square = (self.residual**2).sum(1)
        rho = square if self.scale is None else geman_mcclure(square, self.scale).rho
        return rho.new_zeros(bodies).index_add(0, self.body, 0.5 * self.weight * rho)


@dataclass(frozen=True)
class BodyEnergy:
    """E_B without the priors of shared parameters, as a function of the bodies.

    Offsets and thickness of the bodies may have a leading axis of b bodies.
    """

    problem: BodyProblem

    def cost(self, bodies: Bodies) -> Tensor:
        """Return the energy (b,) of each body."""
        return torch.stack([rows.cost(len(bodies.frames)) for rows in self.rows(bodies)]).sum(0)

    def rows(self, bodies: Bodies) -> Iterator[Rows]:
        """Yield the rows of E_J, E_D, E_P_self and the priors, as far as they are switched on."""
        yield from self._keypoint_rows(bodies)
        yield from self._cloud_rows(bodies)
        yield from self._self_rows(bodies)
        yield from self._prior_rows(bodies)

    def keypoints(self, vectors: Tensor) -> Tensor:
        """Return the keypoints (b, K, 3) without offsets, metres."""
        model, chosen = self.problem.model, self.problem.keypoints
        output = model.forward(model.parameters(vectors), vertex_ids=chosen.vertices)
        return chosen.matrix @ torch.cat([output.vertices, output.joints], 1)

    def samples(self, vectors: Tensor) -> Tensor:
        """Return the samples (b, N, 3) of E_D, metres."""
        model, ids = self.problem.model, self.problem.samples.vertex
        return model.forward(model.parameters(vectors), vertex_ids=ids).vertices

    def paired(self, vectors: Tensor) -> Tensor:
        """Return the points (b, U, 3) of the pairs of E_P_self, metres."""
        model, pairs = self.problem.model, self.problem.pairs
        assert pairs is not None
        return model.forward(model.parameters(vectors), vertex_ids=pairs.vertices).vertices

    def _keypoint_rows(self, bodies: Bodies) -> Iterator[Rows]:
        problem, scale = self.problem, OUTLIER_SIGMAS
        params = problem.model.parameters(bodies.vectors)
        carrier = keypoint_term.carrier_rotations(params, problem.keypoints)
        arms = (carrier @ bodies.offsets[..., None])[..., 0]
        points = self.keypoints(bodies.vectors) + arms
        if problem.views is not None:
            views = problem.views.frames(bodies.frames)
            pixels = keypoint_term.pixel_residuals(points, views) / views.sigma[..., None]
            pixels = torch.where(views.confidence[..., None] > 0, pixels, 0)
            yield Rows.of_bodies(pixels, views.confidence, scale)
        if problem.targets is not None:
            targets = problem.targets.frames(bodies.frames)
            apart = (points - targets.points) / targets.sigma
            apart = torch.where(targets.confidence[..., None] > 0, apart, 0)
            yield Rows.of_bodies(apart, targets.confidence, scale)

    def _cloud_rows(self, bodies: Bodies) -> Iterator[Rows]:
        if self.problem.rows is None:
            return
        rows = self.problem.rows.frames(bodies.frames)
        group = torch.as_tensor(self.problem.samples.group)
        points = self.samples(bodies.vectors)
        residual = cloud_term.residuals(points, rows, bodies.thickness, group)
        yield Rows.of_bodies(residual[..., None], rows.weight)

    def _self_rows(self, bodies: Bodies) -> Iterator[Rows]:
        pairs = self.problem.pairs
        if pairs is None:
            return
        points = self.paired(bodies.vectors)
        body, at = (bodies.frames[:, None] == pairs.frame).nonzero(as_tuple=True)
        gap = points[body, pairs.inner[at]] - points[body, pairs.outer[at]]
        depth = -(pairs.normal[at] * gap).sum(1, keepdim=True) - self_term.SELF_TOLERANCE_M
        weight = depth.new_full((len(at),), self.problem.self_weight * self_term.SELF_WEIGHT)
        yield Rows(depth.clamp_min(0), weight, body, self_term.SELF_REACH_M)

    def _prior_rows(self, bodies: Bodies) -> Iterator[Rows]:
        problem, vectors = self.problem, bodies.vectors
        first = TRANSL.stop + (problem.model.num_betas if problem.one_shape else 0)
        parts = [(vectors[:, first:], 1.0)]
        if problem.pose is not None:
            mean, precision = (part[bodies.frames] for part in problem.pose)
            root = torch.linalg.cholesky(precision).mT  # precision = root^T root
            parts.append(((root @ (vectors[:, 3:66] - mean)[..., None])[..., 0], 1.0))
        *alone, left, right = prior_rows(problem.model, vectors, body_pose=problem.pose is None)
        parts += [(rows.residuals, weight**2) for rows, weight in alone]
        parts += [(rows.residuals, problem.hand_share) for rows, _ in (left, right)]
        for residual, weight in parts:
            yield Rows.of_bodies(residual[..., None], torch.full_like(residual, weight))
