"""Digests of the files that a stage is given, taken anew only where size or date has changed.

A recording has gigabytes. What its digest was, and of which size and date, is kept beside the
sequence's results: a touch or a copy costs one reading and re-runs nothing, and a start with
nothing to do reads no recording. Folders are as their files; that a file of one was replaced is
seen by the dates of the folders; that one was overwritten in place, in folders of a few files (of
thousands of images it is not).
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from intercap_core.pipeline.kept import keep, read_kept

NAME = ".inputs.json"
FEW = 200  # files of a folder whose own sizes and dates are looked at
LARGE = 100_000_000  # bytes; where the size of such a file differs it is not read to know


class Contents:
    """Digests by path, with what is known of them in ``store``, a JSON file."""

    def __init__(self, store: Path) -> None:
        self._store = store
        self._known = read_kept(store)
        self._changed = False

    def digest(self, path: Path, *, was: str | None = None) -> str:
        """Digest of a file or folder with its size, "missing" where there is none.

        ``was``: the digest that it is to be compared with; a large file of another size is
        "changed" without being read.
        """
        try:
            stamp, size = _stamp(path)
        except OSError:
            return "missing"
        known = self._known.get(str(path))
        if known is not None and known[0] == stamp:
            return known[1]
        if was is not None and size > LARGE and was.rpartition(":")[2] != str(size):
            return "changed"
        found = f"{_folder_digest(path) if path.is_dir() else _file_digest(path)}:{size}"
        if stamp == _stamp(path)[0]:  # it did not change while it was read
            self._known[str(path)] = [stamp, found]
            self._changed = True
        return found

    def keep(self) -> None:
        """Write what was learned, whole or not at all; a store that cannot be written is none."""
        if not self._changed or not self._store.parent.is_dir():
            return
        keep(self._store, self._known)
        self._changed = False


def _stamp(path: Path) -> tuple[str, int]:
    """What tells that a file or folder has not changed, and its size; raises OSError of none."""
    stat = path.stat()
    if not path.is_dir():
        return f"{stat.st_size} {stat.st_mtime_ns}", stat.st_size
    state, count = hashlib.sha256(), 0
    for folder, folders, names in os.walk(path):
        folders.sort()
        state.update(f"{os.stat(folder).st_mtime_ns} {len(names)}\n".encode())
        count += len(names)
        for name in sorted(names) if len(names) <= FEW else ():
            one = os.stat(Path(folder, name))
            state.update(f"{name} {one.st_size} {one.st_mtime_ns}\n".encode())
    return state.hexdigest()[:16], count


def _file_digest(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]


def _folder_digest(path: Path) -> str:
    state = hashlib.sha256()
    for folder, folders, names in os.walk(path):
        folders.sort()
        for name in sorted(names):
            file = Path(folder, name)
            if file.is_file():
                state.update(f"{file.relative_to(path).as_posix()} {_file_digest(file)}\n".encode())
    return state.hexdigest()[:16]
