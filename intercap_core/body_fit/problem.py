"""The body's energy E_B (equation 2) over all frames, as the solver wants it.

Own parameters of a frame are chosen columns of the body's parameter vector. Shared by all frames
are, in this order: betas (where one shape is fitted), the offsets of the 25 body keypoints, and the
logarithm u of the coverings' thickness.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import TRANSL
from intercap_core.body.vposer import PoseGaussian
from intercap_core.energy import body_cloud, body_keypoints, body_priors, body_self
from intercap_core.energy.body_cloud import CloudRows
from intercap_core.energy.body_keypoints import Keypoints, KeypointSet, PointTerm
from intercap_core.energy.body_samples import COVERINGS, Samples
from intercap_core.solve.levenberg_marquardt import NormalEquations

if TYPE_CHECKING:
    from intercap_core.body_fit.compiled import Terms

NUM_OFFSETS = 25  # OpenPose's body keypoints
KEYPOINT_SCALE = 4.0  # sigmas at which a keypoint starts to count as an outlier
_CHUNK = 32  # frames whose dense rows are held at once

# The detector's idea of a joint differs from the body model's by about this much.
OFFSET_SIGMA = 0.010
# How much one frame's data outweigh what they are worth for quantities that never change: their
# errors persist over frames, so priors on shared parameters count once for each so many frames.
_OFFSET_PRIOR_PER_FRAME = 0.3
_SHAPE_PRIOR_PER_FRAME = 1.0  # what a frame with a shape of its own has
_COVERING_PRIOR_PER_FRAME = 2.0


@dataclass
class Views:
    """What E_J compares with, for the problem's K keypoints.

    observed (T,C,K,2) px, confidence (T,C,K), sigma (T,C,K) px, lenses (C,13),
    colour_from_master (C,4,4), shift (T,C,K,3) m or None.
    """

    observed: Tensor
    confidence: Tensor
    sigma: Tensor
    lenses: Tensor
    colour_from_master: Tensor
    shift: Tensor | None = None


@dataclass
class Targets:
    """Triangulated chosen keypoints (T,K,3) with confidence (T,K) and one sigma in metres."""

    points: Tensor
    confidence: Tensor
    sigma: float


@dataclass
class BodyProblem:
    """E_B of T frames; see :class:`intercap_core.solve.levenberg_marquardt.Problem`.

    keypoints: those that take part, the 25 of the body first. base (T,P): parameters that are not
    fitted keep these values. columns (n,): own parameters. one_shape: betas are shared; else they
    belong in ``columns`` (or stay). offsets (25,3) and the thickness' logarithms u (G,) are fitted
    where ``fit_shared`` says so, else fixed. touching: the body's parts that are inside each other,
    and the weight of that. pose: what a learned prior says of each frame's pose.
    """

    model: BodyModel
    keypoints: KeypointSet
    samples: Samples
    base: Tensor
    columns: Tensor
    one_shape: bool
    offsets: Tensor
    u: Tensor
    views: Views | None = None
    targets: Targets | None = None
    rows: CloudRows | None = None
    touching: body_self.Pairs | None = None
    self_weight: float = 1.0
    pose: PoseGaussian | None = None
    fit_shared: bool = False
    _sample_ids: Tensor = field(init=False)
    _group: Tensor = field(init=False)

    def __post_init__(self) -> None:
        device = self.base.device
        self._sample_ids = torch.as_tensor(self.samples.vertex, device=device)
        self._group = torch.as_tensor(self.samples.group, device=device)
        self._rest = torch.tensor([c.thickness for c in COVERINGS]).to(self.base)
        self._spread = torch.tensor([c.spread for c in COVERINGS]).to(self.base)

    @property
    def is_compiled(self) -> bool:
        """Whether the terms are summed by compiled kernels: on the CPU."""
        return self.base.device.type == "cpu"

    @cached_property
    def _terms(self) -> Terms:
        from intercap_core.body_fit.compiled import Terms

        return Terms(self.model, self.samples)

    # --- layout of the shared parameters -----------------------------------------------------

    @property
    def shape_columns(self) -> slice:
        return slice(TRANSL.stop, TRANSL.stop + self.model.num_betas)

    def shared_start(self) -> Tensor:
        """The shared parameters (m,) as they stand."""
        parts = []
        if self.one_shape:
            parts.append(self.base[:, self.shape_columns].mean(0))
        if self.fit_shared:
            parts += [self.offsets.reshape(-1), self.u]
        return torch.cat(parts) if parts else self.base.new_zeros(0)

    def _split(self, shared: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        """betas or None, offsets (K,3) of the chosen keypoints, u (G,)."""
        betas, offsets, u = None, self.offsets, self.u
        if self.one_shape:
            betas, shared = shared[: self.model.num_betas], shared[self.model.num_betas :]
        if self.fit_shared:
            offsets = shared[: 3 * NUM_OFFSETS].reshape(NUM_OFFSETS, 3)
            u = shared[3 * NUM_OFFSETS :]
        rest = offsets.new_zeros(len(self.keypoints.index) - NUM_OFFSETS, 3)
        return betas, torch.cat([offsets, rest]), u

    def accept(self, own: Tensor, shared: Tensor) -> None:
        """Take over a solution: base, offsets and u."""
        betas, offsets, u = self._split(shared)
        everyone = torch.arange(len(self.base), device=self.base.device)
        self.base = self._vector(own, betas, everyone)
        self.offsets, self.u = offsets[:NUM_OFFSETS].clone(), u.clone()

    def own_start(self) -> Tensor:
        """The own parameters (T,n) as they stand."""
        return self.base[:, self.columns]

    def thickness(self) -> Tensor:
        """(N,) of the covering at each sample, metres."""
        return self.thickness_of_group()[self._group]

    def thickness_of_group(self) -> Tensor:
        """(G,) of each covering, metres."""
        return self._rest * self.u.exp()

    def _vector(self, own: Tensor, betas: Tensor | None, index: Tensor) -> Tensor:
        x = self.base[index].clone()
        x[:, self.columns] = own
        if betas is not None:
            x[:, self.shape_columns] = betas
        return x

    # --- the energy --------------------------------------------------------------------------

    def cost(self, own: Tensor, shared: Tensor, index: Tensor) -> Tensor:
        """(b,)"""
        if self.is_compiled:
            betas, offsets, u = self._split(shared)
            x = self._vector(own, betas, index)
            total = self._terms.cost(self, x, offsets, self._rest * u.exp(), index)
            return total + self._shared_prior(shared)
        return torch.cat([self._cost(own[at], shared, index[at]) for at in _chunks(len(index))])

    def _cost(self, own: Tensor, shared: Tensor, index: Tensor) -> Tensor:
        betas, offsets, u = self._split(shared)
        x = self._vector(own, betas, index)
        params = self.model.parameters(x)
        keypoints = body_keypoints.evaluate(
            self.model, params, self.keypoints, offsets, derivatives=False
        )
        total = self._points(keypoints, index).cost + self._prior_cost(x, shared, index)
        if self.rows is not None:
            points = self.model.forward(params, vertex_ids=self._sample_ids).vertices
            rows = CloudRows(*(part[index] for part in self.rows))
            total = total + body_cloud.cost(points, rows, self._rest * u.exp(), self._group)
        if self.touching is not None:
            inside = body_self.cost(self.model, params, self.touching, index)
            total = total + self.self_weight * inside
        return total

    def linearise(self, own: Tensor, shared: Tensor, index: Tensor) -> NormalEquations:
        """Normal equations by own and shared parameters, own first."""
        if self.is_compiled:
            return self._linearise_compiled(own, shared, index)
        parts = [self._linearise(own[at], shared, index[at]) for at in _chunks(len(index))]
        return NormalEquations(*(torch.cat(p) for p in zip(*parts, strict=True)))

    def _linearise(self, own: Tensor, shared: Tensor, index: Tensor) -> NormalEquations:
        betas, offsets, u = self._split(shared)
        x = self._vector(own, betas, index)
        params = self.model.parameters(x)
        columns = self.columns
        if self.one_shape:
            shape = torch.arange(x.shape[1], device=x.device)[self.shape_columns]
            columns = torch.cat([columns, shape])
        n = len(columns)
        size = own.shape[1] + len(shared)
        gradient = x.new_zeros(len(x), size)
        hessian = x.new_zeros(len(x), size, size)
        keypoints = body_keypoints.evaluate(
            self.model, params, self.keypoints, offsets, derivatives=True, columns=columns
        )
        term = self._points(keypoints, index)
        gradient[:, :n], hessian[:, :n, :n] = body_keypoints.assemble(term, keypoints)
        offset_at = slice(n, n + 3 * NUM_OFFSETS)
        u_at = slice(n + 3 * NUM_OFFSETS, size)
        if self.fit_shared:
            g, cross, block = body_keypoints.assemble_offsets(term, keypoints, NUM_OFFSETS)
            gradient[:, offset_at] += g
            hessian[:, offset_at, offset_at] += block
            hessian[:, :n, offset_at] += cross
            hessian[:, offset_at, :n] += cross.transpose(1, 2)
        total = term.cost
        if self.rows is not None:
            linear = self.model.linearise(params, vertex_ids=self._sample_ids)
            rows = CloudRows(*(part[index] for part in self.rows))
            by = linear.along(rows.normal[:, :, None])[:, :, 0][..., columns]
            cloud = body_cloud.assemble(
                linear.vertices, by, rows, self._rest * u.exp(), self._group
            )
            gradient[:, :n] += cloud.gradient
            hessian[:, :n, :n] += cloud.hessian
            if self.fit_shared:
                gradient[:, u_at] += cloud.gradient_u
                hessian[:, u_at, u_at] += cloud.hessian_u
                hessian[:, :n, u_at] += cloud.cross
                hessian[:, u_at, :n] += cloud.cross.transpose(1, 2)
            total = total + cloud.cost
        if self.touching is not None:
            inside = body_self.assemble(self.model, params, self.touching, index, columns)
            if inside is not None:
                gradient[inside.present, :n] += self.self_weight * inside.gradient
                hessian[inside.present, :n, :n] += self.self_weight * inside.hessian
                total = total.index_add(0, inside.present, self.self_weight * inside.cost)
        cost, prior_gradient, prior_hessian = body_priors.assemble(
            self.model, x, shape=not self.one_shape, pose=self._pose(index)
        )
        own_at = slice(0, own.shape[1])
        gradient[:, own_at] += prior_gradient[:, self.columns]
        hessian[:, own_at, own_at] += prior_hessian[:, self.columns][:, :, self.columns]
        normal = NormalEquations(total + cost, gradient, hessian)
        self._add_shared_prior(shared, normal)
        return normal

    def _linearise_compiled(self, own: Tensor, shared: Tensor, index: Tensor) -> NormalEquations:
        from intercap_core.body_fit.compiled import Columns

        betas, offsets, u = self._split(shared)
        x = self._vector(own, betas, index)
        count, n = own.shape
        size = n + len(shared)
        place = np.full(x.shape[1], -1)
        place[self.columns.numpy()] = np.arange(n)
        if self.one_shape:
            place[self.shape_columns] = n + np.arange(self.model.num_betas)
            n += self.model.num_betas
        covering = np.full(len(u), -1)
        if self.fit_shared:
            covering = np.arange(size - len(u), size)
        columns = Columns(place, covering, n, NUM_OFFSETS if self.fit_shared else 0)
        normal = NormalEquations(
            x.new_zeros(count), x.new_zeros(count, size), x.new_zeros(count, size, size)
        )
        thickness = self._rest * u.exp()
        self._terms.add_equations(self, x, offsets, thickness, index, columns, normal)
        self._add_shared_prior(shared, normal)
        return normal

    def _points(self, keypoints: Keypoints, index: Tensor) -> PointTerm:
        """What views and targets say about the points, together."""
        views, targets, terms = self.views, self.targets, []
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

    def _pose(self, index: Tensor) -> PoseGaussian | None:
        return None if self.pose is None else self.pose.of_frames(index)

    def _prior_cost(self, x: Tensor, shared: Tensor, index: Tensor) -> Tensor:
        cost = body_priors.cost(self.model, x, shape=not self.one_shape, pose=self._pose(index))
        return cost + self._shared_prior(shared)

    def _shared_prior(self, shared: Tensor) -> Tensor:
        """Each frame's cost of the shared parameters."""
        if not len(shared):
            return shared.new_zeros(())
        return 0.5 * (self._shared_precision() * shared**2).sum()

    def _add_shared_prior(self, shared: Tensor, normal: NormalEquations) -> None:
        if len(shared):
            precision, first = self._shared_precision(), normal.gradient.shape[1] - len(shared)
            normal.cost.add_(self._shared_prior(shared))
            normal.gradient[:, first:] += precision * shared
            normal.hessian.diagonal(dim1=1, dim2=2)[:, first:] += precision

    def shared_counts(self) -> Tensor:
        """How often the Gaussian of each shared parameter (m,) counts: once for so many frames,
        whose data are then worth one over it independent measurements."""
        parts = []
        if self.one_shape:
            parts.append(self.base.new_full((self.model.num_betas,), _SHAPE_PRIOR_PER_FRAME))
        if self.fit_shared:
            parts.append(self.base.new_full((3 * NUM_OFFSETS,), _OFFSET_PRIOR_PER_FRAME))
            parts.append(torch.full_like(self.u, _COVERING_PRIOR_PER_FRAME))
        return torch.cat(parts) if parts else self.base.new_zeros(0)

    def _shared_precision(self) -> Tensor:
        """Precision (m,) of the shared parameters' Gaussian about zero, in each frame."""
        spread = []
        if self.one_shape:
            spread.append(self.base.new_ones(self.model.num_betas))
        if self.fit_shared:
            spread.append(self.base.new_full((3 * NUM_OFFSETS,), OFFSET_SIGMA))
            spread.append(self._spread)
        return self.shared_counts() / torch.cat(spread) ** 2


def _chunks(count: int) -> list[slice]:
    return [slice(i, i + _CHUNK) for i in range(0, count, _CHUNK)] or [slice(0, 0)]
