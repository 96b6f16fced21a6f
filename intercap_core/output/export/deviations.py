"""Standard deviations that the fits state of their own results, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core import artefacts
from intercap_core.body.joints import JOINT_NAMES
from intercap_core.errors import UserError
from intercap_core.output.export.motion import Motion
from intercap_core.output.export.numbers import listed
from intercap_core.schemas import BODY_FIT, OBJECT_TRACK

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
