"""Arrays of .npz archives: plain numbers, whose stated sizes are compared before memory is taken.

``np.load`` takes the memory that an array's head asks for, and an archive of some megabytes unpacks
to gigabytes.
"""

from __future__ import annotations

import io
import math
import re
import sys
import tokenize
import zipfile
import zlib
from collections.abc import Collection
from pathlib import Path

import numpy as np

from intercap_core.inputs.files import MAX_ARRAYS_BYTES, Unreadable, read_bytes
from intercap_core.inputs.quotes import printable

MAX_ARRAYS = 10_000  # of one archive
_ADDRESS = re.compile(r" object at 0x[0-9a-f]+")
_SUFFIX, _ARRAY = ".npy", b"\x93NUMPY"
_HEADS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
# What zipfile and zlib raise for damaged, encrypted or foreign archives.
_ZIP_ERRORS = (
    zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, OSError,
    ValueError, OverflowError,
)  # fmt: skip
_HEAD_ERRORS = (
    ValueError,
    TypeError,
    SyntaxError,
    tokenize.TokenError,
    RecursionError,
    OverflowError,
    KeyError,
)  # fmt: skip  (of the parser of heads)


class Archive:
    """The arrays of an .npz by name; each is read when it is asked for."""

    def __init__(self, path: Path, limit: int = MAX_ARRAYS_BYTES, *, advice: str) -> None:
        """Raises Unreadable for what is no archive, or unpacks to more than ``limit`` bytes."""
        self._path, self._advice = path, advice
        content = read_bytes(path, limit, advice=advice)
        try:
            self._zip = zipfile.ZipFile(io.BytesIO(content))
        except _ZIP_ERRORS as error:
            told = "it is a single array" if content.startswith(_ARRAY) else error
            raise self._refused(f"is not a readable .npz archive ({told})") from None
        entries = self._zip.infolist()
        unpacked = sum(entry.file_size for entry in entries)
        if unpacked > limit:
            raise self._refused(
                f"unpacks to {unpacked / 1e6:.0f} MB, at most {limit / 1e6:.0f} are read"
            )
        if len(entries) > MAX_ARRAYS:
            raise self._refused(f"holds {len(entries)} arrays, at most {MAX_ARRAYS} are read")
        self._entries = {entry.filename.removesuffix(_SUFFIX): entry for entry in entries}

    @property
    def names(self) -> list[str]:
        """The arrays' names, in the archive's order."""
        return list(self._entries)

    def read(self, name: str) -> np.ndarray:
        """One array; raises Unreadable where it is damaged, or not of numbers or text."""
        try:
            content = self._zip.read(self._entries[name])
        except _ZIP_ERRORS as error:
            raise self._refused(f"is damaged at {name!r:.60} ({_told(error)})") from None
        try:
            return _array(content)
        except _HEAD_ERRORS as error:
            raise self._refused(f"has no readable array {name!r:.60} ({_told(error)})") from None

    def _refused(self, reason: str) -> Unreadable:
        return Unreadable(self._path, reason, self._advice)


def _told(error: Exception) -> str:
    words = _ADDRESS.sub("", printable(str(error)))  # of an object of Python's, which says nothing
    return " ".join(words.split())[:200] or type(error).__name__


def read_arrays(
    path: Path,
    wanted: Collection[str] | None = None,
    *,
    limit: int = MAX_ARRAYS_BYTES,
    advice: str = "save it again",
) -> dict[str, np.ndarray]:
    """The arrays of an .npz, or those of them that are wanted; raises Unreadable."""
    archive = Archive(path, limit, advice=advice)
    return {name: archive.read(name) for name in archive.names if wanted is None or name in wanted}


def check_text(values: np.ndarray) -> None:
    """Raise ValueError for text of numbers that are no characters: Python believes numpy's."""
    if values.dtype.kind == "U" and values.size:
        order = "<u4" if values.dtype.isnative == (sys.byteorder == "little") else ">u4"
        if np.ascontiguousarray(values).reshape(-1).view(order).max() > sys.maxunicode:
            raise ValueError("it holds text that is none")


def _array(content: bytes) -> np.ndarray:
    """The array of an .npy file's content; raises ``_HEAD_ERRORS`` where it is none of numbers."""
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    if version not in _HEADS:
        raise ValueError(f"version {version} of the format")
    shape, fortran, dtype = _HEADS[version](file)
    if dtype.hasobject or dtype.kind not in "biufcSU":
        raise ValueError(f"it holds {dtype}, expected numbers")
    if not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError(f"its shape is {shape!r:.60}")
    size, there = math.prod(shape) * dtype.itemsize, len(content) - file.tell()
    if size != there:
        raise ValueError(f"its shape {shape!r:.60} needs {size} bytes, it has {there}")
    if not size:
        return np.zeros(shape, dtype)
    values = np.frombuffer(content, dtype, offset=file.tell())
    check_text(values)
    return values.reshape(shape, order="F" if fortran else "C").copy(order="K")
