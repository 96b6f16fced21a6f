"""What goes with the numbers of every export: which body they move, their frame and units, and how
far they are to be trusted."""

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
from intercap_core.evaluation.verdict.figures import (
    IMAGE_MEASURES,
    HeldOutCamera,
    StatedError,
    held_out_cameras,
    stated_errors,
)
from intercap_core.output.export.contact import StatedContact, TouchingSurfaces
from intercap_core.output.export.motion import Coordinates, Motion, listed
from intercap_core.schemas import BODY_FIT, OBJECT_TRACK

SMPLX, OPEN = "smplx", "intercap-open-body"  # names of surface models


@dataclass(frozen=True)
class BodyFile:
    """The mesh that the parameters move: another one with the same parameters is another person."""

    path: Path
    gender: str
    num_vertices: int
    num_betas: int
    num_expression: int

    @classmethod
    def of(cls, model: BodyModel, gender: str) -> BodyFile:
        return cls(model.path, gender, model.num_vertices, model.num_betas, model.num_expression)

    @property
    def is_open(self) -> bool:
        """It is the project's own body, which may be given away; else a licensed file."""
        return self.path == OPEN_BODY

    @property
    def surface_model(self) -> str:
        """Its name: readers that know ``smplx`` load a licensed SMPL-X file by it."""
        return OPEN if self.is_open else SMPLX

    def told(self) -> dict[str, Any]:
        """In the words of JSON."""
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
class About:
    """``flags`` (T,) reasons, empty = trusted; ``contact`` and ``touching`` None without an object,
    ``deviations`` None where another program made the result, of which nothing is stated."""

    sequence: str
    body: BodyFile
    flags: Sequence[str]
    contact: StatedContact | None
    verdict: Verdict
    touching: TouchingSurfaces | None = None
    deviations: Deviations | None = None
    made_by: str = ""

    def told(self, coordinates: Coordinates) -> dict[str, Any]:
        """In the words of JSON, for numbers in these ``coordinates``."""
        found: dict[str, Any] = {
            "sequence": self.sequence,
            "body": self.body.told(),
            **coordinates.told(),
            "flagged_frames": {str(t): reason for t, reason in enumerate(self.flags) if reason},
            **self.verdict.told(),
        }
        if self.made_by:
            found["made_by"] = self.made_by
        if self.contact is not None:
            found["contact"] = [
                {"part": part, "start": start, "end": end}
                for part, start, end in self.contact.intervals()
            ]
        return found | {"by_frame": self._by_frame()}

    def text(self, coordinates: Coordinates) -> str:
        """The same as a file of JSON."""
        return json.dumps(self.told(coordinates), separators=(",", ":")) + "\n"

    def arrays(self, coordinates: Coordinates) -> dict[str, np.ndarray]:
        """The same as arrays."""
        return {
            **{key: np.array(value) for key, value in self.body.told().items()},
            **coordinates.arrays(),
            **({"made_by": np.array(self.made_by)} if self.made_by else {}),
            **self.by_frame_arrays(),
        }

    def by_frame_arrays(self) -> dict[str, np.ndarray]:
        """What is known of every frame: flags, contact, deviations and the verdict."""
        found = {
            "flagged": np.array([bool(reason) for reason in self.flags]),
            "flag_reason": np.array(list(self.flags)),
            **self.verdict.arrays(),
        }
        if self.contact is not None:
            found |= {
                "contact_region": np.array(self.contact.regions),
                "contact_probability": self.contact.probability,
                "contact_annotated": self.contact.annotated,
            }
        if self.touching is not None:
            found |= self.touching.arrays()
        if self.deviations is not None:
            found |= self.deviations.arrays()
        return found

    def _by_frame(self) -> dict[str, Any]:
        found = self.verdict.by_frame_told()
        if self.contact is not None:
            found |= {
                "contact_region": list(self.contact.regions),
                "contact_probability": listed(self.contact.probability, 4),
                "contact_annotated": self.contact.annotated.tolist(),
            }
        if self.touching is not None:
            found |= self.touching.told()
        if self.deviations is not None:
            found |= self.deviations.told()
        return found


SOURCE = "stated by the sequential fits of body and object, before the joint fit, which states none"


@dataclass(frozen=True, eq=False)
class Deviations:
    """Along one coordinate, in the mean square over the three: of each ``joint`` (T, 55) m, of the
    object's position (T,) m and turn (T,) rad, None without an object, NaN where its track is
    lost. They do not depend on the frame of coordinates."""

    joint: np.ndarray
    object_position: np.ndarray | None
    object_turn: np.ndarray | None

    @classmethod
    def read(cls, body_fit: Path, object_track: Path, motion: Motion) -> Deviations:
        """Raises UserError where an artefact has other frames than the motion, and as reading
        does."""
        with artefacts.read(body_fit, BODY_FIT) as fit:
            joint = fit["joint_sigma"].astype(np.float32)
        _check(body_fit, "body_fit", len(joint), motion)
        if not motion.has_object:
            return cls(joint, None, None)
        with artefacts.read(object_track, OBJECT_TRACK) as track:
            covariance, lost = track["covariance"], track["lost"]
        _check(object_track, "object_track", len(lost), motion)
        turn, position = (
            np.sqrt(np.trace(covariance[:, part, part], axis1=1, axis2=2) / 3)
            for part in (slice(0, 3), slice(3, 6))
        )
        return cls(
            joint,
            np.where(lost, np.nan, position).astype(np.float32),
            np.where(lost, np.nan, turn).astype(np.float32),
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """As arrays, by the names that go with every export."""
        found = {
            "joint_name": np.array(JOINT_NAMES),
            "joint_sigma": self.joint,
            "sigma_source": np.array(SOURCE),
        }
        if self.object_position is not None and self.object_turn is not None:
            found |= {
                "object_position_sigma": self.object_position,
                "object_rotation_sigma": self.object_turn,
            }
        return found

    def told(self) -> dict[str, Any]:
        """In the words of JSON: millimetres and degrees, null = not known."""
        found: dict[str, Any] = {
            "joint_name": list(JOINT_NAMES),
            "joint_sigma_mm": listed(1e3 * self.joint, 1),
            "sigma_source": SOURCE,
        }
        if self.object_position is not None and self.object_turn is not None:
            found |= {
                "object_position_sigma_mm": listed(1e3 * self.object_position, 2),
                "object_rotation_sigma_deg": listed(np.degrees(self.object_turn), 3),
            }
        return found


def _check(path: Path, stage: str, frames: int, motion: Motion) -> None:
    if frames != len(motion):
        raise UserError(
            f"{path}: holds {frames} frames, but the joint result of sequence {motion.sequence!r} "
            f"{len(motion)}; re-run stage {stage!r} and what follows"
        )


MEANING = (
    "held_in: medians over the frames that the camera judges, of the result; held_out: of a result "
    "fitted without the camera; shift_mm: how far a part is elsewhere without it"
)


@dataclass(frozen=True, eq=False)
class Verdict:
    """``stated`` of every judged part, ``by_frame`` (P, T) millimetres in their order, NaN where
    nothing is said; ``cameras`` that were held out."""

    stated: Sequence[StatedError]
    by_frame: np.ndarray
    cameras: Sequence[HeldOutCamera]

    @classmethod
    def of(cls, metrics: SequenceMetrics) -> Verdict:
        stated = stated_errors(metrics)
        by_frame = (
            1e3 * metrics.values["verdict/error_frame"] if stated else np.zeros((0, len(metrics)))
        )
        return cls(stated, by_frame, held_out_cameras(metrics))

    @property
    def said(self) -> list[int]:
        """Places of the parts of which an error is stated."""
        return [place for place, error in enumerate(self.stated) if not error.silent]

    def told(self) -> dict[str, Any]:
        """In the words of JSON."""
        return {
            "stated_error_mm": {
                error.part: {"mean": round(error.stated, 2), "factor": round(error.factor, 2)}
                for error in self.stated
                if not error.silent
            },
            "nothing_is_stated_of": {e.part: e.silent for e in self.stated if e.silent},
            "verdict_by_camera": [self._camera(one) for one in self.cameras],
        }

    def by_frame_told(self) -> dict[str, Any]:
        """Stated errors by part and frame, for JSON."""
        return {
            "stated_error_mm": {
                self.stated[place].part: listed(self.by_frame[place], 2) for place in self.said
            }
        }

    def whole(self) -> dict[str, Any]:
        """All of it, with what the words mean: a file of its own."""
        return {
            **self.told(),
            "meaning": MEANING,
            "by_frame": self.by_frame_told(),
            "frame": "none: sizes of errors",
            "units": "as each name or entry says",
        }

    def arrays(self) -> dict[str, np.ndarray]:
        """As arrays, by the names that go with every export."""
        said = [self.stated[place] for place in self.said]
        found = {
            "stated_error_part": np.array([error.part for error in said]),
            "stated_error_mm": np.array([error.stated for error in said]),
            "stated_error_factor": np.array([error.factor for error in said]),
            "stated_error_by_frame_mm": self.by_frame[self.said],
        }
        if self.cameras:
            parts = list(self.cameras[0].shift_mm)
            found |= {
                "verdict_camera": np.array([one.camera for one in self.cameras]),
                "verdict_of": np.array([f"{view.of}, {view.unit}" for view in IMAGE_MEASURES]),
                "verdict_held_in": np.array([one.held_in for one in self.cameras]),
                "verdict_held_out": np.array([one.held_out for one in self.cameras]),
                "verdict_part": np.array(parts),
                "verdict_shift_mm": np.array(
                    [[one.shift_mm[part] for part in parts] for one in self.cameras]
                ),
            }
        return found

    @staticmethod
    def _camera(one: HeldOutCamera) -> dict[str, Any]:
        return {
            "camera": one.camera,
            **{
                view.key.removesuffix("_px").removesuffix("_m"): {
                    "of": view.of,
                    "unit": view.unit,
                    "held_in": listed(np.array(held_in), 3),
                    "held_out": listed(np.array(held_out), 3),
                }
                for view, held_in, held_out in zip(
                    IMAGE_MEASURES, one.held_in, one.held_out, strict=True
                )
            },
            "shift_mm": {p: listed(np.array(mm), 2) for p, mm in one.shift_mm.items()},
        }
