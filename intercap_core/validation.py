"""Validate entries of settings, tables and annotations by their models; collect all faults."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from intercap_core.inputs.files import UnreadableFile, printable, quoted, read_text

M = TypeVar("M", bound=BaseModel)

# Expected values by the kind of pydantic's errors <kind>_type and <kind>_parsing
_KINDS = {
    "float": "a number", "int": "a whole number", "bool": "true or false", "string": "text",
    "path": "a path", "list": "a list", "tuple": "a list", "dict": "names and values",
    "model": "names and values", "model_attributes": "names and values",
}  # fmt: skip
_EXPECTATIONS = {
    "finite_number": "must be a finite number",
    "greater_than": "must be above {gt:g}",
    "greater_than_equal": "must be at least {ge:g}",
    "int_from_float": "must be a whole number",
    "less_than": "must be below {lt:g}",
    "less_than_equal": "must be at most {le:g}",
    "literal_error": "must be {expected}",
    "string_pattern_mismatch": (
        "a name has letters, digits, _ and - only, and does not start with -"
    ),
    "string_too_long": "must have at most {max_length} characters",
    "too_long": "must have at most {max_length} entries",
    "too_short": "must have at least {min_length} entries",
}


def parse_entry(model: type[M], values: Any, where: str, what: str, faults: list[str]) -> M | None:
    """Validate values by a model; None if they are not valid.

    Args:
        model: the model.
        values: names and values; None = there are none.
        where: place of the entry, for messages.
        what: kind of a field, such as "setting".
        faults: gets one message for each fault.
    """
    if not isinstance(values, dict | None):
        faults.append(f"{where}: expected names and values, found {quoted(values)}; correct it")
        return None
    try:
        return model.model_validate(values or {})
    except ValidationError as error:
        faults += describe(error, model, where, what)
        return None


def describe(error: ValidationError, model: type[BaseModel], where: str, what: str) -> list[str]:
    """One message for each fault that a model has found; arguments as of :func:`parse_entry`."""
    return [
        f"{where}: {what} {field or '(the whole entry)'}: {text}"
        for field, text in list_faults(error, model, what)
    ]


def list_faults(error: ValidationError, model: type[BaseModel], what: str) -> list[tuple[str, str]]:
    """Field ("" for the whole entry) and message of each fault; arguments as of parse_entry."""
    faults = []
    for fault in error.errors(include_url=False):
        parts = [str(part)[:80] for part in fault["loc"] if "[" not in str(part)]  # tags of unions
        found = fault.get("input")
        shown = "" if isinstance(found, dict) else f", found {quoted(found)}"
        if fault["type"] == "missing":
            text = "missing; add it"
        elif fault["type"] == "extra_forbidden":
            similar = _similar(str(fault["loc"][-1]), model)
            hint = f" (similar: {', '.join(similar)})" if similar else ""
            text = f"no such {what}{hint}; config/README.md lists them"
        else:
            text = f"{_expectation(fault)[:400]}{shown}; correct it"
        faults.append((printable(".".join(parts)), printable(text)))
    return faults


def _expectation(fault: ErrorDetails) -> str:
    """What a model expects instead of a value; its own words for errors of its validators."""
    kind, _, problem = fault["type"].rpartition("_")
    if problem in ("parsing", "type") and kind in _KINDS:
        return f"must be {_KINDS[kind]}"
    form = _EXPECTATIONS.get(fault["type"], fault["msg"].removeprefix("Value error, "))
    return form.format(**fault.get("ctx", {})) if fault["type"] in _EXPECTATIONS else form


def _similar(name: str, model: type[BaseModel]) -> list[str]:
    """Fields with the most similar name, of the model and of those in it."""
    places = list(_fields(model))
    closest = get_close_matches(name, {place.rpartition(".")[2] for place in places}, n=1)
    return [place for place in places if place.rpartition(".")[2] in closest][:3]


def _fields(model: type[BaseModel], above: str = "") -> Iterator[str]:
    for name, field in model.model_fields.items():
        yield f"{above}{name}"
        for inner in _models(field.annotation):
            yield from _fields(inner, f"{above}{name}.")


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    """Models in an annotation such as ``tuple[Model, ...] | None``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from _models(part)


def read_table(
    path: Path,
    model: type[M],
    key: str,
    settings: Path,
    faults: list[str],
    references: Sequence[str] = (),
) -> dict[str, M | None]:
    """Read a tab-separated table with a header; returns its rows by name, None for faulty rows.

    Empty lines and lines that begin with # are skipped. A row whose only faults are references is
    returned with "" in their place.

    Args:
        path: file of the table.
        model: model of a row.
        key: column with unique names.
        settings: settings file that names the table, for messages.
        faults: gets one message for each fault.
        references: columns that name rows of other tables.
    """
    try:
        lines = read_text(path).splitlines()
    except UnreadableFile as error:
        faults.append(
            f"{path}: not a readable text file ({error.reason}); check the path in the settings, "
            f"{settings}"
        )
        return {}
    numbered = [
        (number, line)
        for number, line in enumerate(lines, start=1)
        if line.strip() and not line.startswith("#")
    ]
    header = numbered[0][1].split("\t") if numbered else []
    problems = _faults_of_header(header, model)
    if problems:
        first = numbered[0][0] if numbered else 1
        faults += [f"{path}, line {first}: {problem}" for problem in problems]
        return {}
    rows: dict[str, M | None] = {}
    seen: dict[str, int] = {}
    for number, line in numbered[1:]:
        fields = line.split("\t")
        record = dict(zip(header, fields, strict=False))
        name = record.get(key, "")
        where = f"{path}, line {number} ({key} {quoted(name)})"
        if len(fields) != len(header):
            faults.append(f"{where}: the number of columns differs from the header; use tabs")
            rows.setdefault(name, None)
            continue
        record = {column: cell for column, cell in record.items() if cell}
        try:
            row: M | None = model.model_validate(record)
        except ValidationError as error:
            faults += describe(error, model, where, "column")
            wrong = {str(part) for fault in error.errors() for part in fault["loc"] or [""]}
            row = None
            if wrong <= {*references}:
                row = parse_entry(
                    model, record | dict.fromkeys(wrong, name), where, "column", faults
                )
                row = row and row.model_copy(update=dict.fromkeys(wrong, ""))
        if row is not None and name in seen:
            faults.append(f"{where}: line {seen[name]} has the same name; names must differ")
            continue
        seen.setdefault(name, number)
        rows[name] = row
    return rows


def _faults_of_header(found: Sequence[str], model: type[BaseModel]) -> list[str]:
    """Messages about columns that are missing, repeated or unknown."""
    fields = model.model_fields
    required = [name for name, field in fields.items() if field.is_required()]
    optional = [name for name in fields if name not in required]
    more = f" and, where wanted, {', '.join(optional)}" if optional else ""
    problems = [
        *(f"column {name!r} is missing" for name in required if name not in found),
        *(f"column {name!r} is given twice" for name in fields if found.count(name) > 1),
        *(f"column {quoted(name)} is not known" for name in found if name not in fields),
    ]
    return [
        f"{problem}; the header has {', '.join(required)}{more}: use tabs between them"
        for problem in problems
    ]
