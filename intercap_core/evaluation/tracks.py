"""Fitted bodies and object poses of a sequence, read from the artefacts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from intercap_core import artefacts
from intercap_core.body.artefact import load_model, read_parameters
from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import BodyParameters
from intercap_core.config import BodyModels
from intercap_core.flags import PARTS
from intercap_core.schemas import BODY_FIT, JOINT, OBJECT_TRACK

_TIPS = [
    KEYPOINT_NAMES.index(f"{side}_{finger}_tip")
    for side in ("left", "right")
    for finger in ("thumb", "index", "middle", "ring", "pinky")
]


@dataclass(frozen=True, eq=False)
class BodyTrack:
    """The T fitted bodies of a sequence, master frame, metres."""

    model: BodyModel
    """Body model of the fit."""
    parameters: BodyParameters
    """SMPL-X parameters of the T frames."""
    joints: np.ndarray
    """(T, 55, 3) joints of SMPL-X."""
    tips: np.ndarray
    """(T, 10, 3) fingertips, thumb to little finger, left hand first."""
    flagged: np.ndarray
    """(T,) bool: the stage marked the frame as unreliable."""
    sigma: np.ndarray | None = None
    """(T, 55) stated standard deviation of each joint along one coordinate; None after
    ``joint``."""

    def frame(self, t: int) -> np.ndarray:
        """Posed vertices (V, 3) float32 of one frame."""
        with torch.no_grad():
            return self.model.forward(self.parameters.frames(slice(t, t + 1))).vertices[0].numpy()

    def vertices(self) -> Iterator[np.ndarray]:
        """Iterate over the frames' posed vertices (V, 3) float32."""
        for start in range(0, len(self.joints), 16):  # 16 bodies take some 20 MB
            chunk = self.parameters.frames(slice(start, start + 16))
            with torch.no_grad():
                yield from self.model.forward(chunk).vertices.numpy()


@dataclass(frozen=True, eq=False)
class ObjectTrack:
    """T poses master_from_object; all NaN if the recording has no object."""

    rotation: np.ndarray
    """(T, 3, 3)."""
    translation: np.ndarray
    """(T, 3) metres."""
    flagged: np.ndarray
    """(T,) bool: the stage marked the frame as unreliable."""
    covariance: np.ndarray | None = None
    """(T, 6, 6) of rotation vector (rad) and translation (m); None after ``joint``."""

    @property
    def known(self) -> bool:
        """Whether any frame has a pose."""
        return bool(np.isfinite(self.translation).any())


def read_body(path: Path, stage: str, body_models: BodyModels, gender: str) -> BodyTrack:
    """Bodies of the artefact of stage ``"body_fit"`` or ``"joint"``.

    Raises UserError if the artefact cannot be read.
    """
    with artefacts.read(path, BODY_FIT if stage == "body_fit" else JOINT) as artefact:
        parameters = read_parameters(artefact)
        first = stage == "body_fit"
        sigma = artefact["joint_sigma"] if first else None
        if first:
            flagged = artefact["failed"] | artefact["bridged"] | artefact["uncertain"]
        else:
            flagged = artefact["flagged"][:, PARTS.index("body")]
        model = load_model(body_models, gender, artefact)
    with torch.no_grad():
        ids = model.keypoint_map.vertex_ids
        posed = model.forward(parameters, vertex_ids=ids)
        tips = model.keypoints(posed)[:, _TIPS].numpy()
    return BodyTrack(model, parameters, posed.joints.numpy(), tips, flagged, sigma)


def read_object(path: Path, stage: str) -> ObjectTrack:
    """Poses of the artefact of stage ``"object_track"`` or ``"joint"``.

    Raises UserError if the artefact cannot be read.
    """
    with artefacts.read(path, OBJECT_TRACK if stage == "object_track" else JOINT) as artefact:
        first = stage == "object_track"
        if first:
            flagged = artefact["lost"] | artefact["ambiguous"]
        else:
            flagged = artefact["flagged"][:, PARTS.index("object")]
        return ObjectTrack(
            artefact["rotation"],
            artefact["translation"],
            flagged,
            artefact["covariance"] if first else None,
        )
