"""The body's energy E_B (equation 2) over all frames, as the solver expects it.

Each frame has own parameters: chosen columns of the body's parameter vector. The shared parameters
of all frames are, in this order:
- the betas, if one shape is fitted;
- the offsets of the 25 body keypoints (:mod:`.keypoint_term`);
- the logarithms u of the thickness of the coverings (:mod:`.cloud_term`).
The priors of the shared parameters are here: E_beta of a shared shape, and beyond the paper
Gaussians of offsets and u. The other terms are listed in :mod:`.terms`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import TRANSL
from intercap_core.body_fit.definition import POINTS, Definition
from intercap_core.body_fit.shared_estimate import SharedEstimate
from intercap_core.body_fit.surface import COVERINGS, Samples
from intercap_core.body_fit.term_inputs import Bodies, Columns, TermInputs
from intercap_core.body_fit.terms import CompiledTerms
from intercap_core.geometry.solve.levenberg_marquardt import NormalEquations

NUM_OFFSETS = len(POINTS)


def columns_of(model: BodyModel, *, hands: bool, face: bool, betas: bool) -> Tensor:
    """Return the columns (n,) of a frame's own parameters in the parameter vector.

    They are global orientation, body pose and translation, and if requested those of hands, of the
    face (jaw and expression) and the betas.
    """
    pose = list(range(0, 66))  # columns: see BodyParameters
    if face:
        jaw = 3 * JOINT_INDEX["jaw"]
        pose += list(range(jaw, jaw + 3))
    if hands:
        pose += list(range(75, 165))
    pose += list(range(TRANSL.start, TRANSL.stop))
    if betas:
        pose += list(range(TRANSL.stop, TRANSL.stop + model.num_betas))
    if face:
        pose += list(range(TRANSL.stop + model.num_betas, model.num_parameters))
    return torch.tensor(pose)


# --- parameters ------------------------------------------------------------------------------


def subject_places(size: int, num_betas: int) -> Tensor:
    """Return the places (n,) of betas and coverings among ``size`` shared parameters."""
    places = torch.arange(size)
    return places[(places < num_betas) | (places >= num_betas + 3 * NUM_OFFSETS)]


class Shared(NamedTuple):
    """The parameters that all frames share."""

    betas: Tensor | None
    """(S,), or None if they are not shared."""
    offsets: Tensor
    """(25, 3) keypoint offsets, metres."""
    u: Tensor
    """(G,) logarithms of the thickness of the coverings over the usual one."""


@dataclass(frozen=True)
class ParameterLayout:
    """Places of n own and m shared parameters in the solver's vectors, and the shared priors."""

    columns: Tensor
    """(n,) columns of the own parameters in a parameter vector."""
    num_betas: int
    """Number of betas."""
    one_shape: bool
    """The betas are shared."""
    fit_shared: bool
    """Offsets and coverings are shared parameters; else they are fixed."""
    definition: Definition
    """Prior of the offsets."""
    earlier: SharedEstimate | None = None
    """Estimate from another sequence, which replaces the priors of betas and coverings."""

    @property
    def shape(self) -> slice:
        """Columns of the betas in a parameter vector."""
        return slice(TRANSL.stop, TRANSL.stop + self.num_betas)

    def equations(self) -> Columns:
        """Return the columns of the normal equations: own, then shared."""
        parameters = self.columns
        if self.one_shape:
            betas = torch.arange(self.shape.start, self.shape.stop)
            parameters = torch.cat([parameters, betas])
        if not self.fit_shared:
            return Columns(parameters, 0, 0)
        return Columns(parameters, NUM_OFFSETS, len(COVERINGS))

    def own(self, base: Tensor) -> Tensor:
        """Return the own parameters (T, n) of parameter vectors (T, P)."""
        return base[:, self.columns]

    def shared(self, base: Tensor, offsets: Tensor, u: Tensor) -> Tensor:
        """Return the shared parameters (m,); the betas are the mean of those of ``base`` (T, P)."""
        parts = []
        if self.one_shape:
            parts.append(base[:, self.shape].mean(0))
        if self.fit_shared:
            parts += [offsets.reshape(-1), u]
        return torch.cat(parts) if parts else base.new_zeros(0)

    def split(self, shared: Tensor, offsets: Tensor, u: Tensor) -> Shared:
        """Split shared parameters (m,); ``offsets`` and ``u`` are returned if they are fixed."""
        betas = None
        if self.one_shape:
            betas, shared = shared[: self.num_betas], shared[self.num_betas :]
        if self.fit_shared:
            offsets = shared[: 3 * NUM_OFFSETS].reshape(NUM_OFFSETS, 3)
            u = shared[3 * NUM_OFFSETS :]
        return Shared(betas, offsets, u)

    def vectors(self, base: Tensor, own: Tensor, betas: Tensor | None) -> Tensor:
        """Return a copy of ``base`` (b, P) with own parameters (b, n) and betas."""
        vectors = base.clone()
        vectors[:, self.columns] = own
        if betas is not None:
            vectors[:, self.shape] = betas
        return vectors

    def prior_cost(self, shared: Tensor) -> Tensor:
        """Return the cost (scalar) of the shared parameters (m,) that each frame adds."""
        mean, precision, _ = self.prior(shared)
        away = shared - mean
        return 0.5 * away @ precision @ away

    def add_prior(self, shared: Tensor, equations: NormalEquations) -> None:
        """Add this cost to the normal equations of each frame, whose last columns are shared."""
        if len(shared):
            mean, precision, _ = self.prior(shared)
            first = equations.gradient.shape[1] - len(shared)
            equations.cost.add_(self.prior_cost(shared))
            equations.gradient[:, first:] += precision @ (shared - mean)
            equations.hessian[:, first:, first:] += precision

    def prior(self, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the Gaussian prior of the m shared parameters in the floating type of ``like``.

        Errors of clothing and detector persist over frames, so T frames are fewer than T
        independent measurements. To balance that, each frame adds the prior with a factor, the
        count. A recording then weighs as much as 1 / count independent frames.

        Returns:
            (m,) means.
            (m, m) precision that each frame adds: the inverse covariance, of which row i and
                column j are multiplied by sqrt(count_i count_j).
            (m,) counts; tuned on the studio.
        """
        mean, sigma, counts = [like.new_zeros(0)], [like.new_zeros(0)], [like.new_zeros(0)]
        if self.one_shape:
            mean.append(like.new_zeros(self.num_betas))
            sigma.append(like.new_ones(self.num_betas))
            counts.append(like.new_full((self.num_betas,), 0.3))
        if self.fit_shared:
            mean.append(torch.as_tensor(self.definition.offsets).to(like).reshape(-1))
            sigma.append(torch.as_tensor(self.definition.sigma).to(like).repeat_interleave(3))
            counts.append(like.new_full((3 * NUM_OFFSETS,), 0.3))
            mean.append(like.new_zeros(len(COVERINGS)))
            sigma.append(torch.tensor([c.spread for c in COVERINGS]).to(like))
            counts.append(like.new_full((len(COVERINGS),), 0.7))
        means, per_frame = torch.cat(mean), torch.cat(counts)
        precision = torch.diag(per_frame / torch.cat(sigma) ** 2)
        if self.earlier is not None:
            places = subject_places(len(means), self.one_shape * self.num_betas)
            # parameters that are fixed have the mean of the prior
            first = 0 if self.one_shape else self.num_betas
            at, share = slice(first, first + len(places)), per_frame[places].sqrt()
            means[places] = torch.as_tensor(self.earlier.mean).to(like)[at]
            known = torch.as_tensor(self.earlier.precision).to(like)[at, at]
            precision[places[:, None], places] = share[:, None] * known * share
        return means, precision, per_frame


# --- energy ----------------------------------------------------------------------------------


@dataclass(kw_only=True)
class BodyProblem(TermInputs):
    """E_B of T frames; see :class:`intercap_core.geometry.solve.levenberg_marquardt.Problem`."""

    model: BodyModel
    samples: Samples
    """Samples of the skin for E_D and E_P_self."""
    base: Tensor
    """(T, P) current parameters. Those that are not fitted keep these values."""
    columns: Tensor
    """(n,) columns of the own parameters in ``base``."""
    offsets: Tensor
    """(25, 3) keypoint offsets, metres."""
    u: Tensor
    """(G,) logarithms of the thickness of the coverings over the usual one."""
    fit_shared: bool = False
    """Fit offsets and coverings."""
    definition: Definition = field(default_factory=Definition.unknown)
    """Prior of the offsets."""
    earlier: SharedEstimate | None = None
    """Estimate from another sequence, which replaces the priors of betas and coverings."""
    terms: CompiledTerms | None = None
    """The terms, which cache what they need of the model; None = new ones."""

    def __post_init__(self) -> None:
        self._group = torch.as_tensor(self.samples.group)
        self._usual_thickness = torch.tensor([c.thickness for c in COVERINGS]).to(self.base)
        self.terms = self._terms = self.terms or CompiledTerms(self.model, self.samples)

    @property
    def layout(self) -> ParameterLayout:
        """The current places of the parameters."""
        return ParameterLayout(
            self.columns, self.model.num_betas, self.one_shape, self.fit_shared, self.definition,
            self.earlier,
        )  # fmt: skip

    def own_start(self) -> Tensor:
        """Return the current own parameters (T, n)."""
        return self.layout.own(self.base)

    def shared_start(self) -> Tensor:
        """Return the current shared parameters (m,)."""
        return self.layout.shared(self.base, self.offsets, self.u)

    def accept(self, own: Tensor, shared: Tensor) -> None:
        """Set ``base``, ``offsets`` and ``u`` to a solution: own (T, n) and shared (m,)."""
        betas, offsets, u = self.layout.split(shared, self.offsets, self.u)
        self.base = self.layout.vectors(self.base, own, betas)
        self.offsets, self.u = offsets.clone(), u.clone()

    def thickness(self) -> Tensor:
        """Return the thickness (N,) of the covering at each sample, metres."""
        return self.thickness_of_group()[self._group]

    def thickness_of_group(self) -> Tensor:
        """Return the thickness (G,) of each covering, metres."""
        return self._usual_thickness * self.u.exp()

    def all_offsets(self, offsets: Tensor | None = None) -> Tensor:
        """Return the offsets (K, 3) of all keypoints: zero beyond the body's 25."""
        offsets = self.offsets if offsets is None else offsets
        without = offsets.new_zeros(len(self.keypoints.index) - len(offsets), 3)
        return torch.cat([offsets, without])

    def cost(self, own: Tensor, shared: Tensor, index: Tensor) -> Tensor:
        """Return the energy (b,) of the frames ``index`` (b,)."""
        terms = self._terms.cost(self, self._bodies(own, shared, index))
        return terms + self.layout.prior_cost(shared)

    def linearise(self, own: Tensor, shared: Tensor, index: Tensor) -> NormalEquations:
        """Return the normal equations of the frames by own and shared parameters, own first."""
        layout, count, zeros = self.layout, len(own), self.base.new_zeros
        size = own.shape[1] + len(shared)
        equations = NormalEquations(zeros(count), zeros(count, size), zeros(count, size, size))
        bodies = self._bodies(own, shared, index)
        self._terms.add(self, bodies, layout.equations(), equations)
        layout.add_prior(shared, equations)
        return equations

    def _bodies(self, own: Tensor, shared: Tensor, index: Tensor) -> Bodies:
        """Return the bodies of the frames ``index`` (b,) at own (b, n), shared (m,) parameters."""
        betas, offsets, u = self.layout.split(shared, self.offsets, self.u)
        return Bodies(
            self.layout.vectors(self.base[index], own, betas),
            self.all_offsets(offsets),
            self._usual_thickness * u.exp(),
            index,
        )
