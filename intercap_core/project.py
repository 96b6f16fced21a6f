"""A project on disk: settings, tables and annotations, loaded and checked together."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from intercap_core import artefacts
from intercap_core.annotation import Annotation, RecordingExtent
from intercap_core.config import Config
from intercap_core.entries import ObjectEntry, SequenceEntry, SubjectEntry
from intercap_core.errors import UserError
from intercap_core.formats.detections.class_names import read_label_map
from intercap_core.inputs.documents import read_yaml
from intercap_core.inputs.files import quoted
from intercap_core.schemas import FRAMES
from intercap_core.sequence_inputs import SequenceModels, SequencePaths
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
                f"{_some(self.sequences)}"
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
        values = _or_empty(read_yaml(path))
        annotation = parse_entry(Annotation, values, str(path), "annotation", faults)
        if annotation is None:
            raise UserError(faults[0] + (f" (and {len(faults) - 1} more)" if faults[1:] else ""))
        problem = annotation.check_object(self.sequences[sequence].object)
        if problem:
            raise UserError(
                f"{path}: {problem}; remove the section, or name the object of sequence "
                f"{sequence!r} in the table"
            )
        if not look_at_frames:
            return annotation
        extent = self.recording_extent(sequence)
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

    def annotation_made(self, sequence: str) -> bool:
        """Whether the studio writes this sequence's annotation along with its recordings.

        It holds the truth with errors (``annotate``), the cameras' starts (``states_starts``), or
        both.
        """
        captures = self.config.studio.captures if self.config.studio else {}
        if sequence not in captures:
            return False
        return captures[sequence].annotate or captures[sequence].states_starts is not None

    def recordings_made(self, sequence: str) -> Path | None:
        """Folder into which the studio writes this sequence; None for a real recording."""
        if self.config.studio is None or sequence not in self.config.studio.captures:
            return None
        return self.results / "recordings" / sequence


def load_project(path: Path, overrides: Mapping[str, Any] | None = None) -> Project:
    """Read and check a settings file and all its tables.

    ``overrides`` are settings that replace those of the file, nested as in the file. Raises
    UserError with the first fault of :func:`read_project`.
    """
    project, faults = read_project(path, overrides)
    if faults:
        more = len(faults) - 1
        hint = f" (and {more} more: intercap check {path} lists them)" if more else ""
        raise UserError(faults[0] + hint)
    return project


def read_project(
    path: Path, overrides: Mapping[str, Any] | None = None
) -> tuple[Project, list[str]]:
    """Read a settings file and all its tables; returns the valid part and all faults.

    The faults name file, row and field. Those that others may follow from come first: settings,
    people, objects, sequences, then missing files. If there are faults, the project has the valid
    settings, rows and entries, and rows whose ``subject`` or ``object`` it lacks ("" if the cell is
    faulty). Raises UserError if the settings file cannot be read.
    """
    path = Path(path)
    faults: list[str] = []
    config = _read_config(path, overrides or {}, faults)
    subjects_table = tidy(path.parent / config.subjects)
    people = read_table(subjects_table, SubjectEntry, "subject", path, faults)
    objects_file = tidy(path.parent / config.objects)
    things = _read_objects(objects_file, path, faults)
    table = tidy(path.parent / config.sequences)
    rows = read_table(
        table, SequenceEntry, "sequence", path, faults, references=("subject", "object")
    )
    listed: dict[str, tuple[Mapping[str, BaseModel | None], Path]] = {
        "subject": (people, subjects_table), "object": (things, objects_file),
    }  # fmt: skip
    valid: dict[str, SequenceEntry] = {}
    for name, row in rows.items():
        if row is None:
            continue
        for field, (known, file) in listed.items():
            value = getattr(row, field)
            if value and value not in known:
                faults.append(
                    f"{table}: sequence {name!r} has {field} {value!r}, which is not in "
                    f"the table of {field}s {file} ({_some(known) or 'empty'}); correct the "
                    f"name or add the {field}"
                )
        if name not in config.exclude:
            valid[name] = _absolute(row, table.parent)
    faults += [
        f"{path}: exclude names {name!r}, which {table} does not list"
        for name in sorted(set(config.exclude) - set(rows))
    ]
    if not set(rows) - set(config.exclude) and not any(str(table) in fault for fault in faults):
        faults.append(f"{table}: holds no sequence (or all are excluded); add at least one row")
    if config.device == "cuda":
        faults.append(
            f"{path}: device is 'cuda', expected 'cpu': fits run on the CPU only; set device: cpu"
        )
    subjects = {name: row for name, row in people.items() if row is not None}
    objects = {name: entry for name, entry in things.items() if entry is not None}
    project = Project(config, path, valid, subjects, objects, frozenset(rows))
    faults += [*_faults_of_files(project), *_faults_of_studio(project, rows, table)]
    return project, faults


def _read_config(path: Path, overrides: Mapping[str, Any], faults: list[str]) -> Config:
    """The valid entries of a settings file, with absolute or working-directory-relative paths."""
    values = _or_empty(read_yaml(path))
    if not isinstance(values, dict):
        raise UserError(
            f"{path}: expected names and values, found {type(values).__name__}; "
            "config/README.md lists them"
        )
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


def _some(names: Iterable[str]) -> str:
    """Sorted names as text, at most the first ``MAX_NAMES``."""
    found = sorted(names)
    more = f" and {len(found) - MAX_NAMES} more" if len(found) > MAX_NAMES else ""
    return ", ".join(found[:MAX_NAMES]) + more


def _merged(values: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Values with overrides; nested mappings are merged."""
    merged = dict(values)
    for key, value in overrides.items():
        old = merged.get(key)
        both = isinstance(old, dict) and isinstance(value, Mapping)
        merged[key] = _merged(old, value) if both else value  # type: ignore[arg-type]
    return merged


def _faults_of_files(project: Project) -> Iterator[str]:
    """Messages about missing meshes and body files, which sequences share."""
    for name in project.objects_named():
        entry = project.objects[name]
        for field in ("mesh", "contact_vertices"):
            file = getattr(entry, field)
            if file is not None and not file.is_file():
                yield (
                    f"{tidy(project.path.parent / project.config.objects)}: object {name!r} has "
                    f"{field} {file}, and there is no such file; correct the path"
                )
        problem = project.config.joint.check_object(entry)
        if problem:
            yield f"{tidy(project.path.parent / project.config.objects)}: {problem}"
    for field, file in project.config.body_models:
        if isinstance(file, Path) and not file.is_file():
            yield (
                f"{project.path}: body_models.{field} is {file}, and there is no such file; "
                "correct the path, or remove the line to use the open model"
            )
    definition = project.config.body_fit.keypoint_definition
    if definition is not None and not definition.is_file():
        yield (
            f"{project.path}: body_fit.keypoint_definition is {definition}, and there is no such "
            "file; write it by 'intercap keypoint-definition', or remove the line"
        )
    for file in project.config.joint.lemo_files or ():
        if not file.is_file():
            yield (
                f"{project.path}: joint.lemo is {project.config.joint.lemo}, and there is no file "
                f"{file}; name the folder of LEMO's release, or remove the line to penalise the "
                "joints' accelerations instead"
            )
    yield from _faults_of_bodies(project)
    yield from _faults_of_detectors(project)


def _faults_of_bodies(project: Project) -> Iterator[str]:
    """Messages if body files are named, but none for some subject.

    That subject would get the open body, whose mesh differs from the files'.
    """
    models = project.config.body_models
    named = [gender for gender in ("female", "male") if getattr(models, gender) is not None]
    if not named or models.neutral is not None:
        return
    for name in project.subjects_named():
        gender = project.subjects[name].gender
        if models.of(gender) is None:
            yield (
                f"{project.path}: subject {name!r} is {gender}, and body_models names only a file "
                f"for {' and '.join(named)}; add body_models.{gender} or body_models.neutral, or "
                "remove the lines to use the open body for all"
            )


def _faults_of_detectors(project: Project) -> Iterator[str]:
    """Messages about a detector's model or file of class names that is missing or unreadable."""
    settings = project.config.detections
    models = ("segmentation_model", "keypoint_model")
    for field in (*models, "segmentation_labels", "category_names"):
        file = getattr(settings, field)
        if isinstance(file, Path) and not file.is_file():
            yield (
                f"{project.path}: detections.{field} is {file}, and there is no such file; correct "
                "the path"
            )
        elif isinstance(file, Path) and field not in models:
            try:
                read_label_map(file)
            except UserError as error:
                yield str(error)


def _faults_of_studio(project: Project, rows: Collection[str], table: Path) -> Iterator[str]:
    """Messages about captures that contradict their row of the table of sequences."""
    captures = project.config.studio.captures if project.config.studio else {}
    for sequence in captures:
        if sequence not in rows:
            yield (
                f"{project.path}: studio.captures names {sequence!r}, which {table} does not "
                "list; add the row or remove the capture"
            )
        if sequence not in project.sequences:
            continue
        made = project.recordings_made(sequence)
        given = project.sequences[sequence].recordings
        layouts = captures[sequence].layout, project.sequences[sequence].layout
        if layouts[0] != layouts[1]:
            yield (
                f"{table}: sequence {sequence!r} has layout {layouts[1]!r}, but the studio writes "
                f"{layouts[0]!r} (studio.captures in {project.path}); make them the same"
            )
        if made is not None and made.resolve() != given.resolve():
            yield (
                f"{table}: sequence {sequence!r} has recordings {given}, but the studio writes "
                f"them to {made}; correct the path"
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


def _or_empty(values: Any) -> Any:
    """Contents of a YAML file; an empty file has no entries."""
    return {} if values is None else values


def _read_objects(path: Path, settings: Path, faults: list[str]) -> dict[str, ObjectEntry | None]:
    """Read the objects file: entries by name with resolved paths, None for faulty ones."""
    if not path.exists():
        faults.append(
            f"{path}: there is no such file; check the path 'objects' in the settings, {settings}"
        )
        return {}
    try:
        values = _or_empty(read_yaml(path))
    except UserError as error:
        faults.append(str(error))
        return {}
    if not isinstance(values, dict):
        faults.append(
            f"{path}: expected object names and entries, found {type(values).__name__}; correct it"
        )
        return {}
    objects: dict[str, ObjectEntry | None] = {}
    for name, entry in values.items():
        where = f"{path}, object {quoted(name)}"
        if not isinstance(entry, dict | None):
            faults.append(
                f"{where}: expected fields such as 'mesh: cup.ply', found {quoted(entry)}; correct "
                "it"
            )
            objects[name] = None
            continue
        fields = {"name": name, **(entry or {})}
        parsed = parse_entry(ObjectEntry, fields, where, "field", faults)
        objects[name] = None if parsed is None else _absolute(parsed, path.parent)
    return objects


def _absolute(entry: M, folder: Path) -> M:
    """Resolve the entry's relative paths against the folder of its file."""
    moved = {name: tidy(folder / value) for name, value in entry if isinstance(value, Path)}
    return entry.model_copy(update=moved)
