"""Run one stage of one sequence of a project: settings, tables and annotation to its arguments."""

from __future__ import annotations

import ctypes
import importlib
import inspect
import logging
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from intercap_core import artefacts, schemas
from intercap_core.errors import UserError
from intercap_core.pipeline import outcome
from intercap_core.pipeline.job import last_failure
from intercap_core.project import Project
from intercap_core.stage_list import STAGES

log = logging.getLogger(__name__)

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
_GIVEN_BACK_BYTES = 4 << 20


def run_step(
    stage: str,
    project: Project,
    sequence: str,
    *,
    inputs: Mapping[str, Path],
    output: Path,
) -> None:
    """Call ``intercap_core.stages.<stage>.run`` with what its signature asks for.

    ``inputs`` are the artefacts by the name of the stage that wrote them; ``output`` is an artefact
    or, for the export, a folder. Raises UserError where an input is missing, unreadable or of
    another sequence, and where the stage finds a fault in it.
    """
    annotation = project.annotation(sequence)
    _give_back_memory()
    _check_inputs(stage, sequence, inputs)
    if STAGES[stage].on_device:
        check_device(project)
    run = importlib.import_module(f"intercap_core.stages.{stage}").run
    row = project.sequences[sequence]
    known: dict[str, Any] = {
        **inputs,
        "output": output,
        "settings": getattr(project.config, stage, None),  # not every stage has any
        "body_settings": project.config.body_fit,
        "track_settings": project.config.object_track,
        "joint_settings": project.config.joint,
        "sequence": row,
        "object_": project.object_of(sequence),
        "subject": project.subjects[row.subject],
        "body_models": project.config.body_models,
        "device": project.config.device,
        "results": row.results,
        "truth": row.truth,
        "frames_to_drop": annotation.drop_frames,
        "floor": annotation.floor,
        "starts": annotation.stated_starts,
        "initial": annotation.object_pose,
        "contact": annotation.contact,
        "subject_points": annotation.subject,
    }
    run(**{name: known[name] for name in inspect.signature(run).parameters})
    if not STAGES[stage].writes_folder:
        for note in outcome.notes(stage, output):
            log.warning("sequence %s: %s", sequence, note)
    log.info("sequence %s, %s: %s", sequence, stage, outcome.line(stage, output, inputs))


def _give_back_memory() -> None:
    """Have glibc give arrays of 4 MB and more back to the system when they are freed.

    It keeps such memory for the process from the first time on that one is freed, up to 32 MB each:
    a fifth of the joint stage's peak at 1,000 frames. Nothing to do for other C libraries.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if os.name == "posix" else None
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _GIVEN_BACK_BYTES)
        mallopt(_M_TRIM_THRESHOLD, _GIVEN_BACK_BYTES)


def check_device(project: Project) -> None:
    """Raise UserError where the settings ask for a device that this machine does not have."""
    if project.config.device == "cpu":
        return
    import torch

    if not torch.cuda.is_available():
        raise UserError(
            f"{project.path}: device is {project.config.device}, but PyTorch finds no such device "
            "here; set device: cpu, or run on a machine that has one"
        )


def _check_inputs(stage: str, sequence: str, inputs: Mapping[str, Path]) -> None:
    for name in STAGES[stage].reads:
        with artefacts.read(inputs[name], getattr(schemas, name.upper())) as source:
            found = source.attributes["sequence"]
        if found != sequence:
            raise UserError(
                f"{inputs[name]}: holds sequence {found!r}, expected {sequence!r}; delete it and "
                f"re-run stage {name!r} for sequence {sequence!r}"
            )


def run_studio(project: Project, sequence: str) -> Path:
    """Make one virtual recording; returns its folder.

    Raises UserError where the project's studio does not make this sequence.
    """
    folder = project.recordings_made(sequence)
    if project.config.studio is None or folder is None:
        raise UserError(
            f"{project.path}: studio.captures does not name {sequence!r}; its recordings are real"
        )
    from intercap_core.studio.capture import make_capture

    make_capture(
        project.config.studio.captures[sequence],
        project.config.studio,
        sequence=sequence,
        objects=project.object_of(sequence),
        output=folder,
    )
    return folder


def run_dataset(project: Project) -> Path:
    """Merge the sequences' summaries; returns the path of the site's first page.

    Sequences that the project excludes because they failed are named in it, and those whose
    summary is missing or broken. Raises UserError where none is left.
    """
    from intercap_core.report.settings import changed
    from intercap_core.stages import dataset

    folder = project.results
    reasons = {name: last_failure(project.logs / name) for name in project.config.exclude}
    page = dataset.run(
        dataset=project.config.dataset,
        summaries={name: project.artefact(name, "summary") for name in project.sequences},
        objects=project.objects,
        body_models=project.config.body_models,
        site=project.site,
        summary=folder / "summary.json",
        heatmaps=folder / "heatmaps.h5",
        tables_folder=folder / "tables",
        card=project.config.card,
        formats=project.config.export.formats,
        virtual=all(project.recordings_made(name) is not None for name in project.sequences),
        failed={name: reason for name, reason in reasons.items() if reason},
        changed=changed(project.config),
    )
    log.info("dataset %s: %s", project.config.dataset, outcome.dataset_line(folder))
    return page
