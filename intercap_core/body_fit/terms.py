"""What the terms of the body's energy E_B (equation 2) are given, and what they must do.

Two forms of every term exist: :mod:`.torch_terms` states each one readably and runs on any device,
:mod:`.compiled_terms` is what the CPU uses. Both give the same cost, gradient and Gauss-Newton
matrix, and with them the same steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from torch import Tensor

from intercap_core.body.vposer import PoseGaussian
from intercap_core.body_fit.body_cloud import CloudRows
from intercap_core.body_fit.body_keypoints import KeypointSet
from intercap_core.body_fit.body_self import Pairs
from intercap_core.geometry.solve.levenberg_marquardt import NormalEquations


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


class Observations(NamedTuple):
    """What the bodies of all T frames are compared with; None = that term is off.

    views and targets belong to E_J, rows to E_D, and pairs, times self_weight, to E_P_self. pose: a
    learned prior of each frame's body pose. shape_prior: betas belong to each frame, which then has
    their prior; else they are shared, or fixed. hand_share: of an observation that E_theta_h is in
    one frame.
    """

    keypoints: KeypointSet
    views: Views | None
    targets: Targets | None
    rows: CloudRows | None
    pairs: Pairs | None
    self_weight: float
    pose: PoseGaussian | None
    shape_prior: bool
    hand_share: float


class Bodies(NamedTuple):
    """Where the energy is evaluated: ``frames`` (b,) of the observations.

    vectors (b,P) body parameters; offsets (K,3), metres, of the keypoints in the frames of their
    bones; thickness (G,) of each covering, metres.
    """

    vectors: Tensor
    offsets: Tensor
    thickness: Tensor
    frames: Tensor


class Columns(NamedTuple):
    """The columns of the normal equations, in their order.

    parameters (n,): the body parameter of each of the first n columns. Then come three columns for
    the offset of each of the first ``offsets`` keypoints, and ``coverings`` columns for the
    logarithms u of the coverings' thickness.
    """

    parameters: Tensor
    offsets: int
    coverings: int

    @property
    def offsets_at(self) -> slice:
        """The offsets' columns."""
        first = len(self.parameters)
        return slice(first, first + 3 * self.offsets)

    @property
    def coverings_at(self) -> slice:
        """The coverings' columns."""
        first = self.offsets_at.stop
        return slice(first, first + self.coverings)

    def of_parameters(self, count: int) -> np.ndarray:
        """Column (P,) of each of so many body parameters, -1 = fixed."""
        columns = np.full(count, -1)
        columns[self.parameters.cpu().numpy()] = np.arange(len(self.parameters))
        return columns

    def of_coverings(self, count: int) -> np.ndarray:
        """Column (G,) of each of so many coverings, -1 = fixed."""
        at = self.coverings_at
        return np.arange(at.start, at.stop) if self.coverings else np.full(count, -1)


class Terms(Protocol):
    """E_J + E_D + E_P_self + priors of each frame, without the prior of shared parameters."""

    def cost(self, observed: Observations, bodies: Bodies) -> Tensor:
        """(b,) of the bodies' frames. Raises ValueError without views and targets."""
        ...

    def add_equations(
        self,
        observed: Observations,
        bodies: Bodies,
        columns: Columns,
        equations: NormalEquations,
    ) -> None:
        """Add cost (b,), gradient (b,n) and Gauss-Newton matrix (b,n,n) in place."""
        ...
