"""Flags of unreliable frames by part of the result: body, hands, object and contact.

A flag has a reason in words and concerns one or more parts. The parts that it does not concern stay
trusted: a frame whose object is lost can have a reliable body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from intercap_core.artefacts import Artefact, Writer

PARTS = ("body", "hands", "object", "contact")  # the columns of ``flagged``
OF_BODY = ("body", "hands", "contact")  # parts that are unreliable if the body is
OF_OBJECT = ("object", "contact")  # parts that are unreliable if the object is

Cause = tuple[np.ndarray, str, Sequence[str]]
"""Mask (T,) of frames, the reason for their flag, and the parts that it concerns."""


@dataclass(frozen=True, eq=False)
class Flags:
    """Flags of T frames."""

    flagged: np.ndarray
    """(T, 4) bool, by part in the order of ``PARTS``."""
    reasons: Sequence[str]
    """(T,) reasons in words, joined by "; "; "" = no part is flagged."""

    @classmethod
    def of(cls, frames: int, causes: Sequence[Cause], *, has_object: bool = True) -> Flags:
        """Flags of T = ``frames`` frames from their causes, in this order.

        Without an object, object and contact are never flagged.
        """
        flagged = np.zeros((frames, len(PARTS)), bool)
        reasons: list[dict[str, None]] = [{} for _ in range(frames)]
        for mask, reason, parts in causes:
            flagged[np.ix_(mask, np.isin(PARTS, parts))] = True
            for frame in np.flatnonzero(mask):
                reasons[frame][reason] = None
        flagged[:, np.isin(PARTS, OF_OBJECT)] &= has_object
        return cls(flagged, ["; ".join(texts) for texts in reasons])

    @classmethod
    def read(cls, artefact: Artefact) -> Flags:
        """Read the flags of a joint, metrics or summary artefact."""
        return cls(artefact["flagged"], artefact.text("flag_reason"))

    def write(self, writer: Writer) -> None:
        """Write the datasets ``flagged`` and ``flag_reason``."""
        writer.put("flagged", self.flagged)
        writer.put("flag_reason", list(self.reasons))

    def __or__(self, other: Flags) -> Flags:
        both = zip(self.reasons, other.reasons, strict=True)
        return Flags(self.flagged | other.flagged, ["; ".join(filter(None, pair)) for pair in both])

    def at(self, frame: int) -> dict[str, Any]:
        """Serialize one frame for JSON: names of its flagged parts, and the reasons."""
        parts = [part for part, on in zip(PARTS, self.flagged[frame], strict=True) if on]
        return {"flagged": parts, "flag_reason": self.reasons[frame]}

    def texts(self) -> list[str]:
        """(T,) parts and reasons in words, such as "object, contact: object lost"; "" = none."""
        return [
            f"{', '.join(np.array(PARTS)[row])}: {reason}" if reason else ""
            for row, reason in zip(self.flagged, self.reasons, strict=True)
        ]

    def shares(self) -> dict[str, float]:
        """Share of flagged frames of each part."""
        return dict(zip(PARTS, self.flagged.mean(axis=0).tolist(), strict=True))

    def summary(self) -> str:
        """Numbers of flagged frames in words, such as "flagged: hands 3, object 2 of 60 frames"."""
        counts = zip(PARTS, self.flagged.sum(axis=0), strict=True)
        words = ", ".join(f"{part} {count}" for part, count in counts if count)
        return f"flagged: {words or 'none'} of {len(self.flagged)} frames"
