"""What every export is made from: one body and one object over T frames, in a named frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

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


METRES = "metres, radians, seconds"
_ALONG = 1e-4  # of a unit vector's components, from which on it is not along an axis


@dataclass(frozen=True, eq=False)
class Coordinates:
    """``frame`` in words; ``up`` (3,) the unit vector up in it, NaN = not known; ``units``."""

    frame: str
    up: np.ndarray
    units: str = METRES

    @classmethod
    def of(cls, motion: Motion, units: str = METRES) -> Coordinates:
        """Those of a motion."""
        return cls(motion.frame, motion.up, units)

    @property
    def up_axis(self) -> str:
        """The axis that points up, as ``z`` or ``-y``, else that there is none."""
        for axis, value in zip("xyz", self.up, strict=True):
            if abs(abs(value) - 1) < _ALONG**2:
                return axis if value > 0 else f"-{axis}"
        return "none: the vector up is" if np.isfinite(self.up).all() else "not known"

    def told(self) -> dict[str, Any]:
        """In the words of JSON."""
        return {
            "frame": self.frame,
            "up_axis": self.up_axis,
            "up": listed(self.up, 6),
            "units": self.units,
        }

    def arrays(self) -> dict[str, np.ndarray]:
        """The same as arrays."""
        return {
            "frame": np.array(self.frame),
            "up_axis": np.array(self.up_axis),
            "up": self.up.astype(np.float64),
            "units": np.array(self.units),
        }

    def lines(self) -> list[str]:
        """The same for the head of a text file, a line each."""
        up = " ".join(f"{value:.6f}" for value in self.up)
        return [f"frame: {self.frame}", f"up: {self.up_axis} ({up})", f"units: {self.units}"]


_BY_FLOOR = "z-up: gravity-aligned, ground at z = 0, metres"
_BY_STATED_FLOOR = "z-up: up and ground at z = 0 as stated with the calibration, metres"
_BY_HINT = {
    "gravity": "by the gravity sensors",
    "stated": "as stated with the calibration",
    "cameras": "by the mean of the cameras' own up, which may be tilted",
}


def z_up_frame(scene: artefacts.Artefact) -> str:
    """The frame to which ``zup_from_master`` of a scene artefact leads."""
    said = scene.attributes
    if said["ground_found"]:
        return _BY_STATED_FLOOR if said["ground_source"] == "stated" else _BY_FLOOR
    hint = _BY_HINT.get(str(said.get("up_source")), "by a hint that the scene does not name")
    return f"z-up: {hint}; no floor is known, z = 0 at the master camera, metres"


def listed(values: np.ndarray, digits: int) -> Any:
    """An array of any shape as lists of numbers of so many decimals, None where one is not
    finite."""
    if values.ndim:
        return [listed(part, digits) for part in values]
    number = float(values)
    return round(number, digits) if np.isfinite(number) else None
