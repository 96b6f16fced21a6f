"""What goes with the numbers of every export: which body they move, their frame and units, and how
far they are to be trusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.body.artefact import file_digest
from intercap_core.body.loading import OPEN_BODY
from intercap_core.body.model import BodyModel
from intercap_core.export.contact import StatedContact
from intercap_core.metrics.figures import SequenceMetrics
from intercap_core.metrics.verdict_figures import StatedError, stated_errors

SMPLX, OPEN = "smplx", "intercap-open-body"  # names of surface models
UNITS = "metres, radians, seconds"


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
    """``flags`` (T,) reasons, empty = trusted; ``contact`` None without an object."""

    sequence: str
    body: BodyFile
    flags: Sequence[str]
    contact: StatedContact | None
    stated: Sequence[StatedError]

    @classmethod
    def read(cls, metrics: SequenceMetrics, body: BodyFile, contact: StatedContact | None) -> About:
        flags = [str(reason) for reason in metrics.values["flag_reason"]]
        return cls(metrics.name, body, flags, contact, stated_errors(metrics))

    def told(self, frame: str) -> dict[str, Any]:
        """In the words of JSON, for numbers in a ``frame``."""
        found: dict[str, Any] = {
            "sequence": self.sequence,
            "body": self.body.told(),
            "frame": frame,
            "units": UNITS,
            "flagged_frames": {str(t): reason for t, reason in enumerate(self.flags) if reason},
            "stated_error_mm": {
                error.part: {"mean": round(error.stated, 2), "factor": round(error.factor, 2)}
                for error in self.stated
                if not error.silent
            },
            "nothing_is_stated_of": {e.part: e.silent for e in self.stated if e.silent},
        }
        if self.contact is not None:
            found["contact"] = [
                {"part": part, "start": start, "end": end}
                for part, start, end in self.contact.intervals()
            ]
        return found

    def arrays(self, frame: str) -> dict[str, np.ndarray]:
        """The same as arrays, with every frame's probability of contact."""
        said = [error for error in self.stated if not error.silent]
        found = {
            **{key: np.array(value) for key, value in self.body.told().items()},
            "frame": np.array(frame),
            "units": np.array(UNITS),
            "flagged": np.array([bool(reason) for reason in self.flags]),
            "flag_reason": np.array(list(self.flags)),
            "stated_error_part": np.array([error.part for error in said]),
            "stated_error_mm": np.array([error.stated for error in said]),
            "stated_error_factor": np.array([error.factor for error in said]),
        }
        if self.contact is not None:
            found |= {
                "contact_region": np.array(self.contact.regions),
                "contact_probability": self.contact.probability,
                "contact_annotated": self.contact.annotated,
            }
        return found
