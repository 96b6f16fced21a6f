"""The terms of the body's energy E_B (equation 2 and its parts 3 to 5), one class each, in torch.

This is the readable form, and the one that runs on a GPU; :mod:`.compiled_terms` gives the same on
the CPU. With a licensed body file, costs and gradients know pose blend shapes in full. The
Gauss-Newton matrices of E_J and E_D know them by the joints of a point's own limb, that of E_P_self
not at all, since all of them would make every block of the normal equations dense: see
:mod:`intercap_core.body.correctives_kernel`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from intercap_core.body.model import BodyModel
from intercap_core.body_fit import body_cloud, body_keypoints, body_priors, body_self
from intercap_core.body_fit.body_cloud import CloudRows
from intercap_core.body_fit.body_keypoints import Keypoints, PointTerm
from intercap_core.body_fit.body_samples import Samples
from intercap_core.body_fit.constants import KEYPOINT_SCALE
from intercap_core.body_fit.terms import Bodies, Columns, Observations
from intercap_core.geometry.solve.levenberg_marquardt import NormalEquations

_CHUNK = 32  # frames whose dense rows are held at once


class Term(Protocol):
    """One term of E_B."""

    def cost(self, observed: Observations, bodies: Bodies) -> Tensor:
        """(b,)"""
        ...

    def add(
        self,
        observed: Observations,
        bodies: Bodies,
        columns: Columns,
        equations: NormalEquations,
    ) -> None:
        """Add cost (b,), gradient (b,n) and Gauss-Newton matrix (b,n,n) in place."""
        ...


@dataclass(frozen=True)
class KeypointTerm:
    """(3) E_J = sum over views v, keypoints i of w_i^v rho( |Pi^v(X_i) - J_i^v| / sigma_i^v ) / 2.

    X_i is the model's keypoint with its offset in the frame of the bone that carries it, Pi^v the
    projection of view v, J_i^v the detection, w its confidence, sigma its standard deviation (the
    paper's k is 1 / sigma^2), rho that of Geman and McClure. Triangulated keypoints, where there
    are any, count in the same way by their distance in metres. See
    :mod:`intercap_core.body_fit.body_keypoints`.
    """

    model: BodyModel

    def cost(self, observed: Observations, bodies: Bodies) -> Tensor:
        """See :class:`Term`."""
        return self._of_points(observed, self._keypoints(observed, bodies), bodies.frames).cost

    def add(
        self,
        observed: Observations,
        bodies: Bodies,
        columns: Columns,
        equations: NormalEquations,
    ) -> None:
        """See :class:`Term`."""
        keypoints = self._keypoints(observed, bodies, columns.parameters)
        term = self._of_points(observed, keypoints, bodies.frames)
        n, at = len(columns.parameters), columns.offsets_at
        cost, gradient, hessian = equations
        by_body, block = body_keypoints.assemble(term, keypoints)
        cost += term.cost
        gradient[:, :n] += by_body
        hessian[:, :n, :n] += block
        if columns.offsets:
            by_offset, cross, block = body_keypoints.assemble_offsets(
                term, keypoints, columns.offsets
            )
            gradient[:, at] += by_offset
            hessian[:, at, at] += block
            hessian[:, :n, at] += cross
            hessian[:, at, :n] += cross.transpose(1, 2)

    def _keypoints(
        self, observed: Observations, bodies: Bodies, columns: Tensor | None = None
    ) -> Keypoints:
        return body_keypoints.evaluate(
            self.model,
            self.model.parameters(bodies.vectors),
            observed.keypoints,
            bodies.offsets,
            derivatives=columns is not None,
            columns=columns,
        )

    def _of_points(self, observed: Observations, keypoints: Keypoints, index: Tensor) -> PointTerm:
        """Cost, gradient and matrix of views and targets by the points, summed."""
        views, targets, terms = observed.views, observed.targets, []
        if views is not None:
            terms.append(
                body_keypoints.reprojection(
                    keypoints.points,
                    views.observed[index],
                    views.confidence[index],
                    views.sigma[index],
                    views.lenses,
                    views.colour_from_master,
                    scale=KEYPOINT_SCALE,
                    shift=None if views.shift is None else views.shift[index],
                )
            )
        if targets is not None:
            terms.append(
                body_keypoints.triangulated(
                    keypoints.points,
                    targets.points[index],
                    targets.confidence[index],
                    sigma=targets.sigma,
                    scale=KEYPOINT_SCALE,
                )
            )
        if not terms:
            raise ValueError("the problem has neither views nor targets")
        return PointTerm(*(sum(part[1:], start=part[0]) for part in zip(*terms, strict=True)))


@dataclass(frozen=True)
class CloudTerm:
    """(4) E_D = sum over samples s of weight_s e_s^2 / 2, e_s = target_s - n_s . v_s - c_g(s).

    v_s is a sample of the skin, n_s the surface's normal there, target_s the mean place along it of
    the person's points that were matched to the sample, c_g the thickness of its covering. See
    :mod:`intercap_core.body_fit.body_cloud`.
    """

    model: BodyModel
    sample_ids: Tensor
    group: Tensor

    def cost(self, observed: Observations, bodies: Bodies) -> Tensor:
        """See :class:`Term`."""
        if observed.rows is None:
            return bodies.vectors.new_zeros(len(bodies.frames))
        params = self.model.parameters(bodies.vectors)
        points = self.model.forward(params, vertex_ids=self.sample_ids).vertices
        rows = CloudRows(*(part[bodies.frames] for part in observed.rows))
        return body_cloud.cost(points, rows, bodies.thickness, self.group)

    def add(
        self,
        observed: Observations,
        bodies: Bodies,
        columns: Columns,
        equations: NormalEquations,
    ) -> None:
        """See :class:`Term`."""
        if observed.rows is None:
            return
        params = self.model.parameters(bodies.vectors)
        linear = self.model.linearise(params, vertex_ids=self.sample_ids)
        of_own_limb = linear.with_correctives_of(linear.selection.limbs.moved_by_point())
        rows = CloudRows(*(part[bodies.frames] for part in observed.rows))
        by, by_of_own_limb = (
            one.along(rows.normal[:, :, None])[:, :, 0][..., columns.parameters]
            for one in (linear, of_own_limb)
        )
        found = body_cloud.assemble(
            linear.vertices, by, by_of_own_limb, rows, bodies.thickness, self.group
        )
        n, at = len(columns.parameters), columns.coverings_at
        cost, gradient, hessian = equations
        cost += found.cost
        gradient[:, :n] += found.gradient
        hessian[:, :n, :n] += found.hessian
        if columns.coverings:
            gradient[:, at] += found.gradient_u
            hessian[:, at, at] += found.hessian_u
            hessian[:, :n, at] += found.cross
            hessian[:, at, :n] += found.cross.transpose(1, 2)


@dataclass(frozen=True)
class SelfPenetrationTerm:
    """(5) E_P_self = weight sum over pairs of rho(d) / 2, d = max(0, -n . (p - q) - tolerance).

    p is a sample of one part of the body, q the point of another part that it is behind, n the
    normal there. See :mod:`intercap_core.body_fit.body_self`.
    """

    model: BodyModel

    def cost(self, observed: Observations, bodies: Bodies) -> Tensor:
        """See :class:`Term`."""
        if observed.pairs is None:
            return bodies.vectors.new_zeros(len(bodies.frames))
        params = self.model.parameters(bodies.vectors)
        inside = body_self.cost(self.model, params, observed.pairs, bodies.frames)
        return observed.self_weight * inside

    def add(
        self,
        observed: Observations,
        bodies: Bodies,
        columns: Columns,
        equations: NormalEquations,
    ) -> None:
        """See :class:`Term`."""
        if observed.pairs is None:
            return
        found = body_self.assemble(
            self.model,
            self.model.parameters(bodies.vectors),
            observed.pairs,
            bodies.frames,
            columns.parameters,
        )
        if found is None:
            return
        n, weight = len(columns.parameters), observed.self_weight
        equations.cost.index_add_(0, found.present, weight * found.cost)
        equations.gradient[found.present, :n] += weight * found.gradient
        equations.hessian[found.present, :n, :n] += weight * found.hessian


@dataclass(frozen=True)
class PriorTerm:
    """E_theta_b + E_theta_h + E_theta_f + E_alpha + E_psi, and E_beta of a frame's own shape.

    The priors of equation 2, and joint limits beyond the paper: see
    :mod:`intercap_core.body_fit.body_priors`. E_beta of a shared shape is in :mod:`.layout`.
    """

    model: BodyModel

    def cost(self, observed: Observations, bodies: Bodies) -> Tensor:
        """See :class:`Term`."""
        pose = None if observed.pose is None else observed.pose.of_frames(bodies.frames)
        return body_priors.cost(
            self.model,
            bodies.vectors,
            shape=observed.shape_prior,
            pose=pose,
            hand_share=observed.hand_share,
        )

    def add(
        self,
        observed: Observations,
        bodies: Bodies,
        columns: Columns,
        equations: NormalEquations,
    ) -> None:
        """See :class:`Term`."""
        cost, gradient, hessian = body_priors.assemble(
            self.model,
            bodies.vectors,
            shape=observed.shape_prior,
            pose=None if observed.pose is None else observed.pose.of_frames(bodies.frames),
            hand_share=observed.hand_share,
        )
        at, n = columns.parameters, len(columns.parameters)
        equations.cost.add_(cost)
        equations.gradient[:, :n] += gradient[:, at]
        equations.hessian[:, :n, :n] += hessian[:, at][:, :, at]


class TorchTerms:
    """See :class:`.terms.Terms`; ``terms`` in the order in which they are summed."""

    def __init__(self, model: BodyModel, samples: Samples) -> None:
        def tensor(values: object) -> Tensor:
            return torch.as_tensor(values, device=model.device)

        self.terms: tuple[Term, ...] = (
            KeypointTerm(model),
            CloudTerm(model, tensor(samples.vertex), tensor(samples.group)),
            SelfPenetrationTerm(model),
            PriorTerm(model),
        )

    def cost(self, observed: Observations, bodies: Bodies) -> Tensor:
        """See :meth:`.terms.Terms.cost`."""
        total = bodies.vectors.new_zeros(len(bodies.frames))
        for at in _chunks(len(total)):
            for term in self.terms:
                total[at] += term.cost(observed, _part(bodies, at))
        return total

    def add_equations(
        self,
        observed: Observations,
        bodies: Bodies,
        columns: Columns,
        equations: NormalEquations,
    ) -> None:
        """See :meth:`.terms.Terms.add_equations`."""
        for at in _chunks(len(bodies.frames)):
            part = NormalEquations(*(whole[at] for whole in equations))
            for term in self.terms:
                term.add(observed, _part(bodies, at), columns, part)


def _part(bodies: Bodies, at: slice) -> Bodies:
    return bodies._replace(vectors=bodies.vectors[at], frames=bodies.frames[at])


def _chunks(count: int) -> list[slice]:
    return [slice(i, i + _CHUNK) for i in range(0, count, _CHUNK)]
