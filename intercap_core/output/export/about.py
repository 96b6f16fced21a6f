"""Facts that accompany the numbers of every export: the body file, coordinates and reliability."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core import artefacts
from intercap_core.body.artefact import file_digest
from intercap_core.body.joints import JOINT_NAMES
from intercap_core.body.loading import OPEN_BODY
from intercap_core.body.model import BodyModel
from intercap_core.errors import UserError
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.physics.figures import physics_figures
from intercap_core.evaluation.verdict.figures import (
    IMAGE_MEASURES,
    HeldOutCamera,
    StatedError,
    held_out_cameras,
    stated_errors,
)
from intercap_core.flags import PARTS, Flags
from intercap_core.output.export.contact import ContactVertices, StatedContact
from intercap_core.output.export.motion import Coordinates, Motion, rounded_lists
from intercap_core.schemas import BODY_FIT, OBJECT_TRACK

SMPLX, OPEN = "smplx", "intercap-open-body"  # names of surface models
DEVIATIONS_SOURCE = (
    "stated by the sequential fits of body and object, before the joint fit, which states none"
)
# Name in JSON ("" = omitted), factor and number of digits, by name of an array of npz files
_IN_JSON: dict[str, tuple[str, float, int | None]] = {
    "contact_probability": ("contact_probability", 1.0, 4),
    "contact_threshold_m": ("contact_threshold_mm", 1e3, 3),
    "body_contact_distance": ("", 1.0, None),
    "object_contact_distance": ("", 1.0, None),
    "joint_sigma": ("joint_sigma_mm", 1e3, 1),
    "object_position_sigma": ("object_position_sigma_mm", 1e3, 2),
    "object_rotation_sigma": ("object_rotation_sigma_deg", math.degrees(1.0), 3),
}
_VERDICT_MEANING = (
    "held_in: medians over the frames that the camera judges, of the result; held_out: of a result "
    "fitted without the camera; shift_mm: distance between both results for each part"
)


@dataclass(frozen=True)
class ExportBody:
    """The body file of the parameters. With another file, they describe another person."""

    path: Path
    gender: str
    num_vertices: int
    num_betas: int
    num_expression: int

    @classmethod
    def of(cls, model: BodyModel, gender: str) -> ExportBody:
        return cls(model.path, gender, model.num_vertices, model.num_betas, model.num_expression)

    @property
    def is_open(self) -> bool:
        """True for the project's own body, which may be redistributed; False if licensed."""
        return self.path == OPEN_BODY

    @property
    def surface_model(self) -> str:
        """Name of the surface model. Readers load a licensed SMPL-X file for ``smplx``."""
        return OPEN if self.is_open else SMPLX

    def to_json(self) -> dict[str, Any]:
        """Serialize for JSON."""
        return {
            "surface_model_type": self.surface_model,
            "body_file": self.path.name,
            "body_file_digest": file_digest(self.path),
            "gender": self.gender,
            "num_vertices": self.num_vertices,
            "num_betas": self.num_betas,
            "num_expression": self.num_expression,
        }

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Serialize for npz files."""
        return {key: np.array(value) for key, value in self.to_json().items()}


@dataclass(frozen=True, eq=False)
class Verdict:
    """Errors of P parts (such as body, hands and object) over T frames, estimated without truth.

    The metrics estimate them by repeating the fits without each camera: see
    :mod:`intercap_core.evaluation.verdict`.
    """

    stated: Sequence[StatedError]
    per_frame_mm: np.ndarray
    """(P, T) stated error of each part by frame, millimetres; NaN = none is stated."""
    cameras: Sequence[HeldOutCamera]

    @classmethod
    def of(cls, metrics: SequenceMetrics) -> Verdict:
        stated = stated_errors(metrics)
        per_frame = (
            1e3 * metrics.values["verdict/error_frame"] if stated else np.zeros((0, len(metrics)))
        )
        return cls(stated, per_frame, held_out_cameras(metrics))

    @property
    def stated_parts(self) -> list[int]:
        """Indices of the parts for which an error is stated."""
        return [part for part, error in enumerate(self.stated) if not error.silent]

    def to_json(self) -> dict[str, Any]:
        """Serialize everything but the values per frame."""
        return {
            "stated_error_mm": {
                error.part: {"mean": round(error.stated, 2), "factor": round(error.factor, 2)}
                for error in self.stated
                if not error.silent
            },
            "nothing_is_stated_of": {e.part: e.silent for e in self.stated if e.silent},
            "verdict_by_camera": [_camera_to_json(camera) for camera in self.cameras],
        }

    def per_frame_json(self) -> dict[str, Any]:
        """Serialize the stated errors by part and frame."""
        return {
            "stated_error_mm": {
                self.stated[part].part: rounded_lists(self.per_frame_mm[part], 2)
                for part in self.stated_parts
            }
        }

    def summary(self) -> dict[str, Any]:
        """Serialize the whole verdict, with the meaning of its entries, for a separate file."""
        return {
            **self.to_json(),
            "meaning": _VERDICT_MEANING,
            "by_frame": self.per_frame_json(),
            "frame": "none: sizes of errors",
            "units": "as each name or entry says",
        }

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Serialize for npz files."""
        stated = [self.stated[part] for part in self.stated_parts]
        arrays = {
            "stated_error_part": np.array([error.part for error in stated]),
            "stated_error_mm": np.array([error.stated for error in stated]),
            "stated_error_factor": np.array([error.factor for error in stated]),
            "stated_error_by_frame_mm": self.per_frame_mm[self.stated_parts],
        }
        if self.cameras:
            parts = list(self.cameras[0].shift_mm)
            arrays |= {
                "verdict_camera": np.array([c.camera for c in self.cameras]),
                "verdict_of": np.array([f"{view.of}, {view.unit}" for view in IMAGE_MEASURES]),
                "verdict_held_in": np.array([c.held_in for c in self.cameras]),
                "verdict_held_out": np.array([c.held_out for c in self.cameras]),
                "verdict_part": np.array(parts),
                "verdict_shift_mm": np.array(
                    [[c.shift_mm[part] for part in parts] for c in self.cameras]
                ),
            }
        return arrays


def _camera_to_json(camera: HeldOutCamera) -> dict[str, Any]:
    return {
        "camera": camera.camera,
        **{
            view.key.removesuffix("_px").removesuffix("_m"): {
                "of": view.of,
                "unit": view.unit,
                "held_in": rounded_lists(np.array(held_in), 3),
                "held_out": rounded_lists(np.array(held_out), 3),
            }
            for view, held_in, held_out in zip(
                IMAGE_MEASURES, camera.held_in, camera.held_out, strict=True
            )
        },
        "shift_mm": {p: rounded_lists(np.array(mm), 2) for p, mm in camera.shift_mm.items()},
    }


@dataclass(frozen=True, eq=False)
class Physics:
    """Physics of the object over T frames: see :mod:`intercap_core.evaluation.physics`."""

    figures: dict[str, float]
    """Figures of :func:`.physics_figures`."""
    per_frame: dict[str, np.ndarray]
    """``carrier`` (T,): what carries the object; ``physics_bad`` (T,) bool: physics contradicts
    the pose; empty = not tested."""
    note: str
    """What is not judged, and why; "" = nothing."""

    @classmethod
    def of(cls, metrics: SequenceMetrics) -> Physics:
        values = metrics.values
        per_frame: dict[str, np.ndarray] = {}
        if "physics/carrier" in values:
            carriers = np.array([str(name) for name in values["physics/carrier"]])
            per_frame = {"carrier": carriers, "physics_bad": values["physics/bad"]}
        return cls(physics_figures([metrics]), per_frame, metrics.physics_note)

    def to_json(self) -> dict[str, Any]:
        """Serialize everything but the values per frame."""
        figures = {name: round(value, 3) for name, value in self.figures.items()}
        return {"physics": figures | ({"note": self.note} if self.note else {})}


def read_deviations(body_fit: Path, object_track: Path, motion: Motion) -> dict[str, np.ndarray]:
    """Read standard deviations along one coordinate that the sequential fits state, for npz files.

    Each is the root mean square over the three coordinates and therefore valid in every frame.
    Units are metres and radians; NaN = lost track. Raises UserError if the number of frames of an
    artefact differs from the motion's, and as reading does.
    """
    with artefacts.read(body_fit, BODY_FIT) as fit:
        joint = fit["joint_sigma"].astype(np.float32)
    _check_frames(body_fit, "body_fit", len(joint), motion)
    arrays = {
        "joint_name": np.array(JOINT_NAMES),
        "joint_sigma": joint,
        "sigma_source": np.array(DEVIATIONS_SOURCE),
    }
    if motion.has_object:
        with artefacts.read(object_track, OBJECT_TRACK) as track:
            covariance, lost = track["covariance"], track["lost"]
        _check_frames(object_track, "object_track", len(lost), motion)
        for name, part in (("position", slice(3, 6)), ("rotation", slice(0, 3))):
            sigma = np.sqrt(np.trace(covariance[:, part, part], axis1=1, axis2=2) / 3)
            arrays[f"object_{name}_sigma"] = np.where(lost, np.nan, sigma).astype(np.float32)
    return arrays


def _check_frames(path: Path, stage: str, frames: int, motion: Motion) -> None:
    if frames != len(motion):
        raise UserError(
            f"{path}: holds {frames} frames, but the joint result of sequence {motion.sequence!r} "
            f"has {len(motion)}; re-run stage {stage!r} and the stages after it"
        )


@dataclass(frozen=True, eq=False)
class About:
    """Everything that an export states about its numbers."""

    sequence: str
    body: ExportBody
    flags: Flags
    contact: StatedContact | None
    """Contact by body region; None without an object."""
    verdict: Verdict
    touching: ContactVertices | None = None
    """Contact by vertex; None without an object."""
    deviations: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Standard deviations, from :func:`read_deviations`; empty for imported results, which state
    none."""
    physics: Physics | None = None
    """Physics of the object; None without an object."""
    made_by: str = ""
    """The other program that made an imported result."""
    virtual: bool = False
    """The recording is virtual: its ground truth is known."""

    def to_json(self, coordinates: Coordinates) -> dict[str, Any]:
        """Serialize for JSON next to numbers in these ``coordinates``."""
        entries: dict[str, Any] = {
            "sequence": self.sequence,
            "body": self.body.to_json(),
            **coordinates.to_json(),
            "flagged_frames": {
                str(t): self.flags.at(t)
                for t in np.flatnonzero(self.flags.flagged.any(axis=1)).tolist()
            },
            **self.verdict.to_json(),
        }
        if self.made_by:
            entries["made_by"] = self.made_by
        if self.physics is not None:
            entries |= self.physics.to_json()
        if self.contact is not None:
            entries["contact"] = [
                interval.model_dump(include={"part", "start", "end"})
                for interval in self.contact.intervals()
            ]
        by_frame = self.verdict.per_frame_json()
        for name, values in self._measured_arrays().items():
            key, factor, digits = _IN_JSON.get(name, (name, 1.0, None))
            if key:
                by_frame[key] = (
                    values.tolist() if digits is None else rounded_lists(factor * values, digits)
                )
        return entries | {"by_frame": by_frame}

    def to_json_text(self, coordinates: Coordinates) -> str:
        """Serialize to the text of a JSON file."""
        return json.dumps(self.to_json(coordinates), separators=(",", ":")) + "\n"

    def write_json(self, path: Path, coordinates: Coordinates) -> None:
        """Write the JSON file."""
        path.write_text(self.to_json_text(coordinates), encoding="utf-8")

    def to_arrays(self, coordinates: Coordinates) -> dict[str, np.ndarray]:
        """Serialize for npz files."""
        return {
            **self.body.to_arrays(),
            **coordinates.to_arrays(),
            **({"made_by": np.array(self.made_by)} if self.made_by else {}),
            **self.per_frame_arrays(),
        }

    def per_frame_arrays(self) -> dict[str, np.ndarray]:
        """Serialize flags, contact, deviations and verdict of every frame for npz files."""
        return {
            "flag_part": np.array(PARTS),
            "flagged": self.flags.flagged,
            "flag_reason": np.array(list(self.flags.reasons)),
            **self.verdict.to_arrays(),
            **self._measured_arrays(),
        }

    def _measured_arrays(self) -> dict[str, np.ndarray]:
        """Serialize contact, deviations and physics of every frame for npz files."""
        arrays: dict[str, np.ndarray] = {}
        if self.contact is not None:
            arrays |= {
                "contact_region": np.array(self.contact.regions),
                "contact_probability": self.contact.probability,
                "contact_annotated": self.contact.annotated,
            }
        if self.touching is not None:
            arrays |= self.touching.to_arrays()
        arrays |= self.deviations
        if self.physics is not None:
            arrays |= self.physics.per_frame
        return arrays
