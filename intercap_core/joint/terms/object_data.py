"""Object data: E_O of equation 6 from the object track, and no object in place of E_O.

The tracker ends at the minimum of equation 1, and its covariance is the energy's curvature there.
E_O is the quadratic form of the two,

    E_O = d^T C^-1 d / 2,    d = offset (turn, shift) from the tracked pose, C its covariance,

so that the joint fit need not compare images again. The spread between several possible poses is
not part of C: between two of them the images support nothing. A frame in which the object is lost
has a wide C: it stays near the interpolated pose unless contact or its neighbours move it. No
setting weighs E_O: its strength is the covariance.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.joint.equations import BandedEquations
from intercap_core.joint.sequential import TrackedPoses
from intercap_core.joint.state import OBJECT, State
from intercap_core.joint.terms.term import Equation, JointTerm


class ObjectData(JointTerm):
    """E_O about tracked poses."""

    name = "object_data"
    equation = Equation(
        symbol="E_O of the track",
        source="6",
        formula="instead of E_O if `joint.look_again` is false: d^T C^-1 d / 2, d the offset from "
        "the tracked pose and C the track's covariance",
        settings=("look_again",),
    )

    def __init__(self, tracked: TrackedPoses) -> None:
        self._poses = tracked

    def add(self, state: State, equations: BandedEquations) -> None:
        equations.add_blocks(self.name, OBJECT, *self._equations(self._poses.information, state))

    def linearise_views(
        self, used: np.ndarray, state: State
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """E_O's matrix (T, 6, 6), gradient (T, 6) and energy (T,) at ``state`` by some images.

        The track states no information of single images. All views that show the object have equal
        shares of it, as have both images of a view. Those in the mask ``used`` (T, C, 2) count.
        """
        seen = self._poses.share.sum(axis=1) > 0
        kept = np.where(seen, (self._poses.share * used.mean(axis=2)).sum(axis=1), 1.0)
        return self._equations(kept[:, None, None] * self._poses.information, state)

    def _equations(
        self, information: np.ndarray, state: State
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Matrix, gradient and energy about the tracked poses, by ``information`` (T, 6, 6)."""
        poses = self._poses
        turn = Rotation.from_matrix(state.rotation @ poses.rotation.transpose(0, 2, 1))
        offset = np.concatenate([turn.as_rotvec(), state.translation - poses.translation], axis=1)
        gradient = np.einsum("tij,tj->ti", information, offset)
        return information, gradient, 0.5 * (offset * gradient).sum(axis=1)


class NoObject(JointTerm):
    """In place of E_O without an object, or if its track is lost in all frames.

    It keeps the equations definite over the object's unknowns, which no term constrains. It has no
    energy, and the object's poses are NaN throughout.
    """

    name = "no_object"
    equation = Equation(
        symbol="no object", source="beyond", formula="0; keeps the equations definite"
    )

    def __init__(self) -> None:
        pass

    def add(self, state: State, equations: BandedEquations) -> None:
        """Add ones to the diagonal, so that the step of these unknowns is 0."""
        equations.hold(OBJECT)
