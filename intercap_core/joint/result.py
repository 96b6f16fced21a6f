"""What the joint fit has found, read back from its artefact."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.artefacts import Artefact
from intercap_core.geometry.camera.rig import Rig
from intercap_core.joint.cameras import Cameras
from intercap_core.joint.sequential import pose_vector
from intercap_core.joint.state import State
from intercap_core.schemas import JOINT

# Among the reasons of a flag.
CONTRADICTED = "the images contradict the object's pose"
CARRIED = "object not seen, carried from annotated poses"


@dataclass(frozen=True, eq=False)
class JointResult:
    """The ``state``, ``probability`` (T, R) of contact and what is ``annotated`` (T, R) of it, 1
    touching, the ``cameras`` with their ``time_offset`` (C,), seconds, the frames (T,) that are
    ``flagged``, and those among them in which the images have ``contradicted`` the object's pose.
    """

    state: State
    probability: np.ndarray
    annotated: np.ndarray
    cameras: Cameras
    time_offset: np.ndarray
    flagged: np.ndarray
    contradicted: np.ndarray

    @classmethod
    def read(cls, path: Path, scene: Artefact) -> JointResult:
        """Read joint.h5, of cameras whose lenses are in scene.h5; raises UserError as reading
        does."""
        with artefacts.read(path, JOINT) as joint:
            state = State(
                pose_vector(joint),
                joint["betas"].astype(float),
                joint["expression"].astype(float),
                joint["rotation"].astype(float),
                joint["translation"].astype(float),
            )
            rig = Rig.from_artefact(scene).moved(joint["master_from_colour"])
            return cls(
                state,
                joint["contact_probability"].astype(float),
                joint["contact_annotated"],
                Cameras(rig, joint["depth_bias"]),
                joint["time_offset"],
                joint["flagged"],
                np.array([CONTRADICTED in reason for reason in joint.text("flag_reason")]),
            )
