"""What `intercap run` says at its end: what the artefacts call degraded, worst first."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from intercap_core.errors import UserError
from intercap_core.pipeline import outcome
from intercap_core.pipeline.job import warnings_of
from intercap_core.project import Project
from intercap_core.stage_list import SEQUENCE_STAGES

REASONS_TOLD = 4  # of a sequence's flags, the most frequent ones
SEQUENCES_TOLD = 20  # all are in the report


@dataclass(frozen=True)
class Remarks:
    """On one sequence: how many of its ``frames`` are ``flagged``, and remarks by stage."""

    sequence: str
    flagged: int
    frames: int
    texts: tuple[str, ...]

    @property
    def share(self) -> float:
        """Of frames that are flagged."""
        return self.flagged / self.frames if self.frames else 0.0


def remarks(project: Project) -> list[Remarks]:
    """Of all sequences that have any, those with the largest share of flagged frames first."""
    found = []
    for name in project.sequences:
        flagged = frames = 0
        texts: list[str] = []
        for stage in SEQUENCE_STAGES:
            path = project.artefact(name, stage)
            if not path.is_file():
                continue
            try:
                notes = outcome.notes(stage, path)
                texts += [f"{stage}: {note}" for note in notes]
                log = Path(project.logs) / name / f"{stage}.log"
                texts += [f"{stage}: {text}" for text in _not_noted(log, name, notes)]
                if stage == "metrics":
                    flagged, frames, reasons = outcome.flagged_frames(path)
                    told = [f"{text} ({count})" for text, count in reasons[:REASONS_TOLD]]
                    if told:
                        texts.insert(0, f"{flagged} of {frames} frames flagged: {'; '.join(told)}")
            except UserError as error:  # an older version's; the workflow says what to do about it
                texts.append(str(error))
        if texts:
            found.append(Remarks(name, flagged, frames, tuple(texts)))
    return sorted(found, key=lambda one: (-one.share, -len(one.texts), one.sequence))


def _not_noted(log: Path, sequence: str, notes: list[str]) -> list[str]:
    """What the stage's last job warned of and its artefact does not say."""
    warned = (text.removeprefix(f"sequence {sequence}: ") for text in warnings_of(log))
    return [text for text in warned if not any(note in text or text in note for note in notes)]


def print_remarks(project: Project, console: Console) -> None:
    """Every remark once, under its sequence, with the folder of its logs."""
    found = remarks(project)
    if not found:
        return
    count = len(project.sequences)
    console.print(f"{len(found)} of {count} sequences have remarks, worst first:", highlight=False)
    for one in found[:SEQUENCES_TOLD]:
        logs = Path(project.logs) / one.sequence
        console.print(f"{one.sequence} (logs: {logs})", highlight=False, markup=False)
        for text in one.texts:
            console.print(f"  {text}", highlight=False, markup=False, soft_wrap=True)
    if len(found) > SEQUENCES_TOLD:
        left = len(found) - SEQUENCES_TOLD
        console.print(f"... and {left} more; all flags are in the report", highlight=False)
