"""Bytes and text of files that a user supplies, and values of such files quoted in messages."""

from __future__ import annotations

import contextlib
import os
import re
import reprlib
import stat
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from intercap_core.errors import UserError

# Size limits, bytes: several times the size of the largest real file of each kind.
MAX_TEXT_BYTES = 1 << 24  # settings, a table of 100,000 recordings, a calibration of 100 cameras
MAX_FILE_BYTES = 1 << 29  # COLMAP's points, a mesh, an image, a pickle, network weights, COCO JSON
MAX_ARRAYS_BYTES = 1 << 30  # arrays of an .npz unpacked; SMPL-X's have 350 MB
_DEEPEST = 3  # levels of folders that are searched for files that no reader uses
_KINDS_NAMED = 4  # kinds of unused files that are named
MAX_UNPACKING = 100  # bytes unpacked per byte of an .npz; deflate reaches 1,032 for zeros
MIN_UNPACKED_BYTES = 1 << 26  # up to this size, any ratio is accepted

_REFERRING = {".obj", ".mtl", ".ply", ".glb", ".onnx"}  # suffixes of files that name other files
_SEARCHED_BYTES = 1 << 26  # at the beginning of such a file; a graph without weights has less

_FILE_TYPES = {
    stat.S_ISDIR: "a folder",
    stat.S_ISCHR: "a device",
    stat.S_ISBLK: "a device",
    stat.S_ISFIFO: "a pipe",
    stat.S_ISSOCK: "a socket",
}


class UnreadableFile(UserError):
    """A file that cannot be used.

    ``reason`` continues a sentence that starts with the file's name, for callers that write their
    own message.
    """

    def __init__(self, path: Path, reason: str, advice: str = "check the path") -> None:
        super().__init__(f"{printable(str(path))}: {reason}; {advice}")
        self.path, self.reason = path, reason


def read_bytes(
    path: Path,
    limit: int = MAX_FILE_BYTES,
    *,
    advice: str = "check the path",
    head: int | None = None,
) -> bytes:
    """Return the content of a regular file of at most ``limit`` bytes, or its first ``head`` bytes.

    Raises :class:`UnreadableFile` for other files, without waiting for pipes or devices.
    """
    check_file(path, limit, advice=advice)
    try:
        with open(path, "rb") as file:
            content = file.read(limit + 1 if head is None else min(head, limit))
    except OSError as error:
        raise UnreadableFile(path, f"cannot be read ({error.strerror})", advice) from None
    if len(content) > limit:  # the file grew while it was read
        raise UnreadableFile(path, _too_large(len(content), limit), advice)
    return content


def check_file(path: Path, limit: int | None, *, advice: str = "check the path") -> int:
    """Return the size of a file that a library will open by its path.

    Raises :class:`UnreadableFile` if it is no regular file or larger than ``limit`` bytes (None =
    of any size).
    """
    try:
        status = os.stat(path)
    except OSError as error:
        raise UnreadableFile(path, f"cannot be read ({error.strerror})", advice) from None
    except ValueError:  # a NUL, or characters that no file system has
        raise UnreadableFile(path, "is no name that a file can have", advice) from None
    if not stat.S_ISREG(status.st_mode):
        kind = next((name for test, name in _FILE_TYPES.items() if test(status.st_mode)), "no file")
        raise UnreadableFile(path, f"cannot be read (it is {kind}, no file)", advice)
    if limit is not None and status.st_size > limit:
        raise UnreadableFile(path, _too_large(status.st_size, limit), advice)
    return status.st_size


def referenced_files(path: Path) -> list[Path]:
    """Files in or below the folder of ``path`` that its content names, followed recursively.

    Covers materials and textures of a mesh and external weights of an ONNX model without a parser
    of each format. Includes pipes, devices and dangling links, which are not opened.
    """
    found = [path]
    for file in found:  # the loop extends the list
        if file.suffix.lower() in _REFERRING and file.is_file():
            with contextlib.suppress(OSError), open(file, "rb") as opened:
                content = opened.read(_SEARCHED_BYTES)
                named = _named_below(file.parent, content, ())
                found += [other for other in named if other not in found]
    return found[1:]


def _named_below(folder: Path, content: bytes, above: tuple[Path, ...]) -> Iterator[Path]:
    """Files below ``folder`` whose names, and those of the folders between, ``content`` holds.

    ``above``: resolved folders above, to which a link may lead back.
    """
    above = (*above, folder.resolve())
    for entry in os.scandir(folder):
        path, name = folder / entry.name, os.fsencode(entry.name)
        names = {name, quote(name).encode()}
        if not entry.is_dir():
            if any(name in content for name in names):
                yield path
        elif (
            not name.isdigit()  # "1/" may be the numbers of a face
            and any(_is_folder_in(content, name) for name in names)
            and path.resolve() not in above
        ):
            yield from _named_below(path, content, above)


def _is_folder_in(content: bytes, name: bytes) -> bool:
    """Whether ``content`` has the name as a folder of a path."""
    return bool(re.search(re.escape(name) + rb"[/\\]", content))


def read_text(path: Path, limit: int = MAX_TEXT_BYTES, *, advice: str = "check the path") -> str:
    """Return the text of a regular file, UTF-8 with or without a byte order mark."""
    return decode_text(path, read_bytes(path, limit, advice=advice))


def decode_text(path: Path, content: bytes) -> str:
    """Decode UTF-8; raises :class:`UnreadableFile` with the line and byte that are not UTF-8."""
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise UnreadableFile(
            path, f"is not text in UTF-8 (line {line}, byte {error.start})", "write it as UTF-8"
        ) from None


def path_fault(path: Path) -> str | None:
    """Return why no file system can have this path, or None."""
    try:
        parts = [os.fsencode(part) for part in path.parts]
        str(path).encode("utf-8")
    except UnicodeEncodeError:
        return "a path holds characters that are no text"
    if any(b"\0" in part for part in parts):
        return "a path holds a NUL"
    if sum(map(len, parts)) + len(parts) > 4096 or any(len(part) > 255 for part in parts):
        return "a path is longer than a file system has, 255 bytes a name"
    return None


def quoted(value: Any, most: int = 80) -> str:
    """Format a value for a message, in about ``most`` printable characters."""
    if isinstance(value, int) and not isinstance(value, bool) and value.bit_length() > 64:
        return f"a whole number of {value.bit_length()} bits"
    if isinstance(value, dict):
        keys = ", ".join(printable(str(key)[:40]) for key in list(value)[:5])
        return f"an object with {keys}" if keys else "an empty object"
    short = reprlib.Repr()  # shows six entries of a list, without reading the others
    short.maxlevel, short.maxstring, short.maxother = 3, 80, 80
    text = printable(short.repr(value))
    return text if len(text) <= most else f"{text[: most - 3]}..."


def printable(text: str) -> str:
    """Replace characters that UTF-8 cannot encode, such as bytes of file names, by ``?``."""
    return text.encode("utf-8", "replace").decode("utf-8", "replace")


def name_some(names: Sequence[str], most: int) -> str:
    """The first ``most`` names as text, with the number of the others."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def parse_numbers(value: Any, where: str, field: str) -> np.ndarray:
    """Convert to an array of finite numbers; raises UserError, beginning with ``where``."""
    try:
        numbers = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.full(1, np.nan)
    if not np.isfinite(numbers).all():
        raise UserError(f"{where}: {field} is {quoted(value)}, expected finite numbers; correct it")
    return numbers


def list_files(folder: Path) -> list[Path]:
    """Files below a folder, without hidden ones and those in hidden folders."""
    files = []
    for place, below, names in os.walk(folder, followlinks=True):
        below[:] = sorted(name for name in below if not name.startswith("."))
        below[:] = below if len(Path(place).relative_to(folder).parts) < _DEEPEST else []
        files += [Path(place, name) for name in sorted(names) if not name.startswith(".")]
    return files


def describe_unread(folder: Path, unread: Iterable[Path], advice: str) -> list[str]:
    """Notes on files below ``folder`` that no reader uses, one for each kind of file.

    A kind is a folder and a suffix. Beyond the first ``_KINDS_NAMED``, kinds are only counted.
    """
    kinds: dict[tuple[str, str], list[Path]] = {}
    for path in unread:
        place = path.parent.relative_to(folder).as_posix()
        kinds.setdefault(("" if place == "." else f"{place}/", path.suffix), []).append(path)
    notes = [
        f"{folder}: {place}{paths[0].name}"
        + (f" and {n - 1} more of {place}*{suffix} are" if (n := len(paths)) > 1 else " is")
        + " not used"
        for (place, suffix), paths in kinds.items()
    ]
    if len(notes) > _KINDS_NAMED:
        notes[_KINDS_NAMED:] = [f"{folder}: {len(notes) - _KINDS_NAMED} other kinds are not used"]
    return [printable(f"{note}; {advice}") for note in notes]


def _too_large(size: int, limit: int) -> str:
    return f"has {size / 1e6:.0f} MB, at most {limit / 1e6:.0f} are read"
