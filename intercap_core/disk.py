"""Links between files, lists on disk, and faults of disks that are full or not writable.

HDF5 crashes the process if it cannot write its buffers. :class:`PartFile` hides failed writes from
HDF5 and reports them afterwards.
"""

from __future__ import annotations

import errno
import io
import os
import pickle
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from pathlib import Path
from typing import Any, TypeVar, overload

from intercap_core.signals import raise_pending, unbroken

Item = TypeVar("Item")

FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
NOT_WRITABLE = frozenset({errno.EROFS, errno.EACCES, errno.EPERM})


class PartFile(io.FileIO):
    """A file for h5py that accepts every write.

    HDF5 cannot abandon a file whose last writes fail: the process crashes at its end (h5py issue
    914). Bytes that a full disk rejects are therefore kept in memory, and :meth:`check` raises the
    error. Call it while writing, and after HDF5 has closed the file. Signals are deferred likewise.
    """

    def __init__(self, path: Path, mode: str) -> None:
        super().__init__(path, mode)
        self._error: OSError | None = None
        self._kept: list[tuple[int, bytes]] = []  # offsets and bytes, in their order
        self._at = 0

    def check(self) -> None:
        """Raise the OSError of the first failed write, or the signal that came during a write."""
        raise_pending()
        if self._error is not None:
            raise OSError(self._error.errno, self._error.strerror, str(self.name))

    def write(self, data: Any) -> int:
        """Write all of ``data``, to the disk or to memory."""
        view = memoryview(data).cast("B")
        done = 0
        while done < len(view) and self._error is None:
            try:
                done += super().write(view[done:]) or 0
            except OSError as error:
                self._error = error
        if done < len(view):
            self._kept.append((self._at + done, bytes(view[done:])))
        self._at += len(view)
        return len(view)

    def readinto(self, buffer: Any) -> int:
        """Read from the disk and from memory."""
        view = memoryview(buffer).cast("B")
        start, read = self._at, super().readinto(view) or 0
        for offset, data in self._kept:
            first, last = max(offset, start), min(offset + len(data), start + len(view))
            if first < last:
                view[first - start : last - start] = data[first - offset : last - offset]
                read = max(read, last - start)
        self._at += read
        return read

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Set the position, which may lie behind the end of the file on the disk."""
        self._at = super().seek(offset, whence)
        if whence == os.SEEK_END:
            self._at = max([self._at, *(at + len(data) for at, data in self._kept)])
        return self._at

    def truncate(self, size: int | None = None) -> int:
        """Set the length; without effect after a failed write, as the file is useless then."""
        size = self._at if size is None else size
        if self._error is None:
            try:
                super().truncate(size)
            except OSError as error:
                self._error = error
        return size


unbroken(PartFile.write, PartFile.readinto, PartFile.seek, PartFile.truncate)


def fault_in(error: BaseException) -> OSError | None:
    """The error of the disk that caused ``error``; None if there is none."""
    for one in _chain(error):
        if isinstance(one, OSError) and one.errno in FULL | NOT_WRITABLE:
            return one
    return None


def describe_fault(fault: OSError, place: Path | None = None, needed: str = "") -> str:
    """A message with the path, the system's reason, the space needed and what to do.

    Args:
        place: path that was being written, if ``fault`` does not name it.
        needed: words about the space needed.
    """
    named = Path(str(fault.filename)) if fault.filename else place
    where = f"{place or named}: " if place or named else ""
    elsewhere = named is not None and place is not None and named != place
    at = f" at {named}" if elsewhere else ""
    kept = "then run again: what is complete is kept, nothing is half-written"
    if fault.errno == errno.EFBIG:
        return f"{where}{fault.strerror}{at}: raise the limit (ulimit -f), {kept}"
    if fault.errno in FULL:
        free = f", {free_bytes(named) / 1e6:.0f} MB free" if named is not None else ""
        return (
            f"{where}the disk is full or a quota is used up ({fault.strerror}{at}{free})"
            f"{f'; {needed}' if needed else ''}; free space there, or name another folder by the "
            f"setting results, {kept}"
        )
    if elsewhere and place is not None and not _is_in_folder_of(named, place):
        return f"{where}needs what cannot be opened ({fault.strerror}{at}); make it readable"
    return (
        f"{where}cannot be written ({fault.strerror}{at}); make its folder writable, or name "
        "another one by the setting results, then run again"
    )


def _is_in_folder_of(named: Path | None, place: Path) -> bool:
    return named is not None and named.is_relative_to(place if place.is_dir() else place.parent)


def free_bytes(place: Path) -> int:
    """Free space on the disk of a path, which need not exist yet."""
    there = next(one for one in (place, *place.resolve().parents) if one.exists())
    return shutil.disk_usage(there).free


def link(file: Path, target: Path) -> None:
    """Create ``target`` as a hard link to ``file``, or as a copy if the file system has no links.

    Raises FileNotFoundError if ``file`` is missing.
    """
    try:
        os.link(file, target)
    except FileNotFoundError:
        raise
    except OSError:  # no links, or no more of them
        shutil.copyfile(file, target)


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """Yield the error, its cause, the cause of that, and so on."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        yield error
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)


class DiskList(Sequence[Item]):
    """A list of items that are pickled to a temporary file, for data that outgrow the memory."""

    def __init__(self, folder: Path) -> None:
        """Open an empty list, whose file in ``folder`` is removed when the list is released."""
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115
        self._places: list[tuple[int, int]] = []

    def append(self, item: Item) -> None:
        """Append an item; raises OSError if the disk is full."""
        start = self._file.tell()
        pickle.dump(item, self._file, pickle.HIGHEST_PROTOCOL)
        self._file.flush()
        self._places.append((start, self._file.tell() - start))

    def select(self, indices: Iterable[int]) -> DiskList[Item]:
        """Return a list of some items, in the same file."""
        chosen = copy(self)
        chosen._places = [self._places[index] for index in indices]
        return chosen

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, index: int) -> Item: ...
    @overload
    def __getitem__(self, index: slice) -> DiskList[Item]: ...
    def __getitem__(self, index: int | slice) -> Item | DiskList[Item]:
        if isinstance(index, slice):
            return self.select(range(len(self))[index])
        start, size = self._places[index]
        item: Item = pickle.loads(os.pread(self._file.fileno(), size, start))
        return item
