"""Run one stage of one sequence of a project, the studio, or the stage of all sequences."""

from __future__ import annotations

import importlib
import logging
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from intercap_core import artefacts, schemas
from intercap_core.annotation import Annotation
from intercap_core.errors import UserError
from intercap_core.memory import return_large_arrays
from intercap_core.pipeline import outcome, stage_inputs
from intercap_core.pipeline.checksums import (
    INPUTS_FILE,
    InputChecksums,
    forget_output,
    remember_output,
)
from intercap_core.pipeline.code_digest import stage_code
from intercap_core.pipeline.lease import Lease, acquire
from intercap_core.pipeline.plan import DATASET, failures
from intercap_core.pipeline.provenance import FILE, Manifest, read_manifest, write_manifest
from intercap_core.pipeline.resources import explain_disk_errors
from intercap_core.project import Project
from intercap_core.sequence_inputs import SequencePaths
from intercap_core.stage_list import STAGES

log = logging.getLogger(__name__)


def run_step(
    stage: str,
    project: Project,
    sequence: str,
    *,
    inputs: Mapping[str, Path] | None = None,
    output: Path | None = None,
    keep: bool = False,
) -> Path:
    """Run ``intercap_core.stages.<stage>.run`` and put its output in place with its manifest.

    Returns the output's path. One process at a time writes an output; others wait for its lease.
    Raises UserError if an input is missing, unreadable or of another sequence, or if the stage
    finds a fault in it.

    Args:
        inputs: artefacts by the stage that wrote them; default: those of the project.
        output: an artefact, or a folder for the export and the page; default: that of the project.
        keep: do not run the stage if the output is up to date once the lease is acquired.
    """
    reads = STAGES[stage].reads
    step = _Step(
        stage, project, sequence,
        project.annotation(sequence, look_at_frames=stage != "frames"),
        {name: (inputs or {}).get(name, project.artefact(sequence, name)) for name in reads},
        output or project.artefact(sequence, stage),
        stage_inputs.reused_artefact(project, sequence, stage),
    )  # fmt: skip
    return_large_arrays()
    done = False
    while not done:
        with explain_disk_errors(project, step.output, stage), acquire(step.output) as lease:
            manifest = step.current_manifest()
            if keep and _is_up_to_date(step.output, manifest):
                log.info("sequence %s, %s: another process has written it", sequence, stage)
                done = True
            else:
                step.check_inputs()
                done = step.make(manifest, lease)
        if not done:  # this process was suspended until its lease expired
            log.info(
                "sequence %s, %s: its lease was taken over by another process", sequence, stage
            )
            keep = True
    if not STAGES[stage].writes_folder:
        for note in outcome.notes(stage, step.output):
            log.warning("sequence %s: %s", sequence, note)
    log.info("sequence %s, %s: %s", sequence, stage, outcome.line(stage, step.output, step.inputs))
    return step.output


def _is_up_to_date(output: Path, current: Manifest) -> bool:
    before = read_manifest(output) if output.exists() else None
    return before is not None and before.fingerprint == current.fingerprint


@dataclass(frozen=True)
class _Step:
    """One stage of one sequence."""

    stage: str
    project: Project
    sequence: str
    annotation: Annotation
    inputs: Mapping[str, Path]
    """Artefacts that the stage reads, by the stage that wrote them."""
    output: Path
    reused: tuple[str, Path] | None
    """Name in manifests, and path, of the other sequence's artefact that the stage opens too."""

    def current_manifest(self) -> Manifest:
        """Manifest of the output that the stage would write from these inputs."""
        paths = dict([*self.inputs.items(), *([self.reused] if self.reused else [])])
        manifests = {name: read_manifest(path) for name, path in paths.items()}
        checksums = InputChecksums(self.project.results / self.sequence / INPUTS_FILE)
        current = stage_inputs.stage_manifest(
            self.project,
            self.sequence,
            self.stage,
            self.annotation,
            artefacts={
                name: stage_inputs.NOT_RECORDED if manifest is None else manifest.fingerprint
                for name, manifest in manifests.items()
            },
            checksums=checksums,
        )
        checksums.save()
        return current

    def check_inputs(self) -> None:
        """Raise UserError if an input is unreadable or belongs to an unexpected sequence."""
        checked = [(name, path, self.sequence) for name, path in self.inputs.items()]
        other = self.project.reused_sequence(self.sequence, self.stage)
        if self.reused is not None and other is not None:
            checked.append((self.stage, self.reused[1], other))
        for name, path, expected in checked:
            with artefacts.read(path, getattr(schemas, name.upper())) as source:
                actual = source.attributes["sequence"]
            if actual != expected:
                raise UserError(
                    f"{path}: holds sequence {actual!r}, expected {expected!r}; delete it and "
                    f"re-run stage {name!r} for sequence {expected!r}"
                )

    def make(self, manifest: Manifest, lease: Lease) -> bool:
        """Run the stage and replace its output; False if the lease was lost meanwhile, in which
        case the output is left alone."""
        module = importlib.import_module(f"intercap_core.stages.{self.stage}")
        in_folder = STAGES[self.stage].writes_folder
        if in_folder:
            check_replaceable(self.output, self.stage)
        part = artefacts.part_of(self.output)
        try:
            module.run(output=part, **self._arguments())
            write_manifest(part, manifest)
            if not lease.is_held():
                return False
            if in_folder:
                replace_folder(self.output, part)
            else:
                forget_output(self.output)
                os.replace(part, self.output)
            remember_output(self.output)
            return True
        finally:
            if in_folder:
                shutil.rmtree(part, ignore_errors=True)
            else:
                part.unlink(missing_ok=True)

    def _arguments(self) -> dict[str, Any]:
        """Arguments of the stage's ``run`` except the output."""
        given = stage_inputs.arguments(self.project, self.sequence, self.stage, self.annotation)
        column = STAGES[self.stage].reuses
        if column:
            given[column] = None if self.reused is None else self.reused[1]
        if "paths" in stage_code(self.stage).parameters:
            return given | {"paths": SequencePaths(**self.inputs)}
        return given | dict(self.inputs)


def check_replaceable(output: Path, stage: str) -> None:
    """Raise UserError if ``output`` holds anything but an earlier output of ``stage``."""
    marker = STAGES[stage].folder_marker
    if output.is_dir():
        if any(output.iterdir()) and not (output / marker).is_file():
            raise UserError(
                f"{output}: the folder is neither empty nor an earlier {stage} (it has no "
                f"{marker}); name a new or empty folder, or clear this one yourself"
            )
    elif output.exists() or output.is_symlink():
        raise UserError(f"{output}: is a file, expected a folder for the {stage}; name another")


def replace_folder(output: Path, part: Path) -> None:
    """Replace ``output`` by the complete folder ``part``; restores ``output`` if that fails."""
    old = part.with_suffix(".old")
    try:
        if output.exists():
            output.rename(old)
        part.rename(output)
    except BaseException:
        if old.exists() and not output.exists():
            old.rename(output)
        raise
    shutil.rmtree(old, ignore_errors=True)


def run_studio(project: Project, sequence: str) -> Path:
    """Write one virtual recording; returns its folder.

    Raises UserError if the project's studio does not make this sequence.
    """
    folder = project.recordings_made(sequence)
    if project.config.studio is None or folder is None:
        raise UserError(
            f"{project.path}: studio.captures does not name {sequence!r}; its recordings are real"
        )
    from intercap_core.studio.capture import make_capture

    with explain_disk_errors(project, folder), acquire(folder):
        checksums = InputChecksums(project.results / sequence / INPUTS_FILE)
        manifest = stage_inputs.studio_manifest(project, sequence, checksums)
        (folder / FILE).unlink(missing_ok=True)
        make_capture(
            project.config.studio.captures[sequence],
            project.config.studio,
            sequence=sequence,
            objects=project.object_of(sequence),
            output=folder,
        )
        write_manifest(folder, manifest)
        remember_output(folder)
    return folder


def run_dataset(project: Project) -> Path:
    """Merge the sequences' summaries; returns the path of the site's first page.

    The page names sequences that the project excludes because they failed, and those whose summary
    is missing or broken. Raises UserError if no sequence is left.
    """
    from intercap_core.output.export import merged
    from intercap_core.output.site.settings import changed
    from intercap_core.stages import dataset

    folder = project.results
    failed = failures(project)
    read = {
        stage: {name: project.artefact(name, stage) for name in project.sequences}
        for stage in stage_inputs.DATASET_READS
    }
    made = {
        stage: {name: m.fingerprint for name, path in of.items() if (m := read_manifest(path))}
        for stage, of in read.items()
    }
    current = stage_inputs.dataset_manifest(project, made, failed)
    with explain_disk_errors(project, folder / DATASET), acquire(folder / DATASET):
        (folder / FILE).unlink(missing_ok=True)
        first = dataset.run(
            dataset=project.config.dataset,
            summaries=read["summary"],
            objects=project.objects,
            body_models=project.config.body_models,
            results=folder,
            card=project.config.card,
            formats=project.config.export.formats,
            failed=failed,
            changed=changed(project.config),
        )
        exports = {name: path for name, path in read["export"].items() if path.is_dir()}
        merged.write(folder / "export", project.config.dataset, exports, project.objects)
        write_manifest(folder, current)
        remember_output(folder)
    log.info("dataset %s: %s", project.config.dataset, outcome.dataset_line(folder))
    return first


def write_site(project: Project) -> Path:
    """Write missing and stale summaries and pages and the site's first page; returns its path.

    Sequences that cannot be reported are left out with a warning. Raises UserError if none is left.
    """
    for name in project.sequences:
        for stage in ("summary", "page"):
            if not all(project.artefact(name, read).is_file() for read in STAGES[stage].reads):
                continue
            try:
                run_step(stage, project, name, keep=True)
            except UserError as error:
                log.warning("sequence %s has no %s: %s", name, stage, error)
    return run_dataset(project)
