"""Object data: E_O of equation 6, the images' evidence on the object's pose in every frame.

The tracker ends at the minimum of equation 1, and its covariance gives the energy's curvature
there. E_O is taken as the quadratic form of the two,

    E_O = d^T C^-1 d / 2,    d = offset (turn, shift) from the tracked pose, C its covariance,

so the joint fit need not compare images again. What other possible poses add to a covariance is
left out: between two of them the images support nothing. A frame in which the object is lost has a
wide C: it stays near the interpolated pose unless contact or its neighbours move it; one whose pose
follows from annotated ones has theirs. No setting
weighs E_O: its strength is the covariance.

In place of E_O where there is no object: a person alone, or a track that is not believed.

Nothing is known of the object's unknowns and nothing moves them; their poses are NaN throughout.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.sequential import TrackedPoses
from intercap_core.joint.state import OBJECT, State
from intercap_core.joint.terms.term import Term


class ObjectData(Term):
    """E_O about tracked poses, for the cameras' time offsets that were taken last."""

    name = "object_data"

    def __init__(self, tracked: TrackedPoses) -> None:
        self._tracked = self._poses = tracked

    def take_offsets(self, time_offset: np.ndarray) -> None:
        """Compare with the poses that offsets (C,), seconds, give from now on."""
        self._poses = self._tracked.at(time_offset)

    def add(self, state: State, equations: NormalEquations) -> None:
        """Add E_O at ``state``."""
        equations.add_blocks(self.name, OBJECT, *self._equations(self._poses.information, state))

    def of_views(self, used: np.ndarray, state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """E_O's matrix (T, 6, 6), gradient (T, 6) and energy (T,) at ``state``, by the share of the
        evidence that the views ``used`` (T, C) have."""
        seen = self._poses.share.sum(axis=1) > 0
        kept = np.where(seen, (self._poses.share * used).sum(axis=1), 1.0)
        return self._equations(kept[:, None, None] * self._poses.information, state)

    def _equations(
        self, information: np.ndarray, state: State
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        poses = self._poses
        turn = Rotation.from_matrix(state.rotation @ poses.rotation.transpose(0, 2, 1))
        offset = np.concatenate([turn.as_rotvec(), state.translation - poses.translation], axis=1)
        gradient = np.einsum("tij,tj->ti", information, offset)
        return information, gradient, 0.5 * (offset * gradient).sum(axis=1)


class NoObject(Term):
    """Keeps the equations definite over unknowns that no term knows; no energy."""

    name = "no_object"

    def take_offsets(self, time_offset: np.ndarray) -> None:
        """Nothing was exposed."""

    def add(self, state: State, equations: NormalEquations) -> None:
        """Add ones to the diagonal: the step of these unknowns is 0."""
        equations.hold(OBJECT)
