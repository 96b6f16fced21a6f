"""E_O in the joint energy: the images' evidence on the object's pose, frame by frame.

The tracker ends at the minimum of equation 1 with that energy's curvature there. Around it E_O is
the quadratic form of the two, so the joint fit needs no second look at the images; a frame that
the tracker does not believe has no say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.refine.equations import NormalEquations
from intercap_core.refine.state import OBJECT, State

# The tracker's views share calibration errors, so its minimum is never surer than this.
_FLOOR = np.repeat([np.radians(0.3), 0.002], 3)


@dataclass(frozen=True)
class TrackedPoses:
    """``rotation`` (T, 3, 3), ``translation`` (T, 3) and ``information`` (T, 6, 6), the inverse
    covariance of (turn on the left, shift); zero where the track is lost."""

    rotation: np.ndarray
    translation: np.ndarray
    information: np.ndarray

    @classmethod
    def from_track(
        cls,
        rotation: np.ndarray,
        translation: np.ndarray,
        covariance: np.ndarray,
        lost: np.ndarray,
    ) -> TrackedPoses:
        """Take over an object track; ``covariance`` (T, 6, 6), ``lost`` (T,)."""
        information = np.zeros_like(covariance)
        for t in np.flatnonzero(~lost & np.isfinite(covariance).all(axis=(1, 2))):
            information[t] = np.linalg.inv(covariance[t] + np.diag(_FLOOR**2))
        return cls(rotation, translation, information)

    def add(self, state: State, out: NormalEquations) -> None:
        """Add E_O at ``state``."""
        turn = Rotation.from_matrix(state.rotation @ self.rotation.transpose(0, 2, 1))
        away = np.concatenate([turn.as_rotvec(), state.translation - self.translation], axis=1)
        pull = np.einsum("tij,tj->ti", self.information, away)
        energy = 0.5 * float(np.einsum("ti,ti->", away, pull))
        out.add_blocks("object_data", OBJECT, self.information, pull, energy)
