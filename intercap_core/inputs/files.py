"""Bytes and text of the files that a user supplies: regular files, up to a size, strict UTF-8."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from intercap_core.errors import UserError
from intercap_core.inputs.quotes import printable

# Bytes, by kind of file. Each is several times what the largest real file of its kind has.
MAX_SETTINGS_BYTES = 1 << 20  # written by hand; YAML is parsed at about a megabyte a second
MAX_TABLE_BYTES = 1 << 24  # a line for each of 100,000 recordings
MAX_CALIBRATION_BYTES = 1 << 24  # JSON, YAML or TOML of a hundred cameras
MAX_MODEL_BYTES = 1 << 29  # COLMAP's images and their points; a mesh; network weights
MAX_IMAGE_BYTES = 1 << 28  # one image file
MAX_PICKLE_BYTES = 1 << 28  # results of an hour at 30 frames a second
MAX_ARRAYS_BYTES = 1 << 30  # arrays of an .npz unpacked; SMPL-X's have 350 MB
_NO_FILE = {
    stat.S_ISDIR: "a folder",
    stat.S_ISCHR: "a device",
    stat.S_ISBLK: "a device",
    stat.S_ISFIFO: "a pipe",
    stat.S_ISSOCK: "a socket",
}


class Unreadable(UserError):
    """A file that cannot be used. ``reason`` says why, in words that fit after its name."""

    def __init__(self, path: Path, reason: str, advice: str = "check the path") -> None:
        super().__init__(f"{printable(str(path))}: {reason}; {advice}")
        self.path, self.reason = path, reason


def read_bytes(
    path: Path, limit: int, *, advice: str = "check the path", head: int | None = None
) -> bytes:
    """The content of a regular file of at most ``limit`` bytes, or its first ``head`` bytes.

    Raises :class:`Unreadable` for anything else, also where the path leads to a device or a pipe,
    which is never waited for.
    """
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise Unreadable(path, f"cannot be read ({error.strerror})", advice) from None
    except ValueError:  # a NUL, or text that no file system has
        raise Unreadable(path, "is no name that a file can have", advice) from None
    try:
        _check(path, os.fstat(handle), limit, advice)
    except Unreadable:
        os.close(handle)
        raise
    with os.fdopen(handle, "rb") as file:
        try:
            content = file.read(limit + 1 if head is None else min(head, limit))
        except OSError as error:
            raise Unreadable(path, f"cannot be read ({error.strerror})", advice) from None
    if len(content) > limit:
        raise Unreadable(path, _too_large(len(content), limit), advice)
    return content


def check_file(path: Path, limit: int | None, *, advice: str = "check the path") -> int:
    """The size of a regular file that a library will open by its path; raises
    :class:`Unreadable` where it is none, or larger than ``limit`` bytes (None = of any size)."""
    try:
        found = os.stat(path)
    except OSError as error:
        raise Unreadable(path, f"cannot be read ({error.strerror})", advice) from None
    except ValueError:
        raise Unreadable(path, "is no name that a file can have", advice) from None
    _check(path, found, limit, advice)
    return found.st_size


def read_text(path: Path, limit: int, *, advice: str = "check the path") -> str:
    """The text of a regular file, UTF-8 with or without its mark; raises :class:`Unreadable`."""
    return decoded(path, read_bytes(path, limit, advice=advice))


def decoded(path: Path, content: bytes) -> str:
    """Content as text; raises :class:`Unreadable` naming the byte that is no UTF-8."""
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise Unreadable(
            path, f"is not text in UTF-8 (line {line}, byte {error.start})", "write it as UTF-8"
        ) from None


def path_fault(path: Path) -> str | None:
    """Why no file system has this path, None = it may."""
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


def _check(path: Path, found: os.stat_result, limit: int | None, advice: str) -> None:
    if not stat.S_ISREG(found.st_mode):
        kind = next((name for test, name in _NO_FILE.items() if test(found.st_mode)), "no file")
        raise Unreadable(path, f"cannot be read (it is {kind}, no file)", advice)
    if limit is not None and found.st_size > limit:
        raise Unreadable(path, _too_large(found.st_size, limit), advice)


def _too_large(size: int, limit: int) -> str:
    return f"has {size / 1e6:.0f} MB, at most {limit / 1e6:.0f} are read"
