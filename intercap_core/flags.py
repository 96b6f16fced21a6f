"""Flags of unreliable frames by part of the result: body, hands, object and contact.

A flag has a reason in words and concerns one or more parts. The parts that it does not concern stay
trusted: a frame whose object is lost can have a reliable body.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
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
    """(T,) parts and reasons, such as "object, contact: lost; hands: occluded"; "" = no flag."""

    @classmethod
    def of(cls, frames: int, causes: Sequence[Cause], *, has_object: bool = True) -> Flags:
        """Flags of T = ``frames`` frames from their causes, in this order.

        Without an object, object and contact are never flagged.
        """
        possible = [part for part in PARTS if has_object or part not in OF_OBJECT]
        by_reason: dict[str, np.ndarray] = {}  # (T, 4) flags of each reason
        for mask, reason, parts in causes:
            of_cause = mask[:, None] & np.isin(PARTS, [p for p in parts if p in possible])
            by_reason[reason] = by_reason.get(reason, False) | of_cause
        flagged = np.zeros((frames, len(PARTS)), bool)
        clauses: list[list[str]] = [[] for _ in range(frames)]
        for reason, of_reason in by_reason.items():
            flagged |= of_reason
            for frame in np.flatnonzero(of_reason.any(axis=1)):
                names = ", ".join(itertools.compress(PARTS, of_reason[frame]))
                clauses[frame].append(f"{names}: {reason}")
        return cls(flagged, ["; ".join(frame) for frame in clauses])

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
        """Serialize one frame for JSON: names of its flagged parts, and the reasons by part."""
        parts = [part for part, on in zip(PARTS, self.flagged[frame], strict=True) if on]
        return {"flagged": parts, "flag_reason": self.reasons[frame]}

    def reasons_of(self, part: str) -> list[str]:
        """(T,) reasons for the flags of one part, without its name; "" = not flagged."""
        return [
            "; ".join(reason for parts, reason in _clauses(text) if part in parts)
            for text in self.reasons
        ]

    def texts(self) -> list[str]:
        """(T,) parts and reasons to print, such as "object and contact (object lost)"."""
        return [
            "; ".join(f"{_join(parts)} ({reason})" for parts, reason in _clauses(text)) or text
            for text in self.reasons
        ]

    def shares(self) -> dict[str, float]:
        """Share of flagged frames of each part."""
        return dict(zip(PARTS, self.flagged.mean(axis=0).tolist(), strict=True))

    def summary(self) -> str:
        """Numbers of flagged frames in words, such as "flagged: hands 3, object 2 of 60 frames"."""
        counts = zip(PARTS, self.flagged.sum(axis=0), strict=True)
        words = ", ".join(f"{part} {count}" for part, count in counts if count)
        return f"flagged: {words or 'none'} of {len(self.flagged)} frames"


_PART = "|".join(PARTS)
_HEAD = re.compile(rf"(?:^|; )((?:{_PART})(?:, (?:{_PART}))*): ")


def _clauses(text: str) -> Iterator[tuple[list[str], str]]:
    """Yield the parts and the reason of each clause of a frame's text."""
    heads = list(_HEAD.finditer(text))
    ends = [head.start() for head in heads[1:]] + [len(text)]
    for head, end in zip(heads, ends, strict=False):
        yield head[1].split(", "), text[head.end() : end]


def _join(words: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))
