"""Arrays of .npz archives and of pickles, without executing what a file names."""

from __future__ import annotations

import io
import pickle
import tokenize
import zipfile
import zlib
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.inputs.files import (
    MAX_ARRAYS_BYTES,
    MAX_UNPACKING,
    MIN_UNPACKED_BYTES,
    UnreadableFile,
    printable,
    read_bytes,
)

# Exceptions of zipfile, zlib and numpy's parser of headers for damaged archives.
_ARCHIVE_ERRORS = (
    zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, OSError,
    ValueError, OverflowError, TypeError, SyntaxError, tokenize.TokenError, KeyError,
    MemoryError,  # a damaged header states any size
)  # fmt: skip
# Exceptions of the unpickler for damaged files.
PICKLE_ERRORS = (
    pickle.UnpicklingError, ValueError, TypeError, LookupError, AttributeError, EOFError,
    OverflowError, RecursionError, ImportError, AssertionError, SystemError,
    MemoryError,  # a damaged index of the unpickler's memo asks for any amount of memory
)  # fmt: skip
# Names that pickles of numpy arrays and plain values hold. numpy 2.0 renamed core to _core.
_PICKLE_NAMES = {
    *((f"numpy.{core}.multiarray", name) for core in ("core", "_core")
      for name in ("_reconstruct", "scalar")),
    *((f"numpy.{core}.numeric", "_frombuffer") for core in ("core", "_core")),
    ("numpy", "ndarray"), ("numpy", "dtype"),
    ("_codecs", "encode"),  # of bytes in protocol 2
    ("collections", "OrderedDict"),
    *((module, name) for module in ("builtins", "__builtin__")
      for name in ("set", "frozenset", "bytes")),
}  # fmt: skip


def read_arrays(
    path: Path,
    wanted: Collection[str] | None = None,
    *,
    limit: int = MAX_ARRAYS_BYTES,
    advice: str = "save it again",
) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz by name, all or those in ``wanted``.

    Raises UnreadableFile if it is no archive, unpacks to more than ``limit`` bytes or to more than
    ``MAX_UNPACKING`` times its size, or if a wanted array is damaged or holds neither numbers nor
    text.
    """
    content = read_bytes(path, limit, advice=advice)
    if content.startswith(b"\x93NUMPY"):
        raise UnreadableFile(path, "is not a readable .npz archive (it is a single array)", advice)
    try:
        archive = zipfile.ZipFile(io.BytesIO(content))
    except _ARCHIVE_ERRORS as error:
        raise UnreadableFile(path, f"is not a readable .npz archive ({error})", advice) from None
    unpacked = sum(entry.file_size for entry in archive.infolist())
    limit = min(limit, max(MIN_UNPACKED_BYTES, MAX_UNPACKING * len(content)))
    if unpacked > limit:
        size = f"{len(content) / 1e6:.1f} MB" if len(content) > 1e5 else f"{len(content)} bytes"
        words = (
            f"unpacks from {size} to {unpacked / 1e6:.0f} MB, at most {limit / 1e6:.0f} are read"
        )
        raise UnreadableFile(path, words, advice)
    arrays = {}
    for entry in archive.infolist():
        name = entry.filename.removesuffix(".npy")
        if wanted is not None and name not in wanted:
            continue
        try:
            arrays[name] = _array(archive, entry)
        except _ARCHIVE_ERRORS as error:
            reason = " ".join(printable(str(error)).split())[:200] or type(error).__name__
            words = f"has no readable array {name!r:.60} ({reason})"
            raise UnreadableFile(path, words, advice) from None
    return arrays


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    """Return an array of an archive, unpacked into its memory without another copy.

    zipfile bounds the memory of stored and deflated entries only, which are those of numpy.
    """
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        method = entry.compress_type  # 12 is bzip2, 14 is LZMA
        raise ValueError(f"it is packed by method {method}, expected deflate as numpy does")
    with archive.open(entry) as file:
        array = np.lib.format.read_array(file, allow_pickle=False)
    if array.dtype.kind not in "biufcSU":
        raise ValueError(f"it holds {array.dtype}, expected numbers")
    return array


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _PICKLE_NAMES:
            raise pickle.UnpicklingError(f"it asks for {module:.40}.{name:.40}")
        return super().find_class(module, name)


def read_pickle(path: Path) -> Any:
    """Load a pickle of numpy arrays and plain Python values, such as results of InterCap.

    Python 2 pickles are read as latin-1, as numpy advises. Raises UnreadableFile if the file is
    missing, damaged or names anything else.
    """
    content = read_bytes(Path(path))
    try:
        return _Unpickler(io.BytesIO(content), encoding="latin1").load()
    except PICKLE_ERRORS as error:
        reason = printable(str(error))[:200]
        if not reason or " at 0x" in reason:  # the address of an object of Python's
            reason = type(error).__name__
        raise UnreadableFile(
            Path(path),
            f"not a pickle of numpy arrays and plain values ({reason})",
            "convert it to .npz or .json, or get the file again",
        ) from None
