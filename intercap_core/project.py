"""A project on disk: settings, tables and annotations, loaded and checked together."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from intercap_core import artefacts
from intercap_core.annotation import Annotation, RecordingExtent
from intercap_core.config import Config, StudioCapture
from intercap_core.entries import ObjectEntry, SequenceEntry, SubjectEntry
from intercap_core.errors import UserError
from intercap_core.formats.detections.class_names import read_label_map
from intercap_core.inputs.documents import read_yaml
from intercap_core.inputs.files import name_some, quoted
from intercap_core.schemas import FRAMES
from intercap_core.sequence_inputs import SequenceModels, SequencePaths
from intercap_core.stage_list import STAGES
from intercap_core.validation import describe, parse_entry, read_table

M = TypeVar("M", bound=BaseModel)
MAX_NAMES = 40  # names of a table that a message lists


@dataclass(frozen=True)
class Project:
    """Settings file with its tables."""

    config: Config
    """Settings, with absolute or working-directory-relative paths."""
    path: Path
    """Path of the settings file."""
    sequences: dict[str, SequenceEntry]
    """Rows of the table of sequences by name, without excluded sequences."""
    subjects: dict[str, SubjectEntry]
    """Rows of the table of subjects by name."""
    objects: dict[str, ObjectEntry]
    """Entries of the objects file by name."""
    listed: frozenset[str] = frozenset()
    """Names of all rows of the table of sequences, with excluded and faulty ones."""

    @property
    def results(self) -> Path:
        """Folder of this dataset's artefacts."""
        return self.config.results / self.config.dataset

    @property
    def root(self) -> Path:
        """Folder in which the workflow runs and below which it writes; see :func:`root_of`."""
        return root_of(self.path)

    @property
    def logs(self) -> Path:
        """Folder of this dataset's logs."""
        return tidy(self.root / "logs" / self.config.dataset)

    @property
    def benchmarks(self) -> Path:
        """Folder of the seconds and the memory that each of this dataset's jobs took."""
        return tidy(self.root / "benchmarks" / self.config.dataset)

    def target(self, path: Path) -> str:
        """A path as the workflow names it: relative to the root if it lies below it."""
        return str(tidy(path, self.root))

    def require_sequence(self, name: str) -> None:
        """Raise UserError if the table of sequences has no such row."""
        if name not in self.sequences:
            raise UserError(
                f"{self.path}: sequence {name!r} is not in the table; it lists "
                f"{name_some(sorted(self.sequences), MAX_NAMES)}"
            )

    def paths(self, sequence: str) -> SequencePaths:
        """Paths of the sequence's artefacts, from frames to metrics."""
        return SequencePaths(
            **{stage.name: self.artefact(sequence, stage.name) for stage in fields(SequencePaths)}
        )

    def models(self, sequence: str) -> SequenceModels:
        """The object, subject and body files of the sequence."""
        subject = self.subjects[self.sequences[sequence].subject]
        return SequenceModels(self.object_of(sequence), subject, self.config.body_models)

    def object_of(self, sequence: str) -> ObjectEntry | None:
        """The sequence's object; None for a person without an object."""
        return self.objects.get(self.sequences[sequence].object or "")

    def objects_named(self) -> list[str]:
        """Sorted names of the objects in the table of sequences."""
        return sorted({row.object for row in self.sequences.values() if row.object in self.objects})

    def subjects_named(self) -> list[str]:
        """Sorted names of the people in the table of sequences."""
        return sorted({row.subject for row in self.sequences.values()} & set(self.subjects))

    def reused_sequence(self, sequence: str, stage: str) -> str | None:
        """Sequence whose artefact of ``stage`` this stage of ``sequence`` opens too; None = none.

        The sequence may be excluded.
        """
        column = STAGES[stage].reuses
        return getattr(self.sequences[sequence], column) if column else None

    def annotation_path(self, sequence: str) -> Path:
        """Path of the sequence's annotation file, which need not exist."""
        if self.annotation_made(sequence):
            return self.results / "recordings" / sequence / "annotation.yaml"
        named = self.sequences[sequence].annotation if sequence in self.sequences else None
        if named is not None:
            return named
        return tidy(self.path.parent / self.config.annotations / f"{sequence}.yaml")

    def artefact(self, sequence: str, stage: str) -> Path:
        """Path of a stage's output: a file, or a folder for export and page."""
        if stage == "page":
            return self.site / "sequences" / sequence
        return self.results / sequence / ("export" if stage == "export" else f"{stage}.h5")

    @property
    def site(self) -> Path:
        """Folder of the site, which is self-contained."""
        return self.results / "site"

    def annotation(self, sequence: str, *, look_at_frames: bool = True) -> Annotation:
        """Load the sequence's annotation; an empty one if there is no file.

        Raises UserError, with file and field, if the file is invalid, if the table names a missing
        file, or if an entry lies outside of the recording.

        Args:
            look_at_frames: compare the entries with the frames artefact, if it exists.
        """
        path = self.annotation_path(sequence)
        if not os.path.lexists(path):
            if path == self.sequences[sequence].annotation:
                raise UserError(
                    f"{path}: no such file, but sequence {sequence!r} names it in the column "
                    "annotation; correct the column or clear it"
                )
            return Annotation()
        faults: list[str] = []
        annotation = parse_entry(Annotation, read_yaml(path), str(path), "annotation", faults)
        if annotation is None:
            raise UserError(faults[0] + (f" (and {len(faults) - 1} more)" if faults[1:] else ""))
        problem = annotation.check_object(self.sequences[sequence].object)
        if problem:
            raise UserError(
                f"{path}: {problem}; remove the section, or name the object of sequence "
                f"{sequence!r} in the table"
            )
        extent = self.recording_extent(sequence) if look_at_frames else None
        problem = annotation.check_recording(extent) if extent else None
        if extent and problem:
            counted = " (numbered from 0)" if annotation.check_frames(extent.frames) else ""
            raise UserError(f"{path}: {problem}{counted}; correct the entry")
        return annotation

    def recording_extent(self, sequence: str) -> RecordingExtent | None:
        """Extent of the recording by its frames artefact; None if there is none."""
        with (
            contextlib.suppress(artefacts.Unreadable),
            artefacts.read(self.artefact(sequence, "frames"), FRAMES) as source,
        ):
            sizes = [(int(width), int(height)) for width, height in source["colour_size"]]
            return RecordingExtent(
                len(source["times"]),
                dict(zip(source.text("camera_names"), sizes, strict=True)),
                str(source.attributes["master"]),
            )
        return None

    @property
    def captures(self) -> Mapping[str, StudioCapture]:
        """The studio's recordings by sequence."""
        return self.config.studio.captures if self.config.studio else {}

    def annotation_made(self, sequence: str) -> bool:
        """Whether the studio writes this sequence's annotation along with its recordings.

        It holds the truth with errors (``annotate``), the cameras' starts (``states_starts``), or
        both.
        """
        capture = self.captures.get(sequence)
        return capture is not None and (capture.annotate or capture.states_starts is not None)

    def recordings_made(self, sequence: str) -> Path | None:
        """Folder into which the studio writes this sequence; None for a real recording."""
        return self.results / "recordings" / sequence if sequence in self.captures else None


def load_project(path: Path, overrides: Mapping[str, Any] | None = None) -> Project:
    """Read and check a settings file and all its tables.

    ``overrides`` are settings that replace those of the file, nested as in the file. Raises
    UserError with the first fault of :func:`read_project`.
    """
    project, faults = read_project(path, overrides)
    if faults:
        hint = f" (and {len(faults) - 1} more: intercap check {path} lists them)"
        raise UserError(faults[0] + (hint if len(faults) > 1 else ""))
    return project


def read_project(
    path: Path, overrides: Mapping[str, Any] | None = None
) -> tuple[Project, list[str]]:
    """Read a settings file and all its tables; returns the valid part and all faults.

    Faults that others may follow from come first: settings, people, objects, sequences, then
    missing files. The valid part may have rows whose ``subject`` or ``object`` it lacks ("" if the
    cell is faulty). Raises UserError if the settings file cannot be read.
    """
    path = Path(path)
    faults: list[str] = []
    config = _read_config(path, overrides or {}, faults)
    subjects_table = tidy(path.parent / config.subjects)
    people = read_table(subjects_table, SubjectEntry, "subject", path, faults)
    objects_file = tidy(path.parent / config.objects)
    entries = _read_objects(objects_file, path, faults)
    table = tidy(path.parent / config.sequences)
    rows = read_table(
        table, SequenceEntry, "sequence", path, faults, references=("subject", "object")
    )
    listed: dict[str, tuple[Mapping[str, BaseModel | None], Path]] = {
        "subject": (people, subjects_table), "object": (entries, objects_file),
    }  # fmt: skip
    valid: dict[str, SequenceEntry] = {}
    for name, row in rows.items():
        if row is None:
            continue
        for field, (known, file) in listed.items():
            value = getattr(row, field)
            if value and value not in known:
                names = name_some(sorted(known), MAX_NAMES) or "empty"
                faults.append(
                    f"{table}: sequence {name!r} has {field} {value!r}, which is not in "
                    f"the table of {field}s {file} ({names}); correct the name or add the {field}"
                )
        if name not in config.exclude:
            valid[name] = _absolute(row, table.parent)
    faults += _faults_of_reuse(rows, table)
    faults += [
        f"{path}: exclude names {name!r}, which {table} does not list"
        for name in sorted(set(config.exclude) - set(rows))
    ]
    if not set(rows) - set(config.exclude) and not any(str(table) in fault for fault in faults):
        faults.append(f"{table}: holds no sequence (or all are excluded); add at least one row")
    subjects = {name: row for name, row in people.items() if row is not None}
    objects = {name: entry for name, entry in entries.items() if entry is not None}
    project = Project(config, path, valid, subjects, objects, frozenset(rows))
    faults += [*_faults_of_files(project), *_faults_of_studio(project, rows, table)]
    return project, faults


def _read_config(path: Path, overrides: Mapping[str, Any], faults: list[str]) -> Config:
    """The valid entries of a settings file, with absolute or working-directory-relative paths."""
    values = _read_mapping(path, "names and values", "config/README.md lists them")
    values = _merged(values, overrides)
    try:
        config = Config.model_validate(values)
    except ValidationError as error:
        faults += describe(error, Config, str(path), "setting")
        config = _valid_part(values)
    sections = {name: value for name, value in config if isinstance(value, BaseModel)}
    moved = {name: _absolute(value, path.parent) for name, value in sections.items()}
    return config.model_copy(update={**moved, "results": tidy(root_of(path) / config.results)})


def _valid_part(values: Mapping[str, Any]) -> Config:
    """The settings without the entries that are not valid."""
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        for fault in error.errors():
            values = _without(values, fault["loc"])
        return _valid_part({"dataset": "unnamed", **values})


def _without(values: Mapping[str, Any], place: Sequence[int | str]) -> dict[str, Any]:
    """Nested values without the entry at a place, or without the one that should hold it."""
    left = dict(values)
    inner = left.pop(str(place[0])) if place and place[0] in left else None
    if isinstance(inner, dict) and len(place) > 1 and place[1] in inner:
        left[str(place[0])] = _without(inner, place[1:])
    return left


def _merged(values: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Values with overrides; nested mappings are merged."""
    merged = dict(values)
    for key, value in overrides.items():
        old = merged.get(key)
        both = isinstance(old, dict) and isinstance(value, Mapping)
        merged[key] = _merged(old, value) if both else value  # type: ignore[arg-type]
    return merged


def _named_files(project: Project) -> Iterator[tuple[str, Path | None, str]]:
    """Files that sequences share: beginning and end of a message that a file is missing."""
    config, settings = project.config, project.path
    for name in project.objects_named():
        for field in ("mesh", "contact_vertices"):
            place = f"{tidy(settings.parent / config.objects)}: object {name!r} has {field}"
            yield place, getattr(project.objects[name], field), "correct the path"
    for field, file in config.body_models:
        advice = "correct the path, or remove the line to use the open model"
        yield f"{settings}: body_models.{field} is", file, advice
    advice = "write it by 'intercap keypoint-definition', or remove the line"
    definition = config.body_fit.keypoint_definition
    yield f"{settings}: body_fit.keypoint_definition is", definition, advice
    for file in config.joint.lemo_files or ():
        advice = "name the folder of LEMO's release, or remove the line"
        yield f"{settings}: joint.lemo is {config.joint.lemo} and names", file, advice
    for field in ("segmentation_model", "keypoint_model", "segmentation_labels", "category_names"):
        file = getattr(config.detections, field)
        yield f"{settings}: detections.{field} is", file, "correct the path"


def _faults_of_reuse(rows: Mapping[str, SequenceEntry | None], table: Path) -> Iterator[str]:
    """Messages about rows whose columns of ``Stage.reuses`` name an unsuitable sequence."""
    present = [row for row in rows.values() if row is not None]
    columns = [
        column
        for stage in STAGES.values()
        if (column := stage.reuses) and any(getattr(row, column) for row in present)
    ]
    named: dict[str, set[str]] = {}
    for name, row in rows.items():
        for column in columns if row is not None else ():
            other = getattr(row, column)
            if other is None:
                continue
            place = f"{table}: sequence {name!r} has {column} {other!r}"
            problem = f"which the table does not list ({name_some(sorted(rows), MAX_NAMES)})"
            if other in rows:
                problem = _mismatch(column, name, row, other, rows[other])
            if problem:
                yield f"{place}, {problem}; name another sequence or clear the cell"
            else:
                named.setdefault(name, set()).add(other)
    try:
        tuple(TopologicalSorter(named).static_order())
    except CycleError as error:
        cycle = " -> ".join(reversed(error.args[1]))
        yield (
            f"{table}: the columns {' and '.join(columns)} lead from a sequence back to itself "
            f"({cycle}), so that none of them can be computed first; clear one of the cells"
        )


def _mismatch(
    column: str, name: str, row: SequenceEntry | None, other: str, source: SequenceEntry | None
) -> str:
    """Reason why ``row`` cannot reuse what was estimated in the row ``source``; "" = none."""
    if other == name:
        return "which is the row itself"
    if row is None or source is None:
        return ""
    if column == "shape_from" and row.subject != source.subject:
        return f"but {name!r} shows subject {row.subject!r} and {other!r} {source.subject!r}"
    if column != "rig_from":
        return ""
    scales = row.calibration_scale, source.calibration_scale
    if row.calibration == source.calibration and scales[0] != scales[1]:
        return (
            f"but their calibration_scale differs: {scales[0]} for {name!r}, {scales[1]} for "
            f"{other!r}"
        )
    return ""


def _faults_of_files(project: Project) -> Iterator[str]:
    """Messages about missing meshes, body files and models, and about what they lack."""
    config = project.config
    for place, file, advice in _named_files(project):
        if isinstance(file, Path) and not file.is_file():
            yield f"{place} {file}, and there is no such file; {advice}"
    for name in project.objects_named():
        problem = config.joint.check_object(project.objects[name])
        if problem:
            yield f"{tidy(project.path.parent / config.objects)}: {problem}"
    for labels in (config.detections.segmentation_labels, config.detections.category_names):
        if isinstance(labels, Path) and labels.is_file():
            try:
                read_label_map(labels)
            except UserError as error:
                yield str(error)
    # A subject without a file would get the open body, whose mesh differs from the files'.
    models = config.body_models
    named = [gender for gender in ("female", "male") if getattr(models, gender) is not None]
    for name in project.subjects_named() if named else ():
        gender = project.subjects[name].gender
        if models.of(gender) is None:
            yield (
                f"{project.path}: subject {name!r} is {gender}, and body_models names only a file "
                f"for {' and '.join(named)}; add body_models.{gender} or body_models.neutral, or "
                "remove the lines to use the open body for all"
            )


def _faults_of_studio(project: Project, rows: Collection[str], table: Path) -> Iterator[str]:
    """Messages about captures that contradict their row of the table of sequences."""
    for sequence, capture in project.captures.items():
        if sequence not in rows:
            yield (
                f"{project.path}: studio.captures names {sequence!r}, which {table} does not "
                "list; add the row or remove the capture"
            )
        row, made = project.sequences.get(sequence), project.recordings_made(sequence)
        if row is not None and row.layout != capture.layout:
            yield (
                f"{table}: sequence {sequence!r} has layout {row.layout!r}, but the studio writes "
                f"{capture.layout!r} (studio.captures in {project.path}); make them the same"
            )
        if row is not None and made is not None and made.resolve() != row.recordings.resolve():
            yield (
                f"{table}: sequence {sequence!r} has recordings {row.recordings}, but the studio "
                f"writes them to {made}; correct the path"
            )


def root_of(settings: Path) -> Path:
    """Root of the project of a settings file: relative results, logs and benchmarks lie below it.

    It is the folder that holds ``config/`` for ``config/*.yaml`` and ``config/<name>/*.yaml``, as
    Snakemake's conventions have it; otherwise the folder of the settings file.
    """
    folder = Path(os.path.abspath(settings)).parent
    near = (folder, folder.parent)
    return tidy(next((place.parent for place in near if place.name == "config"), folder))


def tidy(path: Path, folder: Path | None = None) -> Path:
    """The path without "..", relative to ``folder`` (the working directory) if it lies below it."""
    absolute = Path(os.path.abspath(path))
    here = Path.cwd() if folder is None else Path(os.path.abspath(folder))
    return absolute.relative_to(here) if absolute.is_relative_to(here) else absolute


def _read_mapping(path: Path, expected: str, advice: str) -> dict[Any, Any]:
    """Names and values of a YAML file; {} for an empty file."""
    values = read_yaml(path)
    if not isinstance(values, dict | None):
        raise UserError(f"{path}: expected {expected}, found {type(values).__name__}; {advice}")
    return values or {}


def _read_objects(path: Path, settings: Path, faults: list[str]) -> dict[str, ObjectEntry | None]:
    """Read the objects file: entries by name with resolved paths, None for faulty ones."""
    try:
        values = _read_mapping(path, "object names and entries", "correct it")
    except UserError as error:
        faults.append(f"{error}; {settings} names this file in the setting objects")
        return {}
    objects: dict[str, ObjectEntry | None] = {}
    for name, entry in values.items():
        where, fields = f"{path}, object {quoted(name)}", entry
        if isinstance(entry, dict | None):
            fields = {"name": name, **(entry or {})}
        parsed = parse_entry(ObjectEntry, fields, where, "field", faults)
        objects[name] = None if parsed is None else _absolute(parsed, path.parent)
    return objects


def _absolute(entry: M, folder: Path) -> M:
    """Resolve the entry's relative paths against the folder of its file."""
    moved = {name: tidy(folder / value) for name, value in entry if isinstance(value, Path)}
    return entry.model_copy(update=moved)
