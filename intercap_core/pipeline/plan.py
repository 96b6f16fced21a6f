"""Decides which outputs are up to date, missing or stale, and thereby what a run computes.

An output is up to date if its manifest has the fingerprint that the output would get now. Dates of
files do not count, so results may be moved or copied. An output whose sizes or dates differ from
the stored ones is read through, and is stale if it is damaged. See docs/reruns.md.
"""

from __future__ import annotations

import logging
import os
import uuid
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from pathlib import Path

from intercap_core.errors import UserError
from intercap_core.geometry.solve.thread_pool import ThreadPool
from intercap_core.pipeline.checksums import (
    INPUTS_FILE,
    InputChecksums,
    find_damage,
    read_valid_manifest,
)
from intercap_core.pipeline.job import last_failure
from intercap_core.pipeline.lease import file_system_time
from intercap_core.pipeline.provenance import DATASET_OUTPUTS, FILE, Manifest, read_manifest
from intercap_core.pipeline.stage_inputs import (
    DATASET_READS,
    NOT_RECORDED,
    STUDIO,
    dataset_manifest,
    reused_artefact,
    stage_manifest,
    studio_manifest,
)
from intercap_core.progress import Progress
from intercap_core.project import Project
from intercap_core.stage_list import STAGES

log = logging.getLogger(__name__)

DATASET = "dataset"
MARKS = Path(".snakemake") / "out_of_date"
# Date of a mark after that of its output, less than any job takes: the first that the file system
# stores as a later date. Some store whole seconds, FAT even seconds.
_MARK_DELAYS_NS = (1_000_000, 1_000_000_000, 2_000_000_000)


class OutputStatus(StrEnum):
    """Whether an output must be made."""

    done = "done"
    missing = "missing"
    stale = "stale"


@dataclass(frozen=True)
class OutputState:
    """State of one output."""

    status: OutputStatus
    """Up to date, missing or stale."""
    reasons: tuple[str, ...]
    """Why it is stale, in words."""
    fingerprint: str
    """Fingerprint that it would get now; later stages are made from it."""
    made_on: str = ""
    """Device and processor that made an up-to-date output; "" if they are those of this machine."""


class Plan:
    """States of all outputs of a project, computed on demand."""

    def __init__(self, project: Project) -> None:
        self.project = project
        self._sequences: dict[str, dict[str, OutputState]] = {}
        self._annotation_faults: dict[str, str] = {}

    def states(self, sequence: str) -> dict[str, OutputState]:
        """States of a sequence by stage; "studio" comes first if it makes the recording."""
        if sequence not in self._sequences:
            self._sequences[sequence] = dict(self._decide(sequence))
        return self._sequences[sequence]

    @cached_property
    def dataset(self) -> OutputState:
        """State of the outputs of all sequences: tables, card, merged exports and first page."""
        names = self.project.sequences
        current = dataset_manifest(
            self.project,
            {
                stage: {name: self.states(name)[stage].fingerprint for name in names}
                for stage in DATASET_READS
            },
            failures(self.project),
        )
        files = [self.project.results / name for name in DATASET_OUTPUTS]
        if not all(file.exists() for file in files):
            return OutputState(OutputStatus.missing, (), current.fingerprint)
        return _compare(self.project.results, read_valid_manifest(self.project.results), current)

    def output(self, sequence: str, stage: str) -> Path:
        """Path of the output of a stage, or of the studio."""
        recordings = self.project.recordings_made(sequence)
        if stage == STUDIO and recordings is not None:
            return recordings
        return self.project.artefact(sequence, stage)

    def faults(self, sequence: str) -> dict[str, str]:
        """Error message by stage of each damaged or missing output of a sequence, read completely.

        Sequence "" stands for the outputs of all sequences. A sequence without any output has no
        fault. Outputs count as missing if those of a later stage, or of all sequences, exist.
        """
        if not sequence:
            exists = any((self.project.results / name).exists() for name in DATASET_OUTPUTS)
            fault = _find_fault(self.project.results, "", DATASET) if exists else ""
            return {DATASET: fault} if fault else {}
        stages = list(STAGES)
        if self.project.recordings_made(sequence) is not None:
            stages = [STUDIO, *stages]
        existing = [stage for stage in stages if self.output(sequence, stage).exists()]
        if existing and not (self.project.results / FILE).exists():
            stages = stages[: stages.index(existing[-1]) + 1]
        faults = {
            stage: _find_fault(self.output(sequence, stage), sequence, stage)
            for stage in (stages if existing else ())
        }
        return {stage: fault for stage, fault in faults.items() if fault}

    def all_faults(self) -> dict[str, dict[str, str]]:
        """Result of :meth:`faults` by sequence, "" included; files are read in several threads."""
        names = ["", *self.project.sequences]
        progress = Progress(log, "read", len(names), "sequences")

        def read(name: str) -> dict[str, str]:
            found = self.faults(name)
            progress.step()
            return found

        return dict(zip(names, ThreadPool(os.cpu_count() or 1).map(read, names), strict=True))

    def all_done(self) -> bool:
        """Whether every output of the project is up to date."""
        done = all(
            state.status is OutputStatus.done
            for name in self.project.sequences
            for state in self.states(name).values()
        )
        return done and self.dataset.status is OutputStatus.done

    def is_stale(self, sequence: str, stage: str) -> bool:
        """Whether an output exists, but was made from other inputs than it would be now."""
        return self._state(sequence, stage).status is OutputStatus.stale

    def shared_jobs(
        self, sequence: str, *, alone: Collection[str] = (), last: Collection[str] = ()
    ) -> list[tuple[str, ...]]:
        """Stages of each job that computes two or more of them, by the setting ``one_process``.

        A job computes consecutive stages that are missing or stale, and no other.

        Args:
            alone: stages that get a job of their own.
            last: stages after which a job ends.
        """
        jobs: list[list[str]] = []
        for group in self.project.config.one_process:
            jobs.append([])
            for stage in group:
                if stage in alone or self._state(sequence, stage).status is OutputStatus.done:
                    jobs.append([])
                    continue
                jobs[-1].append(stage)
                if stage in last:
                    jobs.append([])
        return [tuple(job) for job in jobs if len(job) > 1]

    def fingerprint(self, sequence: str, stage: str) -> str:
        """Fingerprint that the output would get; "" if that is not known yet."""
        return self._state(sequence, stage).fingerprint

    def annotation_fault(self, sequence: str) -> str:
        """Error message about the sequence's annotation, "" if it is valid.

        Frame numbers are checked only while the frames artefact is up to date.
        """
        self.states(sequence)
        return self._annotation_faults.get(sequence, "")

    def mark(self, sequence: str, stage: str) -> list[Path]:
        """Path of the mark of a stale output, in a list; [] if the output is not stale.

        A mark is a file that is newer than the output. Snakemake runs the job of an existing output
        only because of its mark: without one, the dates of all inputs are ignored.
        """
        return [mark_of(self.project, sequence, stage)] if self.is_stale(sequence, stage) else []

    def mark_all(self) -> None:
        """Write the marks of all stale outputs; reset future dates and remove dangling links.

        Snakemake lists the folder of the marks once and treats files that are written later as
        missing. After a job, it removes outputs that are older than an input. The date of a mark
        therefore follows from that of its output and not from a clock: the clocks of machines and
        file servers differ.
        """
        outputs = [(name, stage) for name in self.project.sequences for stage in self.states(name)]
        existing = self.project.results.is_dir()
        now = file_system_time(self.project.results) if existing else 0.0
        for name, stage in (*outputs, ("", DATASET)):
            dated = []
            for file in self._dated_files(name, stage):
                if file.exists():
                    dated.append(file)
                elif file.is_symlink():  # dangling or cyclic: Snakemake fails on it
                    log.warning("%s: removed, it was a link to %s", file, os.readlink(file))
                    file.unlink()
            for file in dated:
                if file.stat().st_mtime > now:
                    os.utime(file)
            for path in self.mark(name, stage):
                path.parent.mkdir(parents=True, exist_ok=True)
                # a unique content, in case Snakemake compares checksums of inputs
                lines = [*self._state(name, stage).reasons, uuid.uuid4().hex]
                path.write_text("\n".join(lines) + "\n", encoding="utf-8", errors="replace")
                newest = max([file.stat().st_mtime_ns for file in dated], default=0)
                for delay in _MARK_DELAYS_NS:
                    os.utime(path, ns=(newest + delay, newest + delay))
                    if path.stat().st_mtime_ns > newest:
                        break

    def _dated_files(self, sequence: str, stage: str) -> list[Path]:
        """Files and folders whose date Snakemake may take for that of an output."""
        if stage == DATASET:
            paths = [self.project.results / name for name in DATASET_OUTPUTS]
        else:
            paths = [self.output(sequence, stage)]
        names = (".snakemake_timestamp", "capture.json", "truth.h5")
        paths += [path / name for path in paths if path.is_dir() for name in names]
        return paths

    def _state(self, sequence: str, stage: str) -> OutputState:
        return self.dataset if stage == DATASET else self.states(sequence)[stage]

    def _decide(self, sequence: str) -> Iterator[tuple[str, OutputState]]:
        """Yield each stage and the state of its output, in the order of the stages."""
        store = self.project.results / sequence / INPUTS_FILE
        checksums = InputChecksums(store, one_look=True)
        new_recording = ""
        if self.project.recordings_made(sequence) is not None:
            state = self._decide_studio(sequence, checksums)
            if state.status is not OutputStatus.done:
                new_recording = "its recording is rendered again"
            yield STUDIO, state
        try:
            annotation = self.project.annotation(sequence, look_at_frames=False)
        except UserError as error:
            yield from self._wait_for_annotation(sequence, error)
            return
        if not any(self.output(sequence, stage).exists() for stage in STAGES):
            for stage in STAGES:  # without reading gigabytes of recordings
                yield stage, OutputState(OutputStatus.missing, (), "")
            return
        fingerprints: dict[str, str] = {}
        for stage, declared in STAGES.items():
            path = self.output(sequence, stage)
            before = read_valid_manifest(path)
            current = stage_manifest(
                self.project,
                sequence,
                stage,
                annotation,
                artefacts={name: fingerprints[name] for name in declared.reads}
                | self._reused(sequence, stage),
                checksums=checksums,
                before=before,
            )
            state = _compare(path, before, current)
            # The content of a new recording is not known yet: "+" makes the fingerprint, and those
            # of all later stages, differ from every stored one.
            if new_recording:
                missing = state.status is OutputStatus.missing
                status = OutputStatus.missing if missing else OutputStatus.stale
                state = OutputState(status, (new_recording,), f"{current.fingerprint}+")
            fingerprints[stage] = state.fingerprint
            if stage == "frames" and state.status is OutputStatus.done:
                try:
                    self.project.annotation(sequence)
                except UserError as error:
                    yield from self._wait_for_annotation(sequence, error)
                    return
            yield stage, state
        checksums.save()

    def _reused(self, sequence: str, stage: str) -> dict[str, str]:
        """Fingerprint of the other sequence's artefact that a stage opens too, by its name."""
        reused = reused_artefact(self.project, sequence, stage)
        if reused is None:
            return {}
        name, path = reused
        other = self.project.reused_sequence(sequence, stage)
        if other in self.project.sequences:
            return {name: self.states(other)[stage].fingerprint}
        manifest = read_manifest(path)  # excluded: taken as it is
        return {name: NOT_RECORDED if manifest is None else manifest.fingerprint}

    def _decide_studio(self, sequence: str, checksums: InputChecksums) -> OutputState:
        current = studio_manifest(self.project, sequence, checksums)
        path = self.output(sequence, STUDIO)
        if not all((path / name).is_file() for name in ("capture.json", "truth.h5")):
            return OutputState(OutputStatus.missing, (), current.fingerprint)
        return _compare(path, read_valid_manifest(path), current)

    def _wait_for_annotation(
        self, sequence: str, error: UserError
    ) -> Iterator[tuple[str, OutputState]]:
        """Yield all stages as stale or missing, because the annotation is invalid."""
        self._annotation_faults[sequence] = str(error)
        for stage in STAGES:
            exists = self.output(sequence, stage).exists()
            status = OutputStatus.stale if exists else OutputStatus.missing
            yield stage, OutputState(status, (str(error),), "")


def failures(project: Project) -> dict[str, str]:
    """Reason of the last failure of each excluded sequence; without those that did not fail."""
    reasons = {name: last_failure(project.logs / name) for name in project.config.exclude}
    return {name: reason for name, reason in reasons.items() if reason}


def _find_fault(output: Path, sequence: str, stage: str) -> str:
    """Read an output; returns an error message if it is missing or damaged, otherwise ""."""
    if not output.exists():
        return f"{output}: is missing; run again"
    if not (output.is_file() or output.is_dir()):
        return f"{output}: is no file; run again"
    manifest = read_manifest(output)
    if manifest is not None and (manifest.sequence, manifest.stage) != (sequence, stage):
        made = f"{manifest.stage} of {manifest.sequence or 'all sequences'}"
        return f"{output}: was made as {made}; run again"
    damage = find_damage(output)
    if manifest is None and not damage:
        return f"{output}: has no manifest, or a damaged one; run again"
    return damage


def mark_of(project: Project, sequence: str, stage: str) -> Path:
    """Path of the mark of a stale output."""
    name = f"{sequence}.{stage}" if sequence else stage
    return MARKS / project.config.dataset / name


def _compare(path: Path, before: Manifest | None, current: Manifest) -> OutputState:
    """State of the output ``path``, which has the manifest ``before``."""
    if not path.exists():
        return OutputState(OutputStatus.missing, (), current.fingerprint)
    if before is None:
        reason = "what it was made from is not recorded, or the file is damaged"
        return OutputState(OutputStatus.stale, (reason,), current.fingerprint)
    if before.fingerprint == current.fingerprint:
        machine, here = _machine(before.machine), _machine(current.machine)
        made_on = machine if machine != here else ""
        return OutputState(OutputStatus.done, (), current.fingerprint, made_on)
    reasons = current.differences(before) or [f"made as stage {before.stage} of {before.sequence}"]
    return OutputState(OutputStatus.stale, tuple(reasons), current.fingerprint)


def _machine(machine: Mapping[str, str]) -> str:
    return f"{machine.get('device', 'cpu')}, {machine.get('cpu', 'unknown')}"
