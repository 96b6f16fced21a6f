"""The annotation file as a text: a patch by section, its difference, a save that loses nothing.

Comments, order and layout stay: only the lines of the sections that change are written anew, and in
them what stays equal keeps its form. A save is refused where the file is not the one that was read.
"""

from __future__ import annotations

import contextlib
import difflib
import fcntl
import hashlib
import json
import os
import stat
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from intercap_core.annotate.yaml_entries import same
from intercap_core.annotate.yaml_sections import NoLayout, with_section
from intercap_core.config import STATED_EMPTY, Annotation
from intercap_core.errors import UserError
from intercap_core.inputs.documents import parse_yaml, yaml_fault
from intercap_core.inputs.files import MAX_SETTINGS_BYTES, read_bytes

NO_FILE = "none"  # the digest where there is no file
_BOM = b"\xef\xbb\xbf"
_PART = ".part"


class Changed(UserError):
    """The file is another one than was read: ``now`` is what it holds, ``difference`` by whom else
    it was changed, as a unified diff."""

    def __init__(self, now: Document, difference: str) -> None:
        super().__init__(f"{now.path}: was changed by somebody else meanwhile; nothing was saved")
        self.now, self.difference = now, difference


@dataclass(frozen=True)
class Document:
    """``text`` of the file at ``path``, "" where there is none; ``digest`` of its bytes;
    ``problem``: why it is no annotation, "" = it is one; ``note``: what else is odd;
    ``marked``: it begins with a byte order mark, which is not of the text."""

    path: Path
    text: str
    digest: str
    sections: dict[str, Any]
    problem: str = ""
    note: str = ""
    marked: bool = False


def read(path: Path) -> Document:
    """The annotation file as it is now; a broken one is told in ``problem``.

    Raises UserError where it cannot be read at all.
    """
    note = ""
    if _parts(path):
        note = f"a save of {path} was cut off; the file is as it was before"
    if not path.exists():
        return Document(path, "", NO_FILE, {}, note=note)
    data = read_bytes(path, MAX_SETTINGS_BYTES)
    digest = hashlib.sha256(data).hexdigest()
    try:
        text = data.decode("utf-8-sig")
        sections = parsed(text)
        told_as = json.dumps(sections, allow_nan=False, ensure_ascii=False)
        told_as.encode()  # raises where a page cannot be told the values
    except TypeError:
        words = f"{path}: holds a value that no annotation has, as a date; correct it in an editor"
        return Document(path, text, digest, {}, words, note)
    except (UnicodeError, yaml.YAMLError, ValueError) as error:
        shown = data.decode("utf-8", "replace")
        words = f"{path}: not valid YAML{yaml_fault(error)}; correct it in an editor"
        return Document(path, shown, digest, {}, words, note)
    return Document(path, text, digest, sections, note=note, marked=data.startswith(_BOM))


def patched(document: Document, changes: Mapping[str, Any]) -> str:
    """The file's text with sections of an annotation changed; None takes a section away, and so
    does an empty list, but where that states something (``STATED_EMPTY``).

    Raises UserError where the file cannot be changed without harm.
    """
    unknown = sorted(set(changes) - set(Annotation.model_fields))
    if unknown:
        raise UserError(f"{document.path}: an annotation has no section {unknown[0]!r}")
    told = _stated(changes)
    return with_changes(document, {k: told[k] for k in Annotation.model_fields if k in told})


def sections_with(document: Document, changes: Mapping[str, Any]) -> dict[str, Any]:
    """The sections of the file with ``changes``, which are as in :func:`patched`."""
    return _changed(document.sections, _stated(changes))


def _stated(changes: Mapping[str, Any]) -> dict[str, Any]:
    """None for what states nothing."""
    return {k: None if v in ([], ()) and k not in STATED_EMPTY else v for k, v in changes.items()}


def _changed(sections: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    found = {**sections, **changes}
    return {k: v for k, v in found.items() if v is not None or k not in changes}


def with_changes(document: Document, changes: Mapping[str, Any]) -> str:
    """The file's text with entries of its mapping changed; None takes one away.

    Raises UserError where the file cannot be changed without harm.
    """
    if document.problem:
        raise UserError(document.problem)
    text = document.text
    wanted = _changed(document.sections, changes)
    try:
        for section, value in changes.items():
            text = with_section(text, section, value)
        done = same(parsed(text), wanted)
    except (NoLayout, yaml.YAMLError):  # an alias of what was taken away
        done = False
    if not done:
        raise UserError(
            f"{document.path}: its layout does not let sections be changed one by one; change it "
            "in an editor"
        )
    return text


def faults(sections: Mapping[str, Any]) -> list[dict[str, str]]:
    """What is wrong with an annotation's sections: ``where`` and ``words`` of each."""
    try:
        Annotation.model_validate(dict(sections))
    except ValidationError as error:
        return [
            {
                "where": ".".join(map(str, one["loc"])) or "annotation",
                "words": one["msg"].removeprefix("Value error, "),
            }
            for one in error.errors(include_url=False)
        ]
    return []


def difference(old: str, new: str, name: str) -> str:
    """Unified diff of two texts of the file ``name``; "" where they are the same."""
    lines = difflib.unified_diff(
        old.splitlines(), new.splitlines(), f"{name} (saved)", f"{name} (new)", lineterm="", n=2
    )
    return "\n".join(lines)


def save(document: Document, text: str) -> Document:
    """Write ``text`` in place of the file that ``document`` was read from; whole or not at all.

    Raises Changed where the file is another one by now, UserError where it cannot or may not be
    written.
    """
    path = Path(os.path.realpath(document.path))  # a link stays one
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _alone(path.parent):
            now = read(path)
            if now.digest != document.digest:
                raise Changed(now, difference(document.text, now.text, path.name))
            replace(path, "\ufeff" + text if document.marked else text)
    except OSError as error:
        raise UserError(
            f"{path}: cannot be saved ({error.strerror}); nothing was changed"
        ) from None
    return read(path)


def replace(path: Path, text: str) -> None:
    """Under a temporary name beside the file, to the disk, then renamed.

    Raises UserError where the file there is read-only: to rename onto it would be allowed.
    """
    if kept := locked(path):
        raise UserError(kept)
    for part in _parts(path):  # of a save that was cut off
        part.unlink(missing_ok=True)
    mode = path.stat().st_mode & 0o777 if path.exists() else None
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=_PART, dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(text.encode())
            file.flush()
            os.fsync(file.fileno())
        if mode is None:
            umask = os.umask(0)
            os.umask(umask)
            mode = 0o666 & ~umask
        os.chmod(name, mode)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # some file systems sync no folders
            os.fsync(folder)
    finally:
        os.close(folder)


def locked(path: Path) -> str:
    """Why the file may not be written, "" = it may be, or there is none.

    By its mode too: for root the system refuses nothing.
    """
    real = Path(os.path.realpath(path))
    if not real.exists():
        return ""
    found = real.stat()
    own = found.st_uid == os.geteuid()
    bits = stat.S_IWUSR if own else stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH
    if found.st_mode & bits and os.access(real, os.W_OK):
        return ""
    return f"{path}: is read-only for you; nothing is saved into it until its mode allows it"


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold the folder against another annotator's save, where the file system has locks."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _parts(path: Path) -> list[Path]:
    real = Path(os.path.realpath(path))
    found = real.parent.glob(f".{real.name}.*{_PART}") if real.parent.is_dir() else ()
    return sorted(found)


def parsed(text: str) -> dict[str, Any]:
    """The sections of a text; raises yaml.YAMLError or ValueError where it has none."""
    values = parse_yaml(text)
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise ValueError("expected sections by name")
    return {str(k): v for k, v in values.items()}
