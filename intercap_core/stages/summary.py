"""Stage ``summary``: one sequence's contribution to the figures of the dataset."""

from __future__ import annotations

from pathlib import Path

from intercap_core.entries import SequenceEntry
from intercap_core.evaluation import summary
from intercap_core.sequence_inputs import SequencePaths


def run(*, paths: SequencePaths, sequence: SequenceEntry, output: Path) -> None:
    """Write summary.h5; raises UserError if an artefact is missing or broken."""
    summary.write(output, paths, intent=sequence.intent or "")
