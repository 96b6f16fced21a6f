"""Run one stage of one sequence of a project: settings, tables and annotation to its arguments."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from intercap_core.project import Project

SEQUENCE_STAGES = (
    "frames",
    "detections",
    "scene",
    "person",
    "object_track",
    "body_fit",
    "joint",
    "metrics",
)


def run_step(
    stage: str,
    project: Project,
    sequence: str,
    *,
    inputs: Mapping[str, Path],
    output: Path,
) -> None:
    """Call ``intercap_core.stages.<stage>.run`` with what its signature asks for.

    ``inputs`` are the artefacts by the name of the stage that wrote them. Raises UserError where
    the stage finds a fault in the input.
    """
    annotation = project.annotation(sequence)
    run = importlib.import_module(f"intercap_core.stages.{stage}").run
    row = project.sequences[sequence]
    known: dict[str, Any] = {
        **inputs,
        "output": output,
        "settings": getattr(project.config, stage),
        "sequence": row,
        "object_": project.objects[row.object],
        "subject": project.subjects[row.subject],
        "body_models": project.config.body_models,
        "device": project.config.device,
        "truth": row.truth,
        "frames_to_drop": annotation.drop_frames,
        "floor": annotation.floor,
        "initial": annotation.object_pose,
        "contact": annotation.contact,
    }
    run(**{name: known[name] for name in inspect.signature(run).parameters})
