"""The annotation file as a text: a patch by section, its difference, a save that loses nothing.

Comments, order and layout stay: only the lines of the sections that change are written anew, and in
them what stays equal keeps its form. A save is refused where the file is not the one that was read.
"""

from __future__ import annotations

import contextlib
import difflib
import fcntl
import hashlib
import io
import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from intercap_core.config import Annotation
from intercap_core.errors import UserError
from intercap_core.inputs.files import MAX_SETTINGS_BYTES, read_bytes
from intercap_core.inputs.yaml_files import parse_yaml, told

NO_FILE = "none"  # the digest where there is no file
_PART = ".part"
_WIDTH = 10_000  # characters of a line, before one is broken: what a user wrote in one stays so
_FLOW_ITEMS = {"contact", "floor", "subject", "object_poses", "left_right"}  # one entry a line
_FLOW_LISTS = {"drop_frames", "rotation_vector", "translation"}


class Changed(UserError):
    """The file is another one than was read: ``now`` is what it holds, ``difference`` by whom else
    it was changed, as a unified diff."""

    def __init__(self, now: Document, difference: str) -> None:
        super().__init__(f"{now.path}: was changed by somebody else meanwhile; nothing was saved")
        self.now, self.difference = now, difference


@dataclass(frozen=True)
class Document:
    """``text`` of the file at ``path``, "" where there is none; ``digest`` of its bytes;
    ``problem``: why it is no annotation, "" = it is one; ``note``: what else is odd."""

    path: Path
    text: str
    digest: str
    sections: dict[str, Any]
    problem: str = ""
    note: str = ""


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
        sections = _sections(text)
        told_as = json.dumps(sections, allow_nan=False, ensure_ascii=False)
        told_as.encode()  # raises where a page cannot be told the values
    except TypeError:
        words = f"{path}: holds a value that no annotation has, as a date; correct it in an editor"
        return Document(path, text, digest, {}, words, note)
    except (UnicodeError, yaml.YAMLError, ValueError) as error:
        shown = data.decode("utf-8", "replace")
        words = f"{path}: not valid YAML{told(error)}; correct it in an editor"
        return Document(path, shown, digest, {}, words, note)
    return Document(path, text, digest, sections, note=note)


def patched(document: Document, changes: Mapping[str, Any]) -> str:
    """The file's text with sections changed; None or an empty list takes a section away.

    Raises UserError where the file cannot be changed without harm.
    """
    if document.problem:
        raise UserError(document.problem)
    unknown = sorted(set(changes) - set(Annotation.model_fields))
    if unknown:
        raise UserError(f"{document.path}: an annotation has no section {unknown[0]!r}")
    layout = UserError(
        f"{document.path}: its layout does not let sections be changed one by one; change it in an "
        "editor"
    )
    text = document.text.replace("\r\n", "\n")
    kept = {k: v for k, v in document.sections.items() if k not in changes}
    wanted = kept | {k: v for k, v in changes.items() if v not in (None, [], ())}
    try:
        for section in Annotation.model_fields:
            if section in changes:
                text = with_section(text, section, changes[section])
        same = _plain(_sections(text)) == _plain(wanted)
    except yaml.YAMLError:  # an alias of what was taken away
        raise layout from None
    if not same:
        raise layout
    return text.replace("\n", "\r\n") if "\r\n" in document.text else text


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

    Raises Changed where the file is another one by now, UserError where it cannot be written.
    """
    path = Path(os.path.realpath(document.path))  # a link stays one
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _alone(path.parent):
            now = read(path)
            if now.digest != document.digest:
                raise Changed(now, difference(document.text, now.text, path.name))
            replace(path, text)
    except OSError as error:
        raise UserError(
            f"{path}: cannot be saved ({error.strerror}); nothing was changed"
        ) from None
    return read(path)


def replace(path: Path, text: str) -> None:
    """Under a temporary name beside the file, to the disk, then renamed."""
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


def _sections(text: str) -> dict[str, Any]:
    values = parse_yaml(text)
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise ValueError("expected sections by name")
    return {str(k): v for k, v in values.items() if v not in (None, [], {})}


def _plain(values: Any) -> str:
    return json.dumps(values, sort_keys=True, default=str)


# --- one section of the text -----------------------------------------------------------------


def with_section(text: str, section: str, value: Any) -> str:
    spans = _spans(text)
    if spans is None:
        return _with_whole(text, section, value)
    lines = text.splitlines(keepends=True)
    if lines and not lines[-1].endswith("\n"):
        lines[-1] += "\n"
    empty = value in (None, [], ())
    if section not in spans:
        if empty:
            return text
        end = len(lines)
        while end and lines[end - 1].strip() in ("...", ""):
            end -= 1
        new = _dumped("", section, value)
        gap = ["\n"] if end and lines[end - 1].strip() else []
        return "".join([*lines[:end], *gap, new, *lines[end:]])
    first, last = spans[section]
    if empty:
        return "".join(lines[:first] + lines[last:])
    try:
        new = _dumped("".join(lines[first:last]), section, value)
    except Exception:  # an alias of another section, by whatever name the library calls it
        return _with_whole(text, section, value)
    return "".join([*lines[:first], new, *lines[last:]])


def _spans(text: str) -> dict[str, tuple[int, int]] | None:
    """First line and the one after the last of each section, without the comments that stand before
    the next one; None where sections do not begin lines of their own."""
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    if root is None:
        return {}
    if not isinstance(root, yaml.MappingNode) or root.flow_style:
        return None
    lines = text.splitlines()
    starts = [key.start_mark for key, _ in root.value]
    if any(mark.column for mark in starts) or len({m.line for m in starts}) < len(starts):
        return None
    spans = {}
    ends = [*(mark.line for mark in starts[1:]), len(lines)]
    for (key, _), mark, end in zip(root.value, starts, ends, strict=True):
        last = end
        while last > mark.line + 1 and _between(lines[last - 1]):
            last -= 1
        spans[str(key.value)] = (mark.line, last)
    return spans


def _between(line: str) -> bool:
    return not line.strip() or line.startswith(("#", "...", "---"))


def _dumped(old: str, section: str, value: Any) -> str:
    """The section's lines with ``value``, in the form of its ``old`` lines where it has any."""
    writer = _writer(old)
    loaded = writer.load(old) if old else None
    root = loaded if isinstance(loaded, dict) else _commented({})
    before = root.get(section)
    root[section] = _node(section, value) if before is None else _merged(before, value, section)
    return _written(writer, root)


def _with_whole(text: str, section: str, value: Any) -> str:
    writer = _writer(text)
    root = writer.load(text) or _commented({})
    if value in (None, [], ()):
        root.pop(section, None)
    else:
        before = root.get(section)
        root[section] = _node(section, value) if before is None else _merged(before, value, section)
    return _written(writer, root)


def _writer(text: str) -> Any:
    from ruamel.yaml import YAML

    writer = YAML()
    writer.preserve_quotes = True
    writer.width = _WIDTH
    offset, mapping = 2, 2
    for line in text.splitlines()[1:]:
        body = line.lstrip(" ")
        if not body or body.startswith("#"):
            continue
        if body.startswith("-"):
            offset = len(line) - len(body)
        else:
            mapping = max(1, len(line) - len(body))
        break
    writer.indent(mapping=mapping, sequence=offset + 2, offset=offset)
    return writer


def _written(writer: Any, root: Any) -> str:
    stream = io.StringIO()
    writer.dump(root, stream)
    return stream.getvalue()


def _commented(value: Any) -> Any:
    from ruamel.yaml.comments import CommentedMap, CommentedSeq

    return CommentedMap(value) if isinstance(value, dict) else CommentedSeq(value)


def _node(name: str, value: Any, *, flow: bool | None = None) -> Any:
    """A value that has no form yet; ``flow``: on one line."""
    node: Any
    if isinstance(value, dict):
        node = _commented({k: _node(str(k), v, flow=flow) for k, v in value.items()})
    elif isinstance(value, (list, tuple)):
        inner = True if name in _FLOW_ITEMS else flow
        node = _commented([_node("", v, flow=inner) for v in value])
        if name in _FLOW_LISTS:
            flow = True
        elif name in _FLOW_ITEMS:
            flow = False
    else:
        return value
    if flow:
        node.fa.set_flow_style()
    return node


def _merged(node: Any, value: Any, name: str) -> Any:
    """``node`` with what differs from ``value`` changed in place."""
    if isinstance(node, dict) and isinstance(value, dict):
        for key in [key for key in node if key not in value]:
            del node[key]
        for key, one in value.items():
            flow = node.fa.flow_style()  # type: ignore[attr-defined]
            node[key] = (
                _merged(node[key], one, key) if key in node else _node(str(key), one, flow=flow)
            )
        return node
    if isinstance(node, list) and isinstance(value, (list, tuple)):
        return _merged_list(node, list(value), name)
    return node if _plain(node) == _plain(value) else _node(name, value)


def _merged_list(node: Any, value: list[Any], name: str) -> Any:
    old, new = [_plain(v) for v in node], [_plain(v) for v in value]
    flow = bool(node) and hasattr(node[0], "fa") and node[0].fa.flow_style()
    steps = difflib.SequenceMatcher(None, old, new, autojunk=False).get_opcodes()
    for kind, a, b, c, d in reversed(steps):
        if kind == "equal":
            continue
        both = min(b - a, d - c)
        for k in range(both):
            node[a + k] = _merged(node[a + k], value[c + k], "")
        for k in range(b - 1, a + both - 1, -1):
            del node[k]
        for k in range(c + both, d):
            node.insert(a + k - c, _node("", value[k], flow=flow or name in _FLOW_ITEMS))
    return node
