"""One sequence's share of the dataset's figures."""

from __future__ import annotations

from pathlib import Path

from intercap_core.config import SequenceEntry
from intercap_core.evaluation import summary


def run(
    *,
    frames: Path,
    detections: Path,
    scene: Path,
    person: Path,
    object_track: Path,
    body_fit: Path,
    joint: Path,
    metrics: Path,
    sequence: SequenceEntry,
    output: Path,
) -> None:
    """Write the summary artefact; raises UserError where an artefact is missing or broken."""
    paths = {
        "frames": frames, "detections": detections, "scene": scene, "person": person,
        "object_track": object_track, "body_fit": body_fit, "joint": joint, "metrics": metrics,
    }  # fmt: skip
    summary.write(output, paths, intent=sequence.intent or "")
