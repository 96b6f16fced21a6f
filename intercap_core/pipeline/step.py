"""Run one stage of one sequence of a project: settings, tables and annotation to its arguments."""

from __future__ import annotations

import ctypes
import importlib
import logging
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

from intercap_core import artefacts, schemas
from intercap_core.config import Annotation
from intercap_core.errors import UserError
from intercap_core.pipeline import given, outcome
from intercap_core.pipeline.contents import NAME as CONTENTS_NAME
from intercap_core.pipeline.contents import Contents
from intercap_core.pipeline.intact import forget, note
from intercap_core.pipeline.lease import Lease, acquire
from intercap_core.pipeline.needs import disk_told
from intercap_core.pipeline.plan import DATASET, OF_ALL, dataset_record_of, failures, noted
from intercap_core.pipeline.record import FILE, Record, add_record, read_record
from intercap_core.project import Project
from intercap_core.sequence_inputs import SequencePaths
from intercap_core.stage_list import STAGES
from intercap_core.stages import folders

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
    keep: bool = False,
) -> None:
    """Call ``intercap_core.stages.<stage>.run`` with what its signature asks for.

    ``inputs`` are the artefacts by the name of the stage that wrote them; ``output`` is an artefact
    or, for the export and the page, a folder. It is made by one process at a time: another one that
    makes it is waited for. ``keep``: where the output is there by then and was made from the same,
    it is kept, as is what another process made that took the output over. Raises UserError where an
    input is missing, unreadable or of another sequence, and where the stage finds a fault in it.
    """
    annotation = project.annotation(sequence, look_at_frames=stage != "frames")
    _give_back_memory()
    made = False
    while not made:
        with disk_told(project, output, stage), acquire(output) as lease:
            made_from = _made_from(stage, project, sequence, annotation, inputs)
            if keep and _is_made(output, made_from):
                log.info("sequence %s, %s: was made meanwhile, and is kept", sequence, stage)
                made = True
            else:
                _check_inputs(stage, sequence, inputs)
                made = _make(stage, project, sequence, annotation, inputs, output, made_from, lease)
        if not made:  # this process stood still for a while
            log.info("sequence %s, %s: another process took it over", sequence, stage)
            keep = True
    if not STAGES[stage].writes_folder:
        for note in outcome.notes(stage, output):
            log.warning("sequence %s: %s", sequence, note)
    log.info("sequence %s, %s: %s", sequence, stage, outcome.line(stage, output, inputs))


def _made_from(
    stage: str,
    project: Project,
    sequence: str,
    annotation: Annotation,
    inputs: Mapping[str, Path],
) -> Record:
    """The record of what the output will be made from."""
    records = {name: read_record(inputs[name]) for name in STAGES[stage].reads}
    contents = Contents(project.results / sequence / CONTENTS_NAME)
    found = given.record(
        project,
        sequence,
        stage,
        annotation,
        artefacts={
            name: "not recorded" if record is None else record.identity
            for name, record in records.items()
        },
        contents=contents,
    )
    contents.keep()
    return found


def _is_made(output: Path, made_from: Record) -> bool:
    before = read_record(output) if output.exists() else None
    return before is not None and before.identity == made_from.identity


def _make(
    stage: str,
    project: Project,
    sequence: str,
    annotation: Annotation,
    inputs: Mapping[str, Path],
    output: Path,
    made_from: Record,
    lease: Lease,
) -> bool:
    """Run the stage, and put its output in its place together with its record; False where another
    process took that place over meanwhile, and nothing was put there."""
    if STAGES[stage].on_device:
        check_device(project)
    module = importlib.import_module(f"intercap_core.stages.{stage}")
    passed = given.arguments(project, sequence, stage, annotation)
    read = {name: inputs[name] for name in STAGES[stage].reads}
    passed |= {"paths": SequencePaths(**read)} if given.takes_paths(stage) else read
    in_folder = STAGES[stage].writes_folder
    if in_folder:
        folders.check_replaceable(output, marker=module.MARKER, what=stage)
    part = artefacts.part_of(output)
    try:
        module.run(output=part, **passed)
        add_record(part, made_from)
        if not lease.is_held():
            return False
        if in_folder:
            folders.put(part, output)
        else:
            forget(output)
            os.replace(part, output)
            note(output)
        return True
    finally:
        if in_folder:
            shutil.rmtree(part, ignore_errors=True)
        else:
            part.unlink(missing_ok=True)


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

    with disk_told(project, folder), acquire(folder):
        contents = Contents(project.results / sequence / CONTENTS_NAME)
        made_from = given.studio_record(project, sequence, contents)
        (folder / FILE).unlink(missing_ok=True)
        make_capture(
            project.config.studio.captures[sequence],
            project.config.studio,
            sequence=sequence,
            objects=project.object_of(sequence),
            output=folder,
        )
        add_record(folder, made_from)
    return folder


def run_dataset(project: Project) -> Path:
    """Merge the sequences' summaries; returns the path of the site's first page.

    Sequences that the project excludes because they failed are named in it, and those whose
    summary is missing or broken. Raises UserError where none is left.
    """
    from intercap_core.output.site.settings import changed
    from intercap_core.stages import dataset

    folder = project.results
    failed = failures(project)
    records = {name: read_record(project.artefact(name, "summary")) for name in project.sequences}
    made_from = given.dataset_record(
        project,
        {name: record.identity for name, record in records.items() if record is not None},
        failed,
    )
    with disk_told(project, folder / DATASET), acquire(folder / DATASET):
        (dataset_record_of(project) / FILE).unlink(missing_ok=True)
        for name in OF_ALL:
            forget(folder / name)
        first = dataset.run(
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
            failed=failed,
            changed=changed(project.config),
        )
        add_record(dataset_record_of(project), made_from)
        for file in noted(folder / name for name in OF_ALL):
            note(file)
    log.info("dataset %s: %s", project.config.dataset, outcome.dataset_line(folder))
    return first
