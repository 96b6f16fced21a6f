"""The annotation file: reading, changes by section, and safe saving.

Comments, order and layout stay: only lines of changed values are rewritten. A save is refused if
the file changed since it was read.
"""

from __future__ import annotations

import contextlib
import difflib
import fcntl
import hashlib
import json
import os
import stat
import uuid
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from intercap_core.annotate.yaml_edit import replace_section
from intercap_core.annotate.yaml_entries import UnsupportedLayout
from intercap_core.annotation import STATED_EMPTY, Annotation
from intercap_core.errors import UserError
from intercap_core.inputs.documents import parse_yaml, yaml_fault
from intercap_core.inputs.files import MAX_TEXT_BYTES, read_bytes
from intercap_core.validation import list_faults

NO_FILE = "none"  # digest if there is no file
_BOM = b"\xef\xbb\xbf"
_PART = ".part"


class Changed(UserError):
    """The file changed since it was read; ``difference`` is the unified diff to its content."""

    def __init__(self, now: Document, difference: str) -> None:
        super().__init__(f"{now.path}: was changed by another annotator; nothing was saved")
        self.now, self.difference = now, difference

    def to_json(self) -> dict[str, Any]:
        """Serialize for the page."""
        return {"error": str(self), "now": self.now.to_json(), "difference": self.difference}


@dataclass(frozen=True)
class Document:
    """Content of a YAML file."""

    path: Path
    text: str
    """"" if there is no file."""
    digest: str
    """SHA-256 of the file's bytes."""
    sections: dict[str, Any]
    """Values of the file by top-level key."""
    problem: str = ""
    """Why the file cannot be used, "" if it can."""
    note: str = ""
    """Remark about the file."""
    marked: bool = False
    """The file begins with a byte order mark, which is not part of ``text``."""

    def to_json(self) -> dict[str, Any]:
        """Serialize for the page."""
        return {
            "path": str(self.path), "text": self.text, "digest": self.digest,
            "sections": self.sections, "problem": self.problem, "note": self.note,
        }  # fmt: skip


def read(path: Path) -> Document:
    """Read a file; ``problem`` describes invalid YAML.

    Raises UserError if the file cannot be read at all.
    """
    note = ""
    if _parts(path):  # temporary files of an interrupted save
        note = f"a save of {path} was interrupted; the file is unchanged"
    if not path.exists():
        return Document(path, "", NO_FILE, {}, note=note)
    data = read_bytes(path, MAX_TEXT_BYTES)
    digest = hashlib.sha256(data).hexdigest()
    try:
        text = data.decode("utf-8-sig")
        sections = parsed(text)
        json.dumps(sections, allow_nan=False, ensure_ascii=False).encode()  # as sent to the page
    except (TypeError, UnicodeError, yaml.YAMLError, ValueError) as error:
        fault = f"not valid YAML{yaml_fault(error)}"
        if isinstance(error, TypeError):
            fault = "has a value that no annotation has, such as a date"
        text = data.decode("utf-8", "replace")
        return Document(path, text, digest, {}, f"{path}: {fault}; correct it in an editor", note)
    return Document(path, text, digest, sections, note=note, marked=data.startswith(_BOM))


def patched(document: Document, changes: Mapping[str, Any]) -> str:
    """Return the annotation's text with changed sections.

    None removes a section. So does an empty list, except in the sections of ``STATED_EMPTY``, where
    it has a meaning. Raises UserError if the file cannot be changed without loss.
    """
    unknown = sorted(set(changes) - set(Annotation.model_fields))
    if unknown:
        raise UserError(f"{document.path}: an annotation has no section {unknown[0]!r}")
    ordered = {k: changes[k] for k in Annotation.model_fields if k in changes}
    return with_changes(
        document, {k: None if v == [] and k not in STATED_EMPTY else v for k, v in ordered.items()}
    )


def with_changes(document: Document, changes: Mapping[str, Any]) -> str:
    """Return the file's text with changed entries of its mapping; None removes an entry.

    Raises UserError if the file cannot be changed without loss.
    """
    if document.problem:
        raise UserError(document.problem)
    text = document.text
    merged = {**document.sections, **changes}
    wanted = {k: v for k, v in merged.items() if v is not None or k not in changes}
    try:
        for section, value in changes.items():
            text = replace_section(text, section, value)
        done = parsed(text) == wanted
    except (UnsupportedLayout, yaml.YAMLError):  # such as an alias of a removed value
        done = False
    if not done:
        raise UserError(
            f"{document.path}: its layout does not let sections be changed one by one; change it "
            "in an editor"
        )
    return text


def faults(sections: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return the faults of an annotation's sections, each with ``where`` and ``message``."""
    try:
        Annotation.model_validate(dict(sections))
    except ValidationError as error:
        return [
            {"where": field or "annotation", "message": text}
            for field, text in list_faults(error, Annotation, "entry")
        ]
    return []


def difference(old: str, new: str, name: str) -> str:
    """Return the unified diff of two texts of the file ``name``; "" if they are equal."""
    lines = difflib.unified_diff(
        old.splitlines(), new.splitlines(), f"{name} (saved)", f"{name} (new)", lineterm="", n=2
    )
    return "\n".join(lines)


def save(document: Document, text: str) -> Document:
    """Replace the file that ``document`` was read from, atomically.

    Raises Changed if the file changed since it was read, UserError if it cannot be written.
    """
    path = Path(os.path.realpath(document.path))  # links stay links
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _locked(path.parent):
            now = read(path)
            if now.digest != document.digest:
                raise Changed(now, difference(document.text, now.text, path.name))
            replace(path, "\ufeff" + text if document.marked else text)
    except OSError as error:
        message = f"{path}: cannot be saved ({error.strerror}); nothing was changed"
        raise UserError(message) from None
    return read(path)


def replace(path: Path, text: str) -> None:
    """Write a temporary file in the same folder, flush it to disk, and rename it.

    Raises UserError if the file is read-only, which renaming would not notice.
    """
    if reason := locked(path):
        raise UserError(reason)
    for part in _parts(path):  # of an interrupted save
        part.unlink(missing_ok=True)
    part = path.with_name(f".{path.name}.{uuid.uuid4().hex}{_PART}")
    try:
        with part.open("wb") as file:
            if path.exists():
                part.chmod(path.stat().st_mode & 0o777)
            file.write(text.encode())
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # some file systems cannot sync folders
            os.fsync(folder)
    finally:
        os.close(folder)


def locked(path: Path) -> str:
    """Return why the file may not be written, "" if it may or does not exist.

    The mode is checked as well, because root may write every file.
    """
    real = Path(os.path.realpath(path))
    if not real.exists():
        return ""
    status = real.stat()
    own = status.st_uid == os.geteuid()
    bits = stat.S_IWUSR if own else stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH
    if status.st_mode & bits and os.access(real, os.W_OK):
        return ""
    return f"{path}: is read-only for you; change its mode to save annotations"


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock the folder against other annotators, if the file system supports locks."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _parts(path: Path) -> list[Path]:
    """Return temporary files of interrupted saves."""
    real = Path(os.path.realpath(path))
    return sorted(real.parent.glob(f".{real.name}.*{_PART}")) if real.parent.is_dir() else []


def parsed(text: str) -> dict[str, Any]:
    """Parse the sections of a text; raises yaml.YAMLError or ValueError."""
    values = parse_yaml(text)
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise ValueError("expected sections by name")
    return {str(k): v for k, v in values.items()}
