"""A joint result as the exporters read it, and the coordinate frames that exported files name."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from intercap_core import artefacts
from intercap_core.body.artefact import load_model, read_parameters
from intercap_core.body.model import BodyModel, BodyOutput
from intercap_core.body.parameters import BodyParameters
from intercap_core.config import BodyModels
from intercap_core.schemas import JOINT

METRES = "metres, radians, seconds"
_UP_SOURCE = {
    "floor": "the floor",
    "gravity": "gravity sensors",
    "stated": "the calibration",
    "cameras": "cameras taken to be level",
    "feet": "the standing person's feet",
    "balance": "the standing person's balance",
}


@dataclass(frozen=True, eq=False)
class Motion:
    """A joint result over T frames, float64, in one coordinate frame."""

    sequence: str
    subject: str
    object_: str
    """Name of the object, "" without one."""
    gender: str
    fps: float
    model: BodyModel
    parameters: BodyParameters
    """Body parameters of the T frames in ``frame``."""
    pelvis: np.ndarray
    """(3,) pelvis joint in the shaped rest pose, metres."""
    rotation: np.ndarray
    """(T, 3, 3) frame_from_object, NaN where the object has no pose."""
    translation: np.ndarray
    """(T, 3) frame_from_object, metres, NaN where the object has no pose."""
    frame: str
    """Name and axes of the coordinate frame."""
    up: np.ndarray
    """(3,) unit vector up in that frame, NaN if unknown."""
    made_by: str = ""
    """The other program that made an imported result, "" for this program."""

    def __len__(self) -> int:
        return len(self.rotation)

    @property
    def has_object(self) -> bool:
        """True if the object has a pose in any frame."""
        return bool(np.isfinite(self.translation).any())

    def moved(self, new_from_old: np.ndarray, frame: str) -> Motion:
        """Return the motion in another frame; ``new_from_old`` (4, 4) is rigid.

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
    """Read a joint artefact in the master camera's frame.

    Args:
        zup_from_master: (4, 4) transform of the scene; its third row is the direction up. None if
            that is unknown.

    Raises UserError as :func:`artefacts.read` does.
    """
    with artefacts.read(joint, JOINT) as artefact:
        single = read_parameters(artefact)
        rotation, translation = artefact["rotation"], artefact["translation"]
        attributes = artefact.attributes
        model = load_model(body_models, gender, artefact)
    vector = single.vector().double()
    parameters = BodyParameters.from_vector(vector, num_betas=model.num_betas)
    return Motion(
        sequence=str(attributes["sequence"]),
        subject=str(attributes["subject"]),
        object_=str(attributes["object"]),
        gender=gender,
        fps=fps,
        model=model,
        parameters=parameters,
        # the expression does not measurably move the joints: that of the first frame is used
        pelvis=rest_pose(model, parameters)[1][0],
        rotation=rotation,
        translation=translation,
        frame="master colour camera: x right, y down, z forward, metres",
        up=np.full(3, np.nan) if zup_from_master is None else zup_from_master[2, :3].copy(),
        made_by=str(attributes.get("made_by", "")),
    )


def rest_body(model: BodyModel, parameters: BodyParameters) -> BodyOutput:
    """Pose the body (batch 1) with the first frame's shape and expression in the T-pose."""
    rest = replace(
        model.zeros(1),
        betas=parameters.betas[:1].to(model.dtype),
        expression=parameters.expression[:1].to(model.dtype),
    )
    with torch.no_grad():
        return model.forward(rest)


def rest_pose(model: BodyModel, parameters: BodyParameters) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) and joints (55, 3) of the first frame's shape in the T-pose."""
    posed = rest_body(model, parameters)
    return posed.vertices[0].double().numpy(), posed.joints[0].double().numpy()


def posed_batches(model: BodyModel, parameters: BodyParameters) -> Iterator[BodyOutput]:
    """Pose the bodies of all frames, 32 frames at a time."""
    cast = BodyParameters(**{k: v.to(model.dtype) for k, v in vars(parameters).items()})
    for first in range(0, cast.batch, 32):
        with torch.no_grad():
            posed = model.forward(cast.frames(slice(first, first + 32)))
        yield posed


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Coordinate frame and units of the numbers in a file."""

    frame: str
    """Name and axes of the frame."""
    up: np.ndarray
    """(3,) unit vector up in the frame, NaN if unknown."""
    units: str = METRES
    """Units of all numbers, in words."""

    @classmethod
    def of(cls, motion: Motion, units: str = METRES) -> Coordinates:
        """Return the coordinates of a motion."""
        return cls(motion.frame, motion.up, units)

    @property
    def up_axis(self) -> str:
        """The axis that points up, such as ``z`` or ``-y``; "none..." or "unknown" otherwise."""
        for axis, value in zip("xyz", self.up, strict=True):
            if abs(abs(value) - 1) < 1e-8:  # within 1e-4 rad
                return axis if value > 0 else f"-{axis}"
        return "none: see the vector up" if np.isfinite(self.up).all() else "unknown"

    def to_json(self) -> dict[str, Any]:
        """Serialize for JSON."""
        return {
            "frame": self.frame,
            "up_axis": self.up_axis,
            "up": rounded_lists(self.up, 6),
            "units": self.units,
        }

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Serialize for npz files."""
        arrays = {key: np.array(value) for key, value in self.to_json().items()}
        return arrays | {"up": self.up.astype(np.float64)}

    def header_lines(self) -> list[str]:
        """Serialize for the header of a text file, one entry per line."""
        up = " ".join(f"{value:.6f}" for value in self.up)
        return [f"frame: {self.frame}", f"up: {self.up_axis} ({up})", f"units: {self.units}"]


def z_up_frame(scene: artefacts.Artefact) -> str:
    """Name the z-up frame of a scene artefact, with the source of its floor and vertical."""
    zero = "ground at z = 0"
    if not scene.attributes["ground_found"]:
        zero = "no floor is known, z = 0 at the master camera"
    return f"z-up: {describe_up(scene)}; {zero}, metres"


def describe_up(scene: artefacts.Artefact) -> str:
    """Source of a scene's up direction and its standard deviation, in words.

    It is "gravity-aligned" only if gravity was measured or a floor was seen.
    """
    sources = str(scene.attributes.get("up_source", "")).split(", ")
    if not sources[0]:
        return "up from a source that the scene does not name"
    names = [_UP_SOURCE.get(source, source) for source in sources]
    words = " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
    off = float(scene.attributes.get("up_deviation_deg", np.nan))
    measured = "gravity-aligned by" if {"floor", "gravity"} & {*sources} else "up from"
    return f"{measured} {words}" + (f", +-{off:.1f} degrees" if np.isfinite(off) else "")


def rounded_lists(values: np.ndarray, digits: int) -> Any:
    """Convert an array of any shape to nested lists of rounded numbers for JSON; None for NaN."""
    if values.ndim:
        return [rounded_lists(part, digits) for part in values]
    number = float(values)
    return round(number, digits) if np.isfinite(number) else None
