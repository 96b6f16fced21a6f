"""What is done, missing or out of date, and why: the one decision on what a run computes.

It compares each output's record with what the output would be made from now. Nothing else counts:
no file's date, no bookkeeping beside the results, so it holds wherever these lie. These only save
reading: an artefact of another size or date than it was left with is read through, and is made anew
where it is damaged.
"""

from __future__ import annotations

import os
import time
import uuid
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from pathlib import Path

from intercap_core.errors import UserError
from intercap_core.pipeline import given
from intercap_core.pipeline.contents import NAME as CONTENTS_NAME
from intercap_core.pipeline.contents import Contents
from intercap_core.pipeline.given import STUDIO
from intercap_core.pipeline.intact import damage_of, is_as_left, note
from intercap_core.pipeline.job import last_failure
from intercap_core.pipeline.kept import keep, read_kept
from intercap_core.pipeline.record import FILE, Record, read_record
from intercap_core.project import Project
from intercap_core.stage_list import STAGES

DATASET = "dataset"
OF_ALL = (  # what is made of all sequences
    "site/index.html", "summary.json", "heatmaps.h5", "tables", "card.md", "card.json",
    "croissant.json",
)  # fmt: skip
MARKS = Path(".snakemake") / "out_of_date"
_KNOWN = ".records.json"  # of all outputs, by place, size and date: to open each once
_LATER_S = 1.0


class Kind(StrEnum):
    """State of one output."""

    done = "done"
    missing = "missing"
    stale = "stale"


@dataclass(frozen=True)
class State:
    """One output: why it is not done, in words, and the identity that it is to have, which its
    successors are made from."""

    kind: Kind
    reasons: tuple[str, ...]
    identity: str
    made_on: str = ""  # another machine or device than this, where it is done


class Plan:
    """States of a project's outputs, looked at when asked for."""

    def __init__(self, project: Project) -> None:
        self.project = project
        self._sequences: dict[str, dict[str, State]] = {}
        self._faults: dict[str, str] = {}
        self._records = _Records(project.results)

    def states(self, sequence: str) -> dict[str, State]:
        """By stage, the studio first where it makes the recordings."""
        if sequence not in self._sequences:
            self._sequences[sequence] = dict(self._decide(sequence))
        return self._sequences[sequence]

    @cached_property
    def dataset(self) -> State:
        """Of tables, card and the site's first page."""
        path = self.project.site / "index.html"
        wanted = given.dataset_record(
            self.project,
            {name: self.states(name)["summary"].identity for name in self.project.sequences},
            failures(self.project),
        )
        files = [self.project.results / name for name in OF_ALL]
        there = all(file.exists() for file in files)
        whole = not any(damage_of(file) for file in noted(files) if not is_as_left(file))
        record = self._records.of(dataset_record_of(self.project)) if there and whole else None
        return _compared(path if there else Path("none"), record, wanted)

    def output(self, sequence: str, stage: str) -> Path:
        """Where a stage of a sequence writes."""
        made = self.project.recordings_made(sequence)
        if stage == STUDIO and made is not None:
            return made
        return self.project.artefact(sequence, stage)

    def all_done(self) -> bool:
        """Whether every output of every sequence, and what is made of all, is there and as it would
        be made now."""
        done = all(
            state.kind is Kind.done
            for name in self.project.sequences
            for state in self.states(name).values()
        )
        return done and self.dataset.kind is Kind.done

    def is_stale(self, sequence: str, stage: str) -> bool:
        """Whether an output is there that was made from something else than it would be now."""
        return self._state(sequence, stage).kind is Kind.stale

    def identity(self, sequence: str, stage: str) -> str:
        """What the output is to be made from, "" where that is not known yet."""
        return self._state(sequence, stage).identity

    def annotation_fault(self, sequence: str) -> str:
        """What is wrong with the sequence's annotation, "" = nothing; what it says of frames counts
        as long as those are the ones that it is of."""
        states = self.states(sequence)
        return self._faults.get(sequence, "") if states else ""

    def mark(self, sequence: str, stage: str) -> list[Path]:
        """A file newer than the stage's output where that is out of date, else nothing.

        It makes Snakemake run the job: of other inputs it is told to ignore the dates.
        """
        path = mark_of(self.project, sequence, stage)
        if not self.is_stale(sequence, stage):
            return []
        state = self._state(sequence, stage)
        output = self.project.site / "index.html"
        if stage != DATASET:
            output = self.output(sequence, stage)
        path.parent.mkdir(parents=True, exist_ok=True)
        newest = max([one.stat().st_mtime for one in _dated(output)], default=0.0)
        if not path.is_file() or path.stat().st_mtime <= newest:
            told = [*state.reasons, uuid.uuid4().hex]  # as no earlier mark, whatever is compared
            path.write_text("\n".join(told) + "\n", encoding="utf-8")
            later = max(newest, time.time()) + _LATER_S
            os.utime(path, (later, later))
        return [path]

    def mark_all(self) -> None:
        """Write all marks that there will be: Snakemake lists their folder once, and takes those
        that are written later for missing."""
        for name in self.project.sequences:
            for stage in self.states(name):
                self.mark(name, stage)
        self.mark("", DATASET)

    def _state(self, sequence: str, stage: str) -> State:
        return self.dataset if stage == DATASET else self.states(sequence)[stage]

    def keep(self) -> None:
        """Write what was read of records, for the next start."""
        self._records.keep()

    def _decide(self, sequence: str) -> Iterator[tuple[str, State]]:
        contents = Contents(self.project.results / sequence / CONTENTS_NAME)
        made_anew = ""
        if self.project.recordings_made(sequence) is not None:
            wanted = given.studio_record(self.project, sequence, contents)
            path = self.output(sequence, STUDIO)
            whole = all((path / name).is_file() for name in ("capture.json", "truth.h5"))
            state = _compared(path if whole else Path("none"), self._records.of(path), wanted)
            if state.kind is not Kind.done:
                made_anew = "its recording is made anew"
            yield STUDIO, state
        there = {stage: _exists(self.output(sequence, stage)) for stage in STAGES}
        try:
            annotation = self.project.annotation(sequence, look_at_frames=False)
        except UserError as error:
            yield from self._broken(sequence, error, there)
            return
        if not any(there.values()):  # without reading gigabytes to say so
            for stage in STAGES:
                yield stage, State(Kind.missing, (), "")
            return
        identities: dict[str, str] = {}
        for stage, declared in STAGES.items():
            path = self.output(sequence, stage)
            before = self._records.of(path)
            wanted = given.record(
                self.project,
                sequence,
                stage,
                annotation,
                artefacts={name: identities[name] for name in declared.reads},
                contents=contents,
                before=before,
            )
            state = _compared(path, before, wanted)
            if made_anew:  # of what its recordings will be nothing is known
                kind = Kind.missing if state.kind is Kind.missing else Kind.stale
                state = State(kind, (made_anew,), f"{wanted.identity}+")
            identities[stage] = state.identity
            if stage == "frames" and state.kind is Kind.done:
                try:
                    self.project.annotation(sequence)
                except UserError as error:
                    yield from self._broken(sequence, error, there)
                    return
            yield stage, state
        contents.keep()

    def _broken(
        self, sequence: str, error: UserError, there: Mapping[str, bool]
    ) -> Iterator[tuple[str, State]]:
        """All stages wait for the annotation to be mended."""
        self._faults[sequence] = str(error)
        for stage in STAGES:
            yield stage, State(Kind.stale if there[stage] else Kind.missing, (str(error),), "")


def failures(project: Project) -> dict[str, str]:
    """Why the sequences failed that the settings exclude, of those that did."""
    found = {name: last_failure(project.logs / name) for name in project.config.exclude}
    return {name: why for name, why in found.items() if why}


def noted(files: Iterable[Path]) -> list[Path]:
    """Those of the files that are made of all sequences that are known again by their digests."""
    return [file for file in files if file.parent.name != "site" and file.is_file()]


def mark_of(project: Project, sequence: str, stage: str) -> Path:
    """Where the mark of a stage that is out of date would be."""
    name = f"{sequence}.{stage}" if sequence else stage
    return MARKS / project.config.dataset / name


def dataset_record_of(project: Project) -> Path:
    """The folder that holds the record of what is made of all sequences."""
    return project.results


def _compared(path: Path, before: Record | None, wanted: Record) -> State:
    if not _exists(path):
        return State(Kind.missing, (), wanted.identity)
    if before is None:
        why = "what it was made from is not recorded, or the file is damaged"
        return State(Kind.stale, (why,), wanted.identity)
    if before.identity == wanted.identity:
        machines = [f"{one.machine.get('device', 'cpu')}, {one.machine.get('cpu', 'unknown')}"
                    for one in (before, wanted)]  # fmt: skip
        other = machines[0] if machines[0] != machines[1] else ""
        return State(Kind.done, (), wanted.identity, other)
    reasons = wanted.differences(before) or [f"made as stage {before.stage} of {before.sequence}"]
    return State(Kind.stale, tuple(reasons), wanted.identity)


def _exists(path: Path) -> bool:
    return path.is_dir() or path.is_file()


def _dated(output: Path) -> list[Path]:
    """What may carry an output's date."""
    found = [output, output / ".snakemake_timestamp", output / "capture.json", output / "truth.h5"]
    return [path for path in found if path.exists()]


class _Records:
    """Records of outputs, each opened once as long as its size and date stay. An artefact that is
    not as it was left is read through, and has no record where it is damaged."""

    def __init__(self, results: Path) -> None:
        self._path = results / _KNOWN
        self._results = results
        self._known = read_kept(self._path)
        self._changed = False

    def of(self, output: Path) -> Record | None:
        """The output's record; None where it has none."""
        file = output if output.suffix == ".h5" else output / FILE
        try:
            with open(file, "rb") as opened:
                stat = os.fstat(opened.fileno())
        except FileNotFoundError:
            return None
        except OSError as error:
            raise UserError(
                f"{file}: cannot be read ({error.strerror}); make it readable, or delete it, then "
                "run again"
            ) from None
        key, stamp = str(output), f"{stat.st_size} {stat.st_mtime_ns} {stat.st_ino}"
        known = self._known.get(key)
        if known is not None and known[0] == stamp:
            return Record.from_text(known[1])
        found = read_record(output)
        if found is not None and file == output and not is_as_left(output):
            if damage_of(output):
                return None
            note(output)
        if found is not None:  # that there is none may be a fault that passes
            self._known[key] = [stamp, found.to_text()]
            self._changed = True
        return found

    def keep(self) -> None:
        if not self._changed or not self._results.is_dir():
            return
        keep(self._path, self._known)
