"""Which parameters of E_B (equation 2) are fitted, and the priors of the shared ones.

Own parameters of a frame are chosen columns of the body's parameter vector. Shared by all frames
are, in this order: betas (where one shape is fitted), the offsets of the 25 body keypoints, and the
logarithm u of the coverings' thickness. Their priors are E_beta of a shared shape, and beyond the
paper Gaussians of offsets and u.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from intercap_core.body.parameters import TRANSL
from intercap_core.body_fit.body_samples import COVERINGS
from intercap_core.body_fit.constants import (
    COVERING_PRIOR_PER_FRAME,
    OFFSET_PRIOR_PER_FRAME,
    SHAPE_PRIOR_PER_FRAME,
)
from intercap_core.body_fit.definition import Definition
from intercap_core.body_fit.terms import Columns
from intercap_core.geometry.solve.levenberg_marquardt import NormalEquations

NUM_OFFSETS = 25  # OpenPose's body keypoints


class Shared(NamedTuple):
    """betas (S,), or None where they are not shared; offsets (25,3) m; u (G,)."""

    betas: Tensor | None
    offsets: Tensor
    u: Tensor


@dataclass(frozen=True)
class Layout:
    """Where n own and m shared parameters stand in a solver's vectors.

    columns (n,): own parameters. num_betas: length of the shape. one_shape: betas are shared.
    fit_shared: offsets and coverings are shared parameters, else fixed. definition: what is
    expected of the offsets.
    """

    columns: Tensor
    num_betas: int
    one_shape: bool
    fit_shared: bool
    definition: Definition

    @property
    def shape(self) -> slice:
        """Columns of the betas in a parameter vector."""
        return slice(TRANSL.stop, TRANSL.stop + self.num_betas)

    def equations(self) -> Columns:
        """The columns of the normal equations: own, then shared."""
        parameters = self.columns
        if self.one_shape:
            betas = torch.arange(self.shape.start, self.shape.stop, device=parameters.device)
            parameters = torch.cat([parameters, betas])
        if not self.fit_shared:
            return Columns(parameters, 0, 0)
        return Columns(parameters, NUM_OFFSETS, len(COVERINGS))

    def own(self, base: Tensor) -> Tensor:
        """Own parameters (T,n) of parameter vectors (T,P)."""
        return base[:, self.columns]

    def shared(self, base: Tensor, offsets: Tensor, u: Tensor) -> Tensor:
        """Shared parameters (m,): the mean betas of vectors (T,P), offsets (25,3) and u (G,)."""
        parts = []
        if self.one_shape:
            parts.append(base[:, self.shape].mean(0))
        if self.fit_shared:
            parts += [offsets.reshape(-1), u]
        return torch.cat(parts) if parts else base.new_zeros(0)

    def split(self, shared: Tensor, offsets: Tensor, u: Tensor) -> Shared:
        """Shared parameters (m,) by kind, the given offsets (25,3) and u (G,) where fixed."""
        betas = None
        if self.one_shape:
            betas, shared = shared[: self.num_betas], shared[self.num_betas :]
        if self.fit_shared:
            offsets = shared[: 3 * NUM_OFFSETS].reshape(NUM_OFFSETS, 3)
            u = shared[3 * NUM_OFFSETS :]
        return Shared(betas, offsets, u)

    def vectors(self, base: Tensor, own: Tensor, betas: Tensor | None) -> Tensor:
        """Parameter vectors (b,P): a copy of base (b,P) with own parameters (b,n) and betas."""
        vectors = base.clone()
        vectors[:, self.columns] = own
        if betas is not None:
            vectors[:, self.shape] = betas
        return vectors

    # --- priors of shared parameters ---------------------------------------------------------

    def prior_counts(self, like: Tensor) -> Tensor:
        """How often the Gaussian of each shared parameter (m,) counts in every frame: all frames'
        data then weigh as much as one over it independent measurements."""
        parts = []
        if self.one_shape:
            parts.append(like.new_full((self.num_betas,), SHAPE_PRIOR_PER_FRAME))
        if self.fit_shared:
            parts.append(like.new_full((3 * NUM_OFFSETS,), OFFSET_PRIOR_PER_FRAME))
            parts.append(like.new_full((len(COVERINGS),), COVERING_PRIOR_PER_FRAME))
        return torch.cat(parts) if parts else like.new_zeros(0)

    def prior_cost(self, shared: Tensor) -> Tensor:
        """Each frame's cost (scalar) of the shared parameters (m,): Gaussians."""
        if not len(shared):
            return shared.new_zeros(())
        return 0.5 * (self._precision(shared) * (shared - self._mean(shared)) ** 2).sum()

    def add_prior(self, shared: Tensor, equations: NormalEquations) -> None:
        """Add that cost to the normal equations of each frame, whose last columns are shared."""
        if len(shared):
            precision, first = self._precision(shared), equations.gradient.shape[1] - len(shared)
            equations.cost.add_(self.prior_cost(shared))
            equations.gradient[:, first:] += precision * (shared - self._mean(shared))
            equations.hessian.diagonal(dim1=1, dim2=2)[:, first:] += precision

    def _precision(self, like: Tensor) -> Tensor:
        """Precision (m,) of the shared parameters' Gaussian, in each frame."""
        spread = []
        if self.one_shape:
            spread.append(like.new_ones(self.num_betas))
        if self.fit_shared:
            spread.append(torch.as_tensor(self.definition.sigma).to(like).repeat_interleave(3))
            spread.append(torch.tensor([c.spread for c in COVERINGS]).to(like))
        return self.prior_counts(like) / torch.cat(spread) ** 2

    def _mean(self, like: Tensor) -> Tensor:
        """Mean (m,) of that Gaussian: zero but for the offsets."""
        parts = [like.new_zeros(self.num_betas)] if self.one_shape else []
        if self.fit_shared:
            parts.append(torch.as_tensor(self.definition.offsets).to(like).reshape(-1))
            parts.append(like.new_zeros(len(COVERINGS)))
        return torch.cat(parts)
