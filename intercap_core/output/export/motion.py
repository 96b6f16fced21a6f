"""What every export is made from: one body and one object over T frames, in a named frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from intercap_core import artefacts
from intercap_core.body.artefact import load_model, read_parameters
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import BodyParameters
from intercap_core.config import BodyModels
from intercap_core.schemas import JOINT


@dataclass(frozen=True, eq=False)
class Motion:
    """A joint result, float64; ``object_`` is "" and its poses are NaN where there is none.

    ``parameters`` are those of the body, ``pelvis`` (3,) its pelvis joint in the shaped rest pose;
    ``rotation`` (T, 3, 3) and ``translation`` (T, 3) are frame_from_object. ``frame`` says in words
    which frame both are in, ``up`` (3,) is the unit vector up in it, NaN = not known. ``made_by``
    names another program that found it, "" = this one.
    """

    sequence: str
    subject: str
    object_: str
    gender: str
    fps: float
    model: BodyModel
    parameters: BodyParameters
    pelvis: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    frame: str
    up: np.ndarray
    made_by: str = ""

    def __len__(self) -> int:
        return len(self.rotation)

    @property
    def has_object(self) -> bool:
        """Whether there is an object in any frame."""
        return bool(np.isfinite(self.translation).any())

    def moved(self, new_from_old: np.ndarray, frame: str) -> Motion:
        """The same motion seen from another frame; ``new_from_old`` (4, 4) is rigid.

        SMPL-X turns a body about its pelvis joint p, which lies off the origin, and then adds
        ``transl``: x = R (v - p) + p + transl. In the new frame R' = A R and
        p + transl' = A (p + transl) + b.
        """
        turn, shift = new_from_old[:3, :3], new_from_old[:3, 3]
        orient = self.parameters.global_orient.numpy()
        turned = turn @ Rotation.from_rotvec(orient).as_matrix()
        at = (self.parameters.transl.numpy() + self.pelvis) @ turn.T + shift - self.pelvis
        dtype = self.parameters.transl.dtype
        parameters = replace(
            self.parameters,
            global_orient=torch.as_tensor(Rotation.from_matrix(turned).as_rotvec(), dtype=dtype),
            transl=torch.as_tensor(at, dtype=dtype),
        )
        return replace(
            self,
            parameters=parameters,
            rotation=turn @ self.rotation,
            translation=self.translation @ turn.T + shift,
            frame=frame,
            up=turn @ self.up,
        )


def read_motion(
    joint: Path,
    fps: float,
    body_models: BodyModels,
    gender: str,
    zup_from_master: np.ndarray | None = None,
) -> Motion:
    """Read a joint artefact in the master camera's frame; raises UserError as reading does.

    ``zup_from_master`` (4, 4) says where up is there, None = nobody does.
    """
    with artefacts.read(joint, JOINT) as artefact:
        single = read_parameters(artefact)
        rotation, translation = artefact["rotation"], artefact["translation"]
        told = artefact.attributes
        model = load_model(body_models, gender, artefact)
    vector = single.vector().double()
    parameters = BodyParameters.from_vector(vector, num_betas=model.num_betas)
    # Expression moves the joints of a licensed file by nothing measurable: the first frame's serves
    rest = replace(model.zeros(1), betas=single.betas[:1], expression=single.expression[:1])
    with torch.no_grad():
        pelvis = model.forward(rest, vertex_ids=np.array([0])).joints[0, 0].double().numpy()
    return Motion(
        sequence=str(told["sequence"]),
        subject=str(told["subject"]),
        object_=str(told["object"]),
        gender=gender,
        fps=fps,
        model=model,
        parameters=parameters,
        pelvis=pelvis,
        rotation=rotation,
        translation=translation,
        frame="master colour camera: x right, y down, z forward, metres",
        up=np.full(3, np.nan) if zup_from_master is None else zup_from_master[2, :3].copy(),
        made_by=str(told.get("made_by", "")),
    )
