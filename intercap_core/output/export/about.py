"""Facts that accompany the numbers of every export: the body file, coordinates and reliability."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
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
_VERDICT_MEANING = (
    "held_in: medians over the frames that the camera judges, of the result; held_out: of a result "
    "fitted without the camera; shift_mm: distance between both results for each part"
)


@dataclass(frozen=True)
class ExportBody:
    """The body file of the parameters. With another file, they describe another person."""

    path: Path
    """Body file."""
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


@dataclass(frozen=True, eq=False)
class Verdict:
    """Errors of P parts (such as body, hands and object) over T frames, estimated without truth.

    The metrics estimate them by repeating the fits without each camera: see
    :mod:`intercap_core.evaluation.verdict`.
    """

    stated: Sequence[StatedError]
    """Stated error of each part."""
    per_frame_mm: np.ndarray
    """(P, T) stated error of each part by frame, millimetres; NaN = none is stated."""
    cameras: Sequence[HeldOutCamera]
    """Cameras that were held out."""

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
    carriers: Sequence[str]
    """(T,) what carries the object; empty = not tested."""
    bad: np.ndarray
    """(T,) bool, physics contradicts the pose."""
    note: str
    """What is not judged, and why; "" = nothing."""

    @classmethod
    def of(cls, metrics: SequenceMetrics) -> Physics:
        values = metrics.values
        return cls(
            physics_figures([metrics]),
            [str(name) for name in values.get("physics/carrier", ())],
            values.get("physics/bad", np.zeros(0, bool)),
            metrics.physics_note,
        )

    def to_json(self) -> dict[str, Any]:
        """Serialize everything but the values per frame."""
        figures = {name: round(value, 3) for name, value in self.figures.items()}
        return {"physics": figures | ({"note": self.note} if self.note else {})}

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Serialize the values per frame for npz files."""
        if not self.carriers:
            return {}
        return {"carrier": np.array(self.carriers), "physics_bad": self.bad}


@dataclass(frozen=True, eq=False)
class Deviations:
    """Standard deviations along one coordinate that the sequential fits state.

    Each is the root mean square over the three coordinates and therefore valid in every frame.
    """

    joint: np.ndarray
    """(T, 55) standard deviation of each body joint, metres."""
    object_position: np.ndarray | None
    """(T,) that of the object's position, metres; NaN = lost track; None without an object."""
    object_turn: np.ndarray | None
    """(T,) that of its rotation, radians; NaN = lost track; None without an object."""

    @classmethod
    def read(cls, body_fit: Path, object_track: Path, motion: Motion) -> Deviations:
        """Read both artefacts.

        Raises UserError if their number of frames differs from the motion's, and as reading does.
        """
        with artefacts.read(body_fit, BODY_FIT) as fit:
            joint = fit["joint_sigma"].astype(np.float32)
        _check_frames(body_fit, "body_fit", len(joint), motion)
        if not motion.has_object:
            return cls(joint, None, None)
        with artefacts.read(object_track, OBJECT_TRACK) as track:
            covariance, lost = track["covariance"], track["lost"]
        _check_frames(object_track, "object_track", len(lost), motion)
        turn, position = (
            np.sqrt(np.trace(covariance[:, part, part], axis1=1, axis2=2) / 3)
            for part in (slice(0, 3), slice(3, 6))
        )
        return cls(
            joint,
            np.where(lost, np.nan, position).astype(np.float32),
            np.where(lost, np.nan, turn).astype(np.float32),
        )

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Serialize for npz files: metres and radians."""
        arrays = {
            "joint_name": np.array(JOINT_NAMES),
            "joint_sigma": self.joint,
            "sigma_source": np.array(DEVIATIONS_SOURCE),
        }
        if self.object_position is not None and self.object_turn is not None:
            arrays |= {
                "object_position_sigma": self.object_position,
                "object_rotation_sigma": self.object_turn,
            }
        return arrays

    def to_json(self) -> dict[str, Any]:
        """Serialize for JSON: millimetres and degrees, None for NaN."""
        entries: dict[str, Any] = {
            "joint_name": list(JOINT_NAMES),
            "joint_sigma_mm": rounded_lists(1e3 * self.joint, 1),
            "sigma_source": DEVIATIONS_SOURCE,
        }
        if self.object_position is not None and self.object_turn is not None:
            entries |= {
                "object_position_sigma_mm": rounded_lists(1e3 * self.object_position, 2),
                "object_rotation_sigma_deg": rounded_lists(np.degrees(self.object_turn), 3),
            }
        return entries


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
    deviations: Deviations | None = None
    """Standard deviations; None for imported results, which state none."""
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
        return entries | {"by_frame": self._per_frame_json()}

    def to_json_text(self, coordinates: Coordinates) -> str:
        """Serialize to the text of a JSON file."""
        return json.dumps(self.to_json(coordinates), separators=(",", ":")) + "\n"

    def to_arrays(self, coordinates: Coordinates) -> dict[str, np.ndarray]:
        """Serialize for npz files."""
        return {
            **{key: np.array(value) for key, value in self.body.to_json().items()},
            **coordinates.to_arrays(),
            **({"made_by": np.array(self.made_by)} if self.made_by else {}),
            **self.per_frame_arrays(),
        }

    def per_frame_arrays(self) -> dict[str, np.ndarray]:
        """Serialize flags, contact, deviations and verdict of every frame for npz files."""
        arrays = {
            "flag_part": np.array(PARTS),
            "flagged": self.flags.flagged,
            "flag_reason": np.array(list(self.flags.reasons)),
            **self.verdict.to_arrays(),
        }
        if self.contact is not None:
            arrays |= {
                "contact_region": np.array(self.contact.regions),
                "contact_probability": self.contact.probability,
                "contact_annotated": self.contact.annotated,
            }
        if self.touching is not None:
            arrays |= self.touching.to_arrays()
        if self.deviations is not None:
            arrays |= self.deviations.to_arrays()
        if self.physics is not None:
            arrays |= self.physics.to_arrays()
        return arrays

    def _per_frame_json(self) -> dict[str, Any]:
        entries = self.verdict.per_frame_json()
        if self.contact is not None:
            entries |= {
                "contact_region": list(self.contact.regions),
                "contact_probability": rounded_lists(self.contact.probability, 4),
                "contact_annotated": self.contact.annotated.tolist(),
            }
        if self.touching is not None:
            entries |= self.touching.to_json()
        if self.deviations is not None:
            entries |= self.deviations.to_json()
        if self.physics is not None:
            entries |= {key: values.tolist() for key, values in self.physics.to_arrays().items()}
        return entries
