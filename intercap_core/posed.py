"""Vertices and joints of the body and vertices of the object in any frame of a result.

    from intercap_core.posed import open_sequence

    sequence = open_sequence("config/demo/config.yaml", "cup_drink_s02")
    moment = sequence.at(30)
    moment.body, moment.joints, moment.object_  # (V, 3), (55, 3), (Vo, 3) metres, z up

    fitted = open_sequence("config/demo/config.yaml", "cup_drink_s02", stage="body_fit", frame="k3")
    fitted.bodies(slice(0, 45, 5))  # (9, V, 3) and (9, 55, 3) in the frame of camera k3

Shapes are the same for both stages.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from intercap_core import artefacts
from intercap_core.body.artefact import load_model, read_parameters
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import BodyParameters
from intercap_core.errors import UserError
from intercap_core.flags import OF_OBJECT, PARTS
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.output.export.motion import z_up_frame
from intercap_core.project import Project, load_project
from intercap_core.schemas import BODY_FIT, JOINT, OBJECT_TRACK, SCENE

Z_UP, MASTER = "z-up", "master"  # names of coordinate frames that are no camera's


@dataclass(frozen=True, eq=False)
class Moment:
    """One frame of a sequence."""

    body: np.ndarray
    """(V, 3) vertices of the body, metres."""
    joints: np.ndarray
    """(55, 3) joints of the body, metres."""
    object_: np.ndarray
    """(Vo, 3) vertices of the object, metres; (0, 3) without an object."""
    trusted: Mapping[str, bool]
    """Whether body, hands, object and contact are not flagged."""


@dataclass(frozen=True, eq=False)
class PosedSequence:
    """The T frames of a sequence in one coordinate frame."""

    model: BodyModel
    """Body model of the subject."""
    parameters: BodyParameters
    """Body parameters of all frames."""
    mesh: ObjectMesh | None
    """Mesh of the object; None without an object."""
    rotation: np.ndarray
    """(T, 3, 3) rotation of master_from_object; NaN if the object was not found."""
    translation: np.ndarray
    """(T, 3) translation of master_from_object, metres; NaN if the object was not found."""
    frame_from_master: np.ndarray
    """(4, 4) transform to the coordinate frame of the results."""
    times: np.ndarray
    """(T,) times, seconds."""
    trusted: Mapping[str, np.ndarray]
    """Mask (T,) of the frames without a flag, by part: body, hands, object and contact. Without an
    object there are the first two; body_fit has body and object."""
    frame: str
    """Description of the coordinate frame; for z-up with the source of the up direction."""

    def __len__(self) -> int:
        return len(self.rotation)

    @property
    def faces(self) -> np.ndarray:
        """(F, 3) vertex indices of the body's faces."""
        return self.model.faces.cpu().numpy()

    def at(self, frame: int) -> Moment:
        """The frame with this index, negative from the end; raises IndexError if there is none."""
        if not -len(self) <= frame < len(self):
            raise IndexError(f"frame {frame} of {len(self)}")
        one = [frame % len(self)]
        vertices, joints = self.bodies(one)
        trusted = {part: bool(mask[frame]) for part, mask in self.trusted.items()}
        return Moment(vertices[0], joints[0], self.objects(one)[0], trusted)

    def bodies(self, frames: slice | Sequence[int] = slice(None)) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (N, V, 3) and joints (N, 55, 3) of the chosen frames, metres."""
        vector = self.parameters.vector()[np.arange(len(self))[frames]]
        with torch.no_grad():
            posed = self.model.forward(self.model.parameters(vector))
        return self._placed(posed.vertices.numpy()), self._placed(posed.joints.numpy())

    def objects(self, frames: slice | Sequence[int] = slice(None)) -> np.ndarray:
        """Object vertices (N, Vo, 3) of the chosen frames, metres; Vo = 0 without an object."""
        at = np.arange(len(self))[frames]
        if self.mesh is None:
            return np.zeros((len(at), 0, 3))
        turned = self.mesh.vertices @ self.rotation[at].transpose(0, 2, 1)
        return self._placed(turned + self.translation[at, None])

    def _placed(self, points: np.ndarray) -> np.ndarray:
        return apply(self.frame_from_master, points.reshape(-1, 3)).reshape(points.shape)


def open_sequence(
    settings: Path | str | Project,
    sequence: str,
    *,
    stage: Literal["joint", "body_fit"] = "joint",
    frame: str = Z_UP,
) -> PosedSequence:
    """Open the bodies and objects of one sequence.

    Raises UserError for an unknown sequence or camera and for missing or damaged artefacts.

    Args:
        settings: the project or its config.yaml.
        stage: joint = final result; body_fit = sequential fits (body_fit and object_track).
        frame: ``z-up`` with the floor at z = 0, ``master`` (master colour camera: x right, y down,
            z forward), or the name of another camera, with that stage's camera poses.
    """
    project = settings if isinstance(settings, Project) else load_project(Path(settings))
    project.require_sequence(sequence)
    entry = project.object_of(sequence)
    mesh = None if entry is None else ObjectMesh.load(entry)
    gender = project.subjects[project.sequences[sequence].subject].gender
    with artefacts.read(project.artefact(sequence, "scene"), SCENE) as scene:
        names, times = list(scene["camera_names"]), scene["times"]
        cameras, zup = scene["master_from_colour"], scene["zup_from_master"]
        upright = z_up_frame(scene)
    fitted = JOINT if stage == "joint" else BODY_FIT
    with artefacts.read(project.artefact(sequence, stage), fitted) as body:
        model = load_model(project.config.body_models, gender, body)
        parameters = read_parameters(body)
        if stage == "joint":
            rotation, translation = body["rotation"], body["translation"]
            trusted = dict(zip(PARTS, ~body["flagged"].T, strict=True))
            cameras = body["master_from_colour"]
        else:
            trusted = {"body": ~(body["failed"] | body["uncertain"])}
    if stage != "joint":
        with artefacts.read(project.artefact(sequence, "object_track"), OBJECT_TRACK) as track:
            rotation, translation = track["rotation"], track["translation"]
            trusted["object"] = ~track["lost"]
    if mesh is None:
        trusted = {part: mask for part, mask in trusted.items() if part not in OF_OBJECT}
    return PosedSequence(
        model,
        parameters,
        mesh,
        rotation,
        translation,
        _from_master(frame, names, cameras, zup, sequence),
        times,
        trusted,
        upright if frame == Z_UP else f"{frame} colour camera: x right, y down, z forward, metres",
    )


def _from_master(
    frame: str, names: Sequence[str], cameras: np.ndarray, zup: np.ndarray, sequence: str
) -> np.ndarray:
    """Transform (4, 4) from the master frame to the named one; UserError if it is unknown."""
    if frame == Z_UP:
        return zup
    if frame == MASTER:
        return np.eye(4)
    if frame not in names:
        raise UserError(
            f"sequence {sequence!r} has no frame {frame!r}; expected {Z_UP}, {MASTER} or one of "
            f"the cameras {', '.join(names)}"
        )
    pose = cameras[names.index(frame)]
    if not np.isfinite(pose).all():
        raise UserError(f"sequence {sequence!r}: nothing is known of where camera {frame} was")
    return invert(pose)
