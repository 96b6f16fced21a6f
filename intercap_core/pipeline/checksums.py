"""Checksums of input files and of outputs, computed again only if size or date has changed.

A recording has gigabytes. The checksum of each input is stored with its size and dates next to the
results of the sequence. A start with nothing to do therefore reads no recording; a touched or
copied file is read once and makes nothing stale. Outputs are treated alike: the manifest of a
folder lists size and checksum of every file in it, and the checksum of an artefact is stored next
to it. Only if size or date of a file has changed is it read and compared. All values stored next to
outputs may be lost without harm.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from intercap_core import artefacts, schemas
from intercap_core.artefacts import part_of
from intercap_core.errors import UserError
from intercap_core.pipeline.provenance import FILE, Manifest, file_digest, read_manifest

INPUTS_FILE = ".inputs.json"
_SUFFIX = ".left"  # suffix of the file that stores the checksum of an output
_STAMPS = f".files{_SUFFIX}"  # the same inside a folder, for the files of its manifest
_MANIFEST = "manifest"  # key of the manifest in that file
_LARGE_BYTES = 100_000_000  # a larger file with another size counts as changed, unread
_ROWS = 64  # rows read at a time, so that memory stays flat


class InputChecksums:
    """Checksums of input files by path, stored in the JSON file ``store``.

    With ``one_look``, sizes and dates are those of the first call for a path. Jobs do not set it,
    because files may change while they run.
    """

    def __init__(self, store: Path, *, one_look: bool = False) -> None:
        self._stamp = functools.cache(_input_stamp) if one_look else _input_stamp
        self._store = store
        self._known = read_pairs(store)
        self._changed = False

    def digest(self, path: Path, *, was: str | None = None) -> str:
        """Checksum and size of a file or folder; "missing", "unreadable" or "no file" without them.

        Pipes and devices are "no file"; they are not opened. The stage that reads the file reports
        it.

        Args:
            was: earlier value; "changed" is returned without reading a large file if its size
                differs.
        """
        try:
            stamp, size = self._stamp(path)
        except (OSError, ValueError):
            return "missing"
        if not stamp:
            return "no file"
        known = self._known.get(str(path))
        if known is not None and known[0] == stamp:
            return known[1]
        if was is not None and size > _LARGE_BYTES and was.rpartition(":")[2] != str(size):
            return "changed"
        try:
            checksum = _folder_digest(path) if path.is_dir() else file_digest(path)[:16]
            digest = f"{checksum}:{size}"
            if stamp == _input_stamp(path)[0]:  # it did not change while it was read
                self._known[str(path)] = [stamp, digest]
                self._changed = True
        except OSError:
            return "unreadable"
        return digest

    def save(self) -> None:
        """Write new checksums to the store, if it can be written."""
        if self._changed and self._store.parent.is_dir():
            write_pairs(self._store, self._known)
            self._changed = False


def _input_stamp(path: Path) -> tuple[str, int]:
    """Text that changes with a file, or with any file of a folder, and its size or their number.

    The time of the last change of the inode shows a file that is rewritten with its old date. The
    text is empty for pipes and devices.
    """
    status = path.stat()
    if not stat.S_ISDIR(status.st_mode):
        return _stat_text(status), status.st_size
    state, count = hashlib.sha256(), 0
    for file in _files_below(os.fspath(path)):
        with contextlib.suppress(OSError):  # a dangling link
            state.update(os.fsencode(f"{file}\0{_stat_text(os.stat(file))}\n"))
        count += 1
    return state.hexdigest()[:16], count


def _stat_text(status: os.stat_result) -> str:
    if not stat.S_ISREG(status.st_mode):
        return ""
    return f"{status.st_size} {status.st_mtime_ns} {status.st_ctime_ns}"


def _files_below(folder: str, above: tuple[tuple[int, int], ...] = ()) -> Iterator[str]:
    """Paths below a folder that are no folders, sorted; links to folders are followed.

    ``above``: device and inode of the folders above, to which a link may lead back.
    """
    status = os.stat(folder)
    inode = (status.st_dev, status.st_ino)
    if inode in above:
        return
    with os.scandir(folder) as scanned:
        entries = sorted(scanned, key=lambda entry: entry.name)
    for entry in entries:
        if entry.is_dir():
            yield from _files_below(entry.path, (*above, inode))
        else:
            yield entry.path


def _folder_digest(path: Path) -> str:
    """Digest of the names and contents of all files below a folder."""
    state = hashlib.sha256()
    for file in _files_below(os.fspath(path)):
        content = file_digest(Path(file))[:16] if os.path.isfile(file) else "no file"
        state.update(os.fsencode(f"{os.path.relpath(file, path)} {content}\n"))
    return state.hexdigest()[:16]


def forget_output(output: Path) -> None:
    """Remove the stored checksum of an artefact, before another one takes its place."""
    _checksum_file(output).unlink(missing_ok=True)


def remember_output(output: Path) -> None:
    """Store size, date and checksum of an output; without effect if they cannot be stored."""
    with contextlib.suppress(OSError, artefacts.Unreadable):
        values = {output.name: [_output_stamp(output), ""]}
        if not output.is_dir():
            values[output.name][1] = file_digest(output)
            values[_MANIFEST] = [_manifest_text(output), ""]
        write_pairs(_checksum_file(output), values)


def is_unchanged(output: Path) -> bool:
    """Whether size and date of an output, or of all files of a folder, are the stored ones."""
    try:
        stored = read_pairs(_checksum_file(output)).get(output.name, ["", ""])
        return stored[0] == _output_stamp(output)
    except OSError:
        return False


def find_damage(output: Path) -> str:
    """Read a whole output; returns an error message, "" if it is intact.

    A folder is intact if it has the files of its manifest; an artefact, if it has the stored
    checksum. If it is another artefact (with another manifest) or no checksum is stored, the
    checksums inside the HDF5 file decide. Raises OSError if the output cannot be read.
    """
    if output.is_dir():
        return _find_damaged_file(output)
    stored = read_pairs(_checksum_file(output))
    try:
        if output.name in stored:
            if file_digest(output) == stored[output.name][1]:
                return ""
            if stored.get(_MANIFEST, ["", ""])[0] == _manifest_text(output):
                return f"{output}: differs from the file that was written; delete it and run again"
        with artefacts.read(output, getattr(schemas, output.stem.upper())) as source:
            for key in source.keys():  # noqa: SIM118 (an Artefact is not a mapping)
                shape, _, _, _ = source.describe(key)
                for start in range(0, shape[0] if shape else 0, _ROWS):
                    source.rows(key, slice(start, start + _ROWS))
    except artefacts.Unreadable as error:
        return str(error)
    return ""


def _find_damaged_file(folder: Path) -> str:
    """Error message about the first file that differs from the folder's manifest, "" if none."""
    manifest = read_manifest(folder)
    if manifest is None or not manifest.outputs:  # or an earlier version wrote it
        return f"{folder / FILE}: does not list the folder's files; run again"
    for name, listed in manifest.outputs.items():
        file, size = folder / name, listed.rpartition(":")[2]
        if not file.is_file():
            return f"{file}: is missing; run again"
        if str(file.stat().st_size) != size:
            return f"{file}: has {file.stat().st_size} bytes, it was written with {size}; run again"
        if f"{file_digest(file)}:{size}" != listed:
            return f"{file}: differs from the file that was written; delete it and run again"
    return ""


def read_valid_manifest(output: Path) -> Manifest | None:
    """The manifest of an output; None if it has none or if the output is damaged.

    An output is read completely only if its size or date differs from the stored one. Raises
    UserError if the output cannot be read.
    """
    file = output if output.suffix == ".h5" else output / FILE
    try:
        if not file.is_file():  # missing, a dangling link, or a pipe, whose open() blocks
            return None
        file.open("rb").close()
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise UserError(
            f"{file}: cannot be read ({error.strerror}); make it readable, or delete it, then run "
            "again"
        ) from None
    if is_unchanged(output):
        stored = read_pairs(_checksum_file(output))
        if output.is_dir() or _MANIFEST not in stored:
            return read_manifest(output)
        return Manifest.from_text(stored[_MANIFEST][0])
    manifest = read_manifest(output)
    if manifest is None or find_damage(output):
        return None
    remember_output(output)
    return manifest


def _manifest_text(output: Path) -> str:
    """Text of an artefact's manifest; "" for other files."""
    return artefacts.made_from(output) if output.suffix == ".h5" else ""


def _checksum_file(output: Path) -> Path:
    if output.is_dir():
        return output / _STAMPS
    return output.with_name(f".{output.name}{_SUFFIX}")


def _output_stamp(output: Path) -> str:
    """Size and date of an artefact; digest of those of the files that a folder's manifest lists."""
    if not output.is_dir():
        status = output.stat()
        return f"{status.st_size} {status.st_mtime_ns}"
    manifest = read_manifest(output)
    state = hashlib.sha256()
    for name in manifest.outputs if manifest is not None else ():
        status = (output / name).stat()
        state.update(f"{name} {status.st_size} {status.st_mtime_ns}\n".encode())
    return state.hexdigest()


def read_pairs(path: Path) -> dict[str, list[str]]:
    """Pairs of texts by name from a JSON file; damaged entries and files are ignored."""
    values: Any = None
    with contextlib.suppress(OSError, ValueError, RecursionError):
        values = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(values, dict):
        return {}
    return {name: pair for name, pair in values.items() if _is_pair(pair)}


def write_pairs(path: Path, pairs: dict[str, list[str]]) -> None:
    """Write pairs of texts atomically; without effect if the folder is not writable."""
    part = part_of(path)
    with contextlib.suppress(OSError):
        try:
            part.write_text(json.dumps(pairs, indent=0, sort_keys=True), encoding="utf-8")
            os.replace(part, path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise


def _is_pair(pair: Any) -> bool:
    return isinstance(pair, list) and len(pair) == 2 and all(isinstance(text, str) for text in pair)
