"""A project on disk: settings, tables and annotations, loaded and checked together."""

from __future__ import annotations

import csv
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from intercap_core.config import Annotation, Config, ObjectEntry, SequenceEntry, SubjectEntry
from intercap_core.errors import UserError

M = TypeVar("M", bound=BaseModel)


@dataclass(frozen=True)
class Project:
    """What one settings file and its tables say."""

    config: Config
    root: Path
    sequences: dict[str, SequenceEntry]
    subjects: dict[str, SubjectEntry]
    objects: dict[str, ObjectEntry]

    def annotation_path(self, sequence: str) -> Path:
        """Where this sequence's annotation file is, or would be."""
        return self.root / self.config.annotations / f"{sequence}.yaml"

    def annotation(self, sequence: str) -> Annotation:
        """Load this sequence's annotation; empty where there is no file.

        Raises UserError naming file and field where the file is broken.
        """
        path = self.annotation_path(sequence)
        if not path.exists():
            return Annotation()
        return _parse(Annotation, read_yaml(path) or {}, str(path), "annotation")


def load_project(path: Path) -> Project:
    """Read and check a settings file and all its tables.

    Raises UserError naming the file, row and field of the first mistakes.
    """
    path = Path(path)
    config = _parse(Config, read_yaml(path) or {}, str(path), "setting")
    root = path.parent
    subjects = {
        row.subject: row for row in _read_table(root / config.subjects, SubjectEntry, "subject")
    }
    objects = _read_objects(root / config.objects)
    sequences: dict[str, SequenceEntry] = {}
    table = root / config.sequences
    for row in _read_table(table, SequenceEntry, "sequence"):
        for field, known in (("subject", subjects), ("object", objects)):
            value = getattr(row, field)
            if value not in known:
                raise UserError(
                    f"{table}: sequence {row.sequence!r} has {field} {value!r}, which is not in "
                    f"the table of {field}s ({', '.join(sorted(known)) or 'empty'}); correct the "
                    f"name or add the {field}"
                )
        sequences[row.sequence] = _absolute(row, table.parent)
    if not sequences:
        raise UserError(f"{table}: holds no sequence; add at least one row")
    for sequence in (config.studio.captures if config.studio else {}) or {}:
        if sequence not in sequences:
            raise UserError(
                f"{path}: studio.captures names {sequence!r}, which {table} does not list; add "
                "the row or remove the capture"
            )
    return Project(config, root, sequences, subjects, objects)


def read_yaml(path: Path) -> Any:
    """Load YAML with the safe loader; raises UserError where it is missing or malformed."""
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(f"{path}: there is no such file; check the path") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f" in line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "not text"
        raise UserError(f"{path}: not valid YAML{where} ({problem}); correct it") from None


def digest(value: BaseModel | Any) -> str:
    """A short digest of settings or of any JSON-like value: equal content, equal digest."""
    if isinstance(value, BaseModel):
        value = value.model_dump(mode="json")
    text = json.dumps(value, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _parse(model: type[M], values: Any, where: str, what: str) -> M:
    if not isinstance(values, dict):
        raise UserError(f"{where}: expected names and values, found {type(values).__name__}")
    try:
        return model.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = ".".join(str(part) for part in first["loc"]) or "(the whole entry)"
        message = first["msg"].removeprefix("Value error, ")
        found = first.get("input")
        shown = "" if isinstance(found, dict) else f", found {found!r}"
        more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
        raise UserError(f"{where}: {what} {field}: {message}{shown}{more}; correct it") from None


def _read_table(path: Path, model: type[M], key: str) -> list[M]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise UserError(f"{path}: there is no such file; check the path in the settings") from None
    lines = [line for line in lines if line.strip() and not line.startswith("#")]
    rows: list[M] = []
    seen: dict[str, int] = {}
    for number, record in enumerate(csv.DictReader(lines, delimiter="\t"), start=1):
        where = f"{path}, row {number} ({record.get(key)!r})"
        if None in record or None in record.values():
            raise UserError(f"{where}: the number of columns differs from the header; use tabs")
        row = _parse(model, {k: v for k, v in record.items() if v != ""}, where, "column")
        name = getattr(row, key)
        if name in seen:
            raise UserError(f"{where}: row {seen[name]} has the same name; names must differ")
        seen[name] = number
        rows.append(row)
    return rows


def _read_objects(path: Path) -> dict[str, ObjectEntry]:
    values = read_yaml(path) or {}
    if not isinstance(values, dict):
        raise UserError(f"{path}: expected object names and entries")
    return {
        name: _absolute(
            _parse(
                ObjectEntry, {"name": name, **(entry or {})}, f"{path}, object {name!r}", "field"
            ),
            path.parent,
        )
        for name, entry in values.items()
    }


def _absolute(entry: M, folder: Path) -> M:
    """Resolve the entry's relative paths against the folder of its file."""
    moved = {
        name: folder / value
        for name, value in entry
        if isinstance(value, Path) and not value.is_absolute()
    }
    return entry.model_copy(update=moved)
