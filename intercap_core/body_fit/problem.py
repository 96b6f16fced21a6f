"""The body's energy E_B (equation 2) over all frames, as the solver wants it.

Which parameters it is a function of is said in :mod:`.layout`, its terms are in
:mod:`.torch_terms` and :mod:`.compiled_terms`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from intercap_core.body.model import BodyModel
from intercap_core.body.vposer import PoseGaussian
from intercap_core.body_fit import body_self
from intercap_core.body_fit.body_cloud import CloudRows
from intercap_core.body_fit.body_keypoints import KeypointSet
from intercap_core.body_fit.body_samples import COVERINGS, Samples
from intercap_core.body_fit.compiled_terms import CompiledTerms
from intercap_core.body_fit.definition import Definition
from intercap_core.body_fit.layout import Layout, Shared
from intercap_core.body_fit.terms import Bodies, Observations, Targets, Terms, Views
from intercap_core.body_fit.torch_terms import TorchTerms
from intercap_core.geometry.solve.levenberg_marquardt import NormalEquations


def terms_on(device: torch.device, model: BodyModel, samples: Samples) -> Terms:
    """The terms' quickest form on a device: compiled on the CPU, else torch."""
    form = CompiledTerms if device.type == "cpu" else TorchTerms
    return form(model, samples)


@dataclass
class BodyProblem:
    """E_B of T frames; see :class:`intercap_core.geometry.solve.levenberg_marquardt.Problem`.

    keypoints: those that take part, the 25 of the body first. base (T,P): parameters that are not
    fitted keep these values. columns (n,): own parameters. one_shape: betas are shared; else they
    belong in ``columns`` (or stay). offsets (25,3) and the thickness' logarithms u (G,) are fitted
    where ``fit_shared`` says so, else fixed. touching: the body's parts that are inside each other,
    and the weight of that. pose: a learned prior of each frame's pose. hand_share: of an
    observation that the prior of a hand's pose is in one frame, 1 where frames stand alone.
    definition: what is expected of the offsets. terms: by default the quickest form on the device
    of ``base``.
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
    hand_share: float = 1.0
    fit_shared: bool = False
    definition: Definition = field(default_factory=Definition.unknown)
    terms: Terms | None = None

    def __post_init__(self) -> None:
        device = self.base.device
        self._group = torch.as_tensor(self.samples.group, device=device)
        self._usual_thickness = torch.tensor([c.thickness for c in COVERINGS]).to(self.base)
        self._terms = self.terms or terms_on(device, self.model, self.samples)

    @property
    def layout(self) -> Layout:
        """Where the parameters stand now."""
        return Layout(
            self.columns, self.model.num_betas, self.one_shape, self.fit_shared, self.definition
        )

    @property
    def shape_columns(self) -> slice:
        """Columns of the betas in a parameter vector."""
        return self.layout.shape

    def own_start(self) -> Tensor:
        """The own parameters (T,n) as they stand."""
        return self.layout.own(self.base)

    def shared_start(self) -> Tensor:
        """The shared parameters (m,) as they stand."""
        return self.layout.shared(self.base, self.offsets, self.u)

    def shared_counts(self) -> Tensor:
        """How often the prior of each shared parameter (m,) counts in a frame."""
        return self.layout.prior_counts(self.base)

    def accept(self, own: Tensor, shared: Tensor) -> None:
        """Take over a solution: base, offsets and u."""
        found = self._split(shared)
        self.base = self.layout.vectors(self.base, own, found.betas)
        self.offsets, self.u = found.offsets.clone(), found.u.clone()

    def thickness(self) -> Tensor:
        """(N,) of the covering at each sample, metres."""
        return self.thickness_of_group()[self._group]

    def thickness_of_group(self) -> Tensor:
        """(G,) of each covering, metres."""
        return self._usual_thickness * self.u.exp()

    def cost(self, own: Tensor, shared: Tensor, index: Tensor) -> Tensor:
        """(b,)"""
        terms = self._terms.cost(self._observations(), self._bodies(own, shared, index))
        return terms + self.layout.prior_cost(shared)

    def linearise(self, own: Tensor, shared: Tensor, index: Tensor) -> NormalEquations:
        """Normal equations by own and shared parameters, own first."""
        layout, count, zeros = self.layout, len(own), self.base.new_zeros
        size = own.shape[1] + len(shared)
        equations = NormalEquations(zeros(count), zeros(count, size), zeros(count, size, size))
        self._terms.add_equations(
            self._observations(),
            self._bodies(own, shared, index),
            layout.equations(),
            equations,
        )
        layout.add_prior(shared, equations)
        return equations

    def _split(self, shared: Tensor) -> Shared:
        return self.layout.split(shared, self.offsets, self.u)

    def _bodies(self, own: Tensor, shared: Tensor, index: Tensor) -> Bodies:
        betas, offsets, u = self._split(shared)
        without = offsets.new_zeros(len(self.keypoints.index) - len(offsets), 3)
        return Bodies(
            self.layout.vectors(self.base[index], own, betas),
            torch.cat([offsets, without]),
            self._usual_thickness * u.exp(),
            index,
        )

    def _observations(self) -> Observations:
        return Observations(
            keypoints=self.keypoints,
            views=self.views,
            targets=self.targets,
            rows=self.rows,
            pairs=self.touching,
            self_weight=self.self_weight,
            pose=self.pose,
            shape_prior=not self.one_shape,
            hand_share=self.hand_share,
        )
