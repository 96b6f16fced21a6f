"""Shape and coverings of a subject with their covariance: the result of one sequence, and the prior
of another sequence of the same subject (column ``shape_from``).

Errors of shared parameters are the same in every frame, so the covariance counts a recording as
a few independent frames (:meth:`.problem.ParameterLayout.prior`). Keypoint offsets belong to the
detector and not to the subject, so they are marginalised out.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtrc

from intercap_core import artefacts
from intercap_core.body.loading import ShapePrior
from intercap_core.entries import SubjectEntry
from intercap_core.errors import UserError
from intercap_core.schemas import BODY_FIT

# Probability below which a shape is that of another person.
OTHER_PERSON = 1e-6


@dataclass(frozen=True, eq=False)
class SharedEstimate:
    """Gaussian of the m = S + G parameters of a subject: betas, then coverings."""

    sequence: str
    """Sequence that it was estimated from."""
    betas: np.ndarray
    """(S,) in units of the subject's prior; S = 0 if each frame has its own."""
    covering: np.ndarray
    """(G,) logarithms of the thickness of the coverings over the usual one."""
    covariance: np.ndarray
    """(m, m) of the parameters in this order, in their units."""

    @classmethod
    def read(
        cls, path: Path, sequence: str, subject: SubjectEntry, body_model: str, shapes: ShapePrior
    ) -> SharedEstimate:
        """Read the estimate of a body_fit artefact.

        Raises UserError if it is of another subject or body file, or has another number of betas.

        Args:
            path: body_fit artefact of another sequence.
            sequence: this sequence, for messages.
            subject: this sequence's subject.
            body_model: digest of this sequence's body file.
            shapes: prior of the subject's shape.
        """
        with artefacts.read(path, BODY_FIT) as fit:
            other, covariance = str(fit.attributes["sequence"]), fit["shared_covariance"]
            betas = fit["betas"][~fit["failed"]].astype(float)
            u = fit["covering"].astype(float)
            attributes = fit.attributes
        count = len(shapes.mean)
        shared = len(covariance) == betas.shape[1] + len(u)
        for what, actual, expected in (
            ("subject", attributes["subject"], subject.subject),
            ("body file", attributes["body_model"], body_model),
            ("number of betas", betas.shape[1], count),
            ("setting body_fit.shape", "shared" if shared else "per_frame", "shared"),
        ):
            if actual != expected:
                raise UserError(
                    f"{path}: sequence {sequence!r} has shape_from {other!r}, but the {what} of "
                    f"{other!r} is {actual}, expected {expected}; re-run stage 'body_fit' of "
                    f"{other!r}, name another sequence in the row of {sequence!r}, or clear it"
                )
        z = np.linalg.solve(shapes.root, betas.mean(0) - shapes.mean)
        to_z = block_diag(np.linalg.inv(shapes.root), np.eye(len(u)))
        return cls(other, z, u, to_z @ covariance @ to_z.T)

    def of_file(self, shapes: ShapePrior) -> np.ndarray:
        """Return the covariance (m, m) with the betas of the body file, as an artefact holds it."""
        count = len(self.betas)
        to_file = block_diag(shapes.root[:count, :count], np.eye(len(self.covariance) - count))
        return to_file @ self.covariance @ to_file.T

    @property
    def mean(self) -> np.ndarray:
        """(m,) betas, then coverings."""
        return np.concatenate([self.betas, self.covering])

    @cached_property
    def precision(self) -> np.ndarray:
        """(m, m) inverse of the covariance."""
        return np.linalg.inv(self.covariance)

    def contradicts(self, alone: SharedEstimate) -> bool:
        """Whether the shape of a fit without this prior is that of another person.

        The squared Mahalanobis distance of the betas is chi-square distributed if both estimates
        are of one person. A fit with the prior does not show it: observations that contradict the
        prior are outliers there.
        """
        shape = slice(len(self.betas))
        away = alone.betas - self.betas
        both = (self.covariance + alone.covariance)[shape, shape]
        return bool(chdtrc(len(away), away @ np.linalg.solve(both, away)) < OTHER_PERSON)
