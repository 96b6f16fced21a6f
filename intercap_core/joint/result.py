"""Result of the joint fit: as it is computed, and as its artefact states it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.artefacts import Artefact
from intercap_core.flags import Flags
from intercap_core.geometry.camera.rig import Rig
from intercap_core.joint.cameras import Cameras
from intercap_core.joint.contact.annotated import AnnotationIssue
from intercap_core.joint.contact_estimate import ContactEstimate
from intercap_core.joint.sequential import pose_vector
from intercap_core.joint.state import State
from intercap_core.joint.terms.body_data import BodyResiduals
from intercap_core.schemas import JOINT

# Reasons of a flag that later stages search for.
CONTRADICTED = "the images contradict the object's pose"
BODY_INSIDE = "body deep inside the object"
OBJECT_INSIDE = "object deep inside the body"
CARRIED = "object not seen, carried from annotated poses"


class Convergence(Enum):
    """Outcome of the rounds of minimisation."""

    CONVERGED = "converged"
    """Another round would change nothing."""
    ITERATION_LIMIT = "reached the iteration limit before converging"
    """The last round still changed state, contact or cameras."""
    STALLED = "stalled"
    """No step lowered the energy: every frame is flagged."""


@dataclass(frozen=True)
class JointFit:
    """Result of the joint fit of T frames."""

    state: State  # Refined body and object
    contact: ContactEstimate  # Contact at this state
    issues: Sequence[AnnotationIssue]  # Annotated intervals that the fit contradicts
    residuals: BodyResiduals  # Distances of the body to the images
    energy_before: dict[str, float]  # Energy by term at the start
    energy_after: dict[str, float]  # Energy by term at this state
    steps: int  # Number of accepted steps
    refused: int  # Number of refused steps
    convergence: Convergence  # Outcome of the rounds
    flags: Flags  # Frames and parts not to be trusted
    cameras_corrected: bool  # Whether the cameras were corrected
    last_step_m: float  # Displacement by the last step, 95th percentile over frames, metres
    last_decrease: float  # Decrease of the energy by the last step, as a share of the energy


@dataclass(frozen=True, eq=False)
class JointResult:
    """The joint artefact of T frames, R contact regions and C cameras."""

    state: State  # Body and object
    probability: np.ndarray  # (T, R) probability of contact
    annotated: np.ndarray  # (T, R) annotation: 1 touching, 0 free, -1 no label
    cameras: Cameras  # Corrected cameras
    contradicted: np.ndarray  # (T,) frames whose images contradict the object's pose
    penetrating: np.ndarray  # (T,) frames in which body and object are deep inside each other
    camera_covariance: np.ndarray  # (C, 7, C, 7) of the cameras, see :mod:`.cameras`

    def window(self, frames: slice) -> JointResult:
        """The result of some frames."""
        return replace(
            self,
            state=self.state.window(frames),
            probability=self.probability[frames],
            annotated=self.annotated[frames],
            contradicted=self.contradicted[frames],
            penetrating=self.penetrating[frames],
        )

    @classmethod
    def read(cls, path: Path, scene: Artefact) -> JointResult:
        """Read joint.h5; the cameras' lenses are in scene.h5. Raises UserError as reading does."""
        with artefacts.read(path, JOINT) as joint:
            state = State(
                pose_vector(joint),
                joint["betas"].astype(float),
                joint["expression"].astype(float),
                joint["rotation"].astype(float),
                joint["translation"].astype(float),
            )
            rig = Rig.from_artefact(scene).moved(joint["master_from_colour"])
            reasons = joint.text("flag_reason")
            return cls(
                state,
                joint["contact_probability"].astype(float),
                joint["contact_annotated"],
                Cameras(rig, joint["depth_bias"]),
                np.array([CONTRADICTED in reason for reason in reasons]),
                np.array([BODY_INSIDE in r or OBJECT_INSIDE in r for r in reasons]),
                joint["camera_covariance"],
            )
