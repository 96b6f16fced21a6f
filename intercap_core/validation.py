"""Validate entries of settings, tables and annotations by their models; collect all faults."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from intercap_core.inputs.files import UnreadableFile, printable, quoted, read_text

M = TypeVar("M", bound=BaseModel)


def parse_entry(model: type[M], values: Any, where: str, what: str, faults: list[str]) -> M | None:
    """Validate values by a model; None if they are not valid.

    Args:
        model: the model.
        values: names and values.
        where: place of the entry, for messages.
        what: kind of a field, such as "setting".
        faults: gets one message for each fault.
    """
    if not isinstance(values, dict):
        faults.append(f"{where}: expected names and values, found {quoted(values)}; correct it")
        return None
    try:
        return model.model_validate(values)
    except ValidationError as error:
        faults += describe(error, where, what)
        return None


def describe(error: ValidationError, where: str, what: str) -> list[str]:
    """One message for each fault that a model has found; arguments as of :func:`parse_entry`."""
    messages = []
    for fault in error.errors(include_url=False):
        field = ".".join(str(part)[:80] for part in fault["loc"]) or "(the whole entry)"
        message = fault["msg"].removeprefix("Value error, ")[:400]
        if fault["type"] == "string_pattern_mismatch":
            message = "a name has letters, digits, _ and - only, and does not start with -"
        found = fault.get("input")
        shown = "" if isinstance(found, dict) else f", found {quoted(found)}"
        messages.append(f"{where}: {printable(f'{what} {field}: {message}{shown}')}; correct it")
    return messages


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
            faults += describe(error, where, "column")
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
