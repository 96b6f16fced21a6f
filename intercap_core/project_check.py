"""Faults of single sequences: what would fail in the first minutes of a run, found before it."""

from __future__ import annotations

from dataclasses import dataclass

from intercap_core.errors import UserError
from intercap_core.project import Project


@dataclass(frozen=True)
class Fault:
    """What is wrong with one sequence."""

    sequence: str
    message: str

    def __str__(self) -> str:
        return f"sequence {self.sequence!r}: {self.message}"


def faults_of_sequences(project: Project) -> list[Fault]:
    """Check every sequence's annotation and that its files are there; recordings are not opened.

    Recordings that the studio is to make are not missed.
    """
    faults = []
    for name, row in project.sequences.items():
        try:
            project.annotation(name)
        except UserError as error:
            faults.append(Fault(name, str(error)))
        if project.recordings_made(name) is not None:
            continue
        if not row.recordings.is_dir():
            faults.append(Fault(name, f"there is no folder {row.recordings} of recordings"))
        elif not any(row.recordings.glob("*.mkv")):
            faults.append(Fault(name, f"{row.recordings} holds no <camera>.mkv"))
        for column in ("calibration", "keypoints", "candidates", "truth"):
            path = getattr(row, column)
            if path is not None and not path.exists():
                faults.append(Fault(name, f"column {column} says {path}, which is not there"))
    return faults
