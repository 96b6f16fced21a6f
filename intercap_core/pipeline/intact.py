"""Whether results are as they were left: what has another size or date since is read through once.

An artefact's size, date and digest are noted beside it when it is made. One whose size or date
differs was copied, touched, cut off or overwritten; which of these its digest tells, or its
checksums where nothing is noted. To read hundreds of gigabytes at every start they need not.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from pathlib import Path

from intercap_core import artefacts, schemas

NAME = ".outputs.json"  # of a sequence's artefacts
EXPORT_LIST = "export.json"  # digests of an export's files
_ROWS = 64  # read at a time, so that memory stays flat


def note(output: Path) -> None:
    """Remember an artefact as it is now; what cannot be remembered is read through later."""
    part = output.with_name(f"{NAME}.{os.getpid()}.part")
    with contextlib.suppress(OSError):
        known = _known(output) | {output.name: [_stamp(output), _digest(output)]}
        part.write_text(json.dumps(known, indent=0, sort_keys=True), encoding="utf-8")
        os.replace(part, output.with_name(NAME))
    part.unlink(missing_ok=True)


def is_as_left(output: Path) -> bool:
    """Whether size and date are those that were noted."""
    return _noted(output)[0] == _stamp(output)


def damage_of(output: Path) -> str:
    """Read all of an artefact, or all files of an export, and say what is wrong with them; "" =
    nothing."""
    if output.is_dir():
        return _changed_file(output)
    digest = _noted(output)[1]
    if digest:  # HDF5 has not to meet what is damaged: it was seen to hang, and to end the process
        same = _digest(output) == digest
        return "" if same else f"{output}: is not as it was written; delete it and run again"
    if output.suffix != ".h5":
        return ""
    try:
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
    if not (folder / EXPORT_LIST).is_file():
        return ""
    try:
        listed = json.loads((folder / EXPORT_LIST).read_text(encoding="utf-8"))["files"]
        found = [name for name, digest in listed.items() if _digest(folder / name) != digest]
    except (ValueError, KeyError, AttributeError, TypeError):
        found = [EXPORT_LIST]
    if not found:
        return ""
    return f"{folder / found[0]}: is not as it was written; delete the folder and re-run its stage"


def _digest(path: Path) -> str:
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return "missing"


def _noted(output: Path) -> tuple[str, str]:
    """Size with date, and digest; empty where nothing is noted."""
    found = _known(output).get(output.name)
    if isinstance(found, list) and len(found) == 2 and all(isinstance(one, str) for one in found):
        return found[0], found[1]
    return "", ""


def _known(output: Path) -> dict[str, list[str]]:
    with contextlib.suppress(OSError, ValueError):
        told = json.loads(output.with_name(NAME).read_text(encoding="utf-8"))
        if isinstance(told, dict):
            return told
    return {}


def _stamp(output: Path) -> str:
    stat = output.stat()
    return f"{stat.st_size} {stat.st_mtime_ns}"
