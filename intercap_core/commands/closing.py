"""What `intercap run` says at its end: what is degraded, what jobs warned of, worst first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from intercap_core.errors import UserError
from intercap_core.pipeline import outcome
from intercap_core.pipeline.job import warnings_of
from intercap_core.project import Project
from intercap_core.stage_list import STAGES

REASONS_TOLD = 4  # of a sequence's flags, the most frequent ones
SEQUENCES_TOLD = 20  # all are in the file
FILE = "remarks.txt"  # in the folder of the logs


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
        told_before: set[str] = set()
        for stage in STAGES:
            path = project.artefact(name, stage)
            if not path.exists():
                continue
            try:
                notes = [] if STAGES[stage].writes_folder else outcome.notes(stage, path)
                warned = _not_noted(project.logs / name / f"{stage}.log", name, notes)
                # a mesh with holes is warned of by every stage that opens it
                new = [*notes, *(text for text in warned if text not in told_before)]
                told_before.update(new)
                texts += [f"{stage}: {text}" for text in new]
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


def of_dataset(project: Project) -> list[str]:
    """What the job that merged the sequences warned of, which has no sequence of its own."""
    return warnings_of(project.logs / "dataset.log")


def _not_noted(log: Path, sequence: str, notes: list[str]) -> list[str]:
    """What the stage's last job warned of and its artefact does not say."""
    warned = (
        text.removeprefix(f"sequence {sequence}: ").removeprefix(f"{sequence}: ")
        for text in warnings_of(log)
    )
    return [text for text in warned if not any(note in text or text in note for note in notes)]


def print_remarks(project: Project, console: Console) -> None:
    """Every remark once, under its sequence, with the folder of its logs.

    The dataset's come first, then sequences, as many as a person reads; a file, which is named
    last, has them all.
    """
    of_all, found = of_dataset(project), remarks(project)
    blocks = [
        [f"{one.sequence} (logs: {project.logs / one.sequence})", *one.texts] for one in found
    ]
    head = [["the dataset", *of_all]] if of_all else []
    if found:
        head.append(
            [f"{len(found)} of {len(project.sequences)} sequences have remarks, worst first:"]
        )
    path = project.logs / FILE
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(_text([*head, *blocks]) or "no remarks\n", encoding="utf-8")
    if not head:
        return
    left = len(blocks) - SEQUENCES_TOLD
    told = _text([*head, *blocks[:SEQUENCES_TOLD]])
    more = f"{left} more sequences, and all remarks" if left > 0 else "all remarks"
    console.print(f"{told}{more}: {path}", highlight=False, markup=False, soft_wrap=True)


def _text(blocks: Sequence[Sequence[str]]) -> str:
    """Each block's first line as it is, the others below it."""
    return "".join(
        f"{first}\n" + "".join(f"  {text}\n" for text in rest) for first, *rest in blocks
    )
