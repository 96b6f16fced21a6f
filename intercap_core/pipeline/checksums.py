"""Checksums of input files and of outputs, computed again only if size or date has changed.

A recording has gigabytes. The checksum of each input is stored with its size and date next to the
results of the sequence. A start with nothing to do therefore reads no recording; a touched or
copied file is read once and makes nothing stale. The checksum and the manifest of each artefact are
stored in the same way: another size or date shows that an artefact may be truncated or overwritten,
and only then is it opened. All stored values may be lost without harm.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from pathlib import Path
from typing import Any

from intercap_core import artefacts, schemas
from intercap_core.artefacts import part_of
from intercap_core.errors import UserError
from intercap_core.pipeline.provenance import FILE, Manifest, read_manifest
from intercap_core.stage_list import STAGES

INPUTS_FILE = ".inputs.json"
_SUFFIX = ".left"  # suffix of the file that stores the checksum of an output
_MANIFEST = "manifest"  # key of the manifest in that file
_MAX_LISTED = 200  # files of a folder up to which each file's size and date are compared
_LARGE_BYTES = 100_000_000  # a larger file with another size counts as changed, unread
_ROWS = 64  # rows read at a time, so that memory stays flat


class InputChecksums:
    """Checksums of input files by path, stored in the JSON file ``store``."""

    def __init__(self, store: Path) -> None:
        self._store = store
        self._known = read_pairs(store)
        self._changed = False

    def digest(self, path: Path, *, was: str | None = None) -> str:
        """Checksum and size of a file or folder; "missing" if it does not exist.

        Args:
            was: earlier value; "changed" is returned without reading a large file if its size
                differs.
        """
        try:
            stamp, size = _input_stamp(path)
        except OSError:
            return "missing"
        known = self._known.get(str(path))
        if known is not None and known[0] == stamp:
            return known[1]
        if was is not None and size > _LARGE_BYTES and was.rpartition(":")[2] != str(size):
            return "changed"
        checksum = _folder_digest(path) if path.is_dir() else _file_digest(path)[:16]
        digest = f"{checksum}:{size}"
        if stamp == _input_stamp(path)[0]:  # it did not change while it was read
            self._known[str(path)] = [stamp, digest]
            self._changed = True
        return digest

    def save(self) -> None:
        """Write new checksums to the store, if it can be written."""
        if self._changed and self._store.parent.is_dir():
            write_pairs(self._store, self._known)
            self._changed = False


def _input_stamp(path: Path) -> tuple[str, int]:
    """Text that changes with a file or folder, and its size or number of files.

    Replaced files change the dates of their folders. Files overwritten in place are noticed only
    in folders of up to ``_MAX_LISTED`` files.
    """
    stat = path.stat()
    if not path.is_dir():
        return f"{stat.st_size} {stat.st_mtime_ns}", stat.st_size
    state, count = hashlib.sha256(), 0
    for folder, folders, names in os.walk(path):
        folders.sort()
        state.update(f"{os.stat(folder).st_mtime_ns} {len(names)}\n".encode())
        count += len(names)
        for name in sorted(names) if len(names) <= _MAX_LISTED else ():
            file = os.stat(Path(folder, name))
            state.update(f"{name} {file.st_size} {file.st_mtime_ns}\n".encode())
    return state.hexdigest()[:16], count


def _file_digest(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _folder_digest(path: Path) -> str:
    state = hashlib.sha256()
    for folder, folders, names in os.walk(path):
        folders.sort()
        for name in sorted(names):
            file = Path(folder, name)
            if file.is_file():
                relative = file.relative_to(path).as_posix()
                state.update(f"{relative} {_file_digest(file)[:16]}\n".encode())
    return state.hexdigest()[:16]


def forget_output(output: Path) -> None:
    """Remove the stored checksum of an output, before another output takes its place."""
    _checksum_file(output).unlink(missing_ok=True)


def remember_output(output: Path) -> None:
    """Store size, date and checksum of a file; without effect if they cannot be stored."""
    with contextlib.suppress(OSError, artefacts.Unreadable):
        values = {
            output.name: [_output_stamp(output), _file_digest(output)],
            _MANIFEST: [_manifest_text(output), ""],
        }
        write_pairs(_checksum_file(output), values)


def is_unchanged(output: Path) -> bool:
    """Whether size and date of an output are the stored ones."""
    try:
        stored = read_pairs(_checksum_file(output)).get(output.name, ["", ""])
        return stored[0] == _output_stamp(output)
    except FileNotFoundError:
        return False


def find_damage(output: Path) -> str:
    """Read a whole artefact, or all files of an export; returns an error message, "" if intact.

    An artefact is intact if it has the stored checksum. If it is another artefact (with another
    manifest) or no checksum is stored, the checksums inside the HDF5 file decide. Raises OSError if
    the output cannot be read.
    """
    if output.is_dir():
        return _find_damaged_file(output)
    stored = read_pairs(_checksum_file(output))
    try:
        if output.name in stored:
            if _file_digest(output) == stored[output.name][1]:
                return ""
            if stored.get(_MANIFEST, ["", ""])[0] == _manifest_text(output):
                return f"{output}: is not as it was written; delete it and run again"
        if output.suffix != ".h5":
            return ""
        with artefacts.read(output, getattr(schemas, output.stem.upper())) as source:
            for key in source.keys():  # noqa: SIM118 (an Artefact is not a mapping)
                shape, _, _, _ = source.describe(key)
                for start in range(0, shape[0] if shape else 0, _ROWS):
                    source.rows(key, slice(start, start + _ROWS))
    except artefacts.Unreadable as error:
        return str(error)
    return ""


def _find_damaged_file(folder: Path) -> str:
    """The first file of an export that differs from its checksum in the export's manifest."""
    listing = folder / STAGES["export"].folder_marker
    if not listing.is_file():
        return ""
    try:
        listed = json.loads(listing.read_text(encoding="utf-8"))["files"]
        damaged = [
            name
            for name, digest in listed.items()
            if not (folder / name).is_file() or _file_digest(folder / name) != digest
        ]
    except (ValueError, KeyError, AttributeError, TypeError):
        damaged = [listing.name]
    if not damaged:
        return ""
    return (
        f"{folder / damaged[0]}: is not as it was written; delete the folder and re-run its stage"
    )


def read_valid_manifest(output: Path) -> Manifest | None:
    """The manifest of an output; None if it has none or if the output is a damaged artefact.

    An artefact is opened, and then read completely, only if its size or date differs from the
    stored one. Raises UserError if the output cannot be read.
    """
    is_artefact = output.suffix == ".h5"
    file = output if is_artefact else output / FILE
    try:
        file.open("rb").close()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise UserError(
            f"{file}: cannot be read ({error.strerror}); make it readable, or delete it, then run "
            "again"
        ) from None
    if not is_artefact:
        return read_manifest(output)
    stored = read_pairs(_checksum_file(output))
    if _MANIFEST in stored and is_unchanged(output):
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
    return output.with_name(f".{output.name}{_SUFFIX}")


def _output_stamp(output: Path) -> str:
    stat = output.stat()
    return f"{stat.st_size} {stat.st_mtime_ns}"


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
