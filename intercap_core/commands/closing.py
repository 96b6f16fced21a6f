"""Remarks at the end of `intercap run`: degradations and warnings, worst sequence first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from intercap_core.commands.console import print_plain
from intercap_core.errors import UserError
from intercap_core.pipeline import outcome
from intercap_core.pipeline.job import warnings_of
from intercap_core.project import Project
from intercap_core.stage_list import STAGES

MAX_SEQUENCES = 20  # printed sequences; the file has all
FILE = "remarks.txt"  # in the folder of the logs


@dataclass(frozen=True)
class Remarks:
    """Remarks on one sequence."""

    sequence: str
    """Name of the sequence."""
    share: float
    """Share of flagged frames, mean over the parts; 0 without metrics."""
    texts: tuple[str, ...]
    """Remarks, each beginning with its stage."""


def remarks(project: Project) -> list[Remarks]:
    """Remarks of all sequences that have any, largest share of flagged frames first."""
    sequences = []
    for name in project.sequences:
        share = 0.0
        texts: list[str] = []
        known: set[str] = set()
        for stage in STAGES:
            path = project.artefact(name, stage)
            if not path.exists():
                continue
            try:
                notes = [] if STAGES[stage].writes_folder else outcome.notes(stage, path)
                warned = _not_noted(project.logs / name / f"{stage}.log", name, notes)
                # every stage that opens a mesh with holes gives the same warning
                new = [*notes, *(text for text in warned if text not in known)]
                known.update(new)
                texts += [f"{stage}: {text}" for text in new]
                if stage == "metrics":
                    flags, reasons = outcome.flagged_frames(path)
                    share = float(flags.flagged.mean())
                    named = [f"{text} ({count})" for text, count in reasons[:4]]
                    if named:
                        texts.insert(0, f"{flags.summary()}: {'; '.join(named)}")
            except UserError as error:  # an artefact of an older version; the text says what to do
                texts.append(str(error))
        if texts:
            sequences.append(Remarks(name, share, tuple(texts)))
    return sorted(sequences, key=lambda s: (-s.share, -len(s.texts), s.sequence))


def _not_noted(log: Path, sequence: str, notes: list[str]) -> list[str]:
    """Warnings of a stage's last job that its artefact does not contain as notes."""
    warned = (
        text.removeprefix(f"sequence {sequence}: ").removeprefix(f"{sequence}: ")
        for text in warnings_of(log)
    )
    return [text for text in warned if not any(note in text or text in note for note in notes)]


def print_remarks(project: Project, console: Console) -> None:
    """Print the remarks by sequence, with the folder of its logs; all of them go to a file.

    Remarks on the dataset come first, then those on up to ``MAX_SEQUENCES`` sequences.
    """
    of_all, sequences = warnings_of(project.logs / "dataset.log"), remarks(project)
    blocks = [[f"{s.sequence} (logs: {project.logs / s.sequence})", *s.texts] for s in sequences]
    head = [["the dataset", *of_all]] if of_all else []
    if sequences:
        head.append(
            [f"{len(sequences)} of {len(project.sequences)} sequences have remarks, worst first:"]
        )
    path = project.logs / FILE
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(_text([*head, *blocks]) or "no remarks\n", encoding="utf-8")
    if not head:
        return
    left = len(blocks) - MAX_SEQUENCES
    printed = _text([*head, *blocks[:MAX_SEQUENCES]])
    more = f"{left} more sequences, and all remarks" if left > 0 else "all remarks"
    print_plain(console, f"{printed}{more}: {path}")


def _text(blocks: Sequence[Sequence[str]]) -> str:
    """Blocks of lines; the lines after the first of a block are indented."""
    return "".join(
        f"{first}\n" + "".join(f"  {text}\n" for text in rest) for first, *rest in blocks
    )
