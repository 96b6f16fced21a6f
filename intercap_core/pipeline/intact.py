"""Whether results are as they were left: what has another size or date since is read through once.

An artefact's size, date and digest are noted beside it when it is made. One whose size or date
differs was copied, touched, cut off or overwritten, which its digest tells: the same record, the
same bytes. Where nothing is noted, or an artefact with another record was put there, its checksums
tell. To read hundreds of gigabytes at every start they need not.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from pathlib import Path

from intercap_core import artefacts, schemas
from intercap_core.pipeline.kept import keep, read_kept
from intercap_core.stages.folders import EXPORT_MARKER

SUFFIX = ".left"  # of what is noted of an output
RECORD = "record"  # of the note: digest of what the output says that it was made from
_ROWS = 64  # read at a time, so that memory stays flat


def forget(output: Path) -> None:
    """Remove what is noted of an output, before another one takes its place: a note is right, or
    there is none."""
    _note_of(output).unlink(missing_ok=True)


def note(output: Path) -> None:
    """Remember an output as it is now, a folder not; what cannot be remembered is read later."""
    with contextlib.suppress(OSError, artefacts.Unreadable):
        now = {output.name: [_stamp(output), _digest(output)], RECORD: [_record(output), ""]}
        keep(_note_of(output), now)


def is_as_left(output: Path) -> bool:
    """Whether size and date are those that were noted."""
    try:
        return read_kept(_note_of(output)).get(output.name, ["", ""])[0] == _stamp(output)
    except FileNotFoundError:
        return False


def damage_of(output: Path) -> str:
    """Read all of an artefact, or all files of an export, and say what is wrong with them; "" =
    nothing. Raises OSError where they cannot be read."""
    if output.is_dir():
        return _changed_file(output)
    noted = read_kept(_note_of(output))
    try:
        if output.name in noted:
            if _digest(output) == noted[output.name][1]:
                return ""
            if noted.get(RECORD, ["", ""])[0] == _record(output):  # else another one was put there
                return f"{output}: is not as it was written; delete it and run again"
        if output.suffix != ".h5":
            return ""
        with artefacts.read(output, getattr(schemas, output.stem.upper())) as source:
            for key in source.keys():  # noqa: SIM118 (an Artefact is not a mapping)
                shape, _, _, _ = source.describe(key)
                if shape and shape[0] > 0:
                    for start in range(0, shape[0], _ROWS):
                        source.rows(key, slice(start, start + _ROWS))
    except artefacts.Unreadable as error:
        return str(error)
    return ""


def _changed_file(folder: Path) -> str:
    """Which of the files is not the one that the folder's list of digests names."""
    if not (folder / EXPORT_MARKER).is_file():
        return ""
    try:
        listed = json.loads((folder / EXPORT_MARKER).read_text(encoding="utf-8"))["files"]
        found = [
            name
            for name, digest in listed.items()
            if not (folder / name).is_file() or _digest(folder / name) != digest
        ]
    except (ValueError, KeyError, AttributeError, TypeError):
        found = [EXPORT_MARKER]
    if not found:
        return ""
    return f"{folder / found[0]}: is not as it was written; delete the folder and re-run its stage"


def _digest(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _record(output: Path) -> str:
    """Digest of what an artefact says that it was made from, "" of other files."""
    if output.suffix != ".h5":
        return ""
    return hashlib.sha256(artefacts.made_from(output).encode()).hexdigest()


def _note_of(output: Path) -> Path:
    return output.with_name(f".{output.name}{SUFFIX}")


def _stamp(output: Path) -> str:
    stat = output.stat()
    return f"{stat.st_size} {stat.st_mtime_ns}"
