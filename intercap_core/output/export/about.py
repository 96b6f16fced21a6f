"""What goes with the numbers of every export: which body they move, their frame and units, and how
far they are to be trusted."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.body.artefact import file_digest
from intercap_core.body.loading import OPEN_BODY
from intercap_core.body.model import BodyModel
from intercap_core.output.export.contact import StatedContact
from intercap_core.output.export.coordinates import Coordinates
from intercap_core.output.export.deviations import Deviations
from intercap_core.output.export.numbers import listed
from intercap_core.output.export.touching import TouchingSurfaces
from intercap_core.output.export.verdict import Verdict

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
