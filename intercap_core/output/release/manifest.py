"""The list of a dataset's files, with their digests and with what made them; and its check."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from intercap_core.errors import UserError
from intercap_core.geometry.solve.thread_pool import ThreadPool
from intercap_core.progress import Progress

log = logging.getLogger(__name__)

MANIFEST, SUMS = "release.json", "release.sha256"
FORMAT = 1
KINDS = ("card", "tables", "site", "export", "artefact")
_RECORDINGS = "recordings"  # what the studio made: inputs, with their truth
_BLOCK = 1 << 22


@dataclass(frozen=True)
class Entry:
    """One file: its path in the dataset's folder, of which ``kind``, its size and SHA-256."""

    path: str
    kind: str
    bytes: int
    sha256: str


@dataclass(frozen=True)
class Differences:
    """Paths that a folder lacks, holds with other content, or holds beside those released."""

    missing: list[str] = field(default_factory=list)
    changed: list[str] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)

    def __bool__(self) -> bool:
        return bool(self.missing or self.changed)


def kind_of(path: PurePosixPath) -> str | None:
    """What a file of a dataset's folder is; None where it is not the dataset's."""
    if any(part.startswith(".") for part in path.parts) or path.parts[0] == _RECORDINGS:
        return None
    if len(path.parts) == 1:
        return None if path.name in (MANIFEST, SUMS) else "card"
    if path.parts[0] in ("tables", "site"):
        return path.parts[0]
    return "export" if path.parts[1] == "export" else "artefact"


def write(
    folder: Path,
    made_with: Mapping[str, Any],
    *,
    kinds: Sequence[str] = KINDS,
    sequences: Sequence[str] | None = None,
    threads: int = 1,
) -> list[Entry]:
    """Write ``release.json`` and ``release.sha256``, which sha256sum -c reads, into the dataset's
    ``folder``.

    ``made_with``: what is said of versions and settings, fit for JSON. ``kinds`` of files that are
    released; of the folders of sequences those of ``sequences`` alone, where given. Raises
    UserError where there are none.
    """
    paths = [
        (path, kind)
        for path, kind in _files(folder)
        if kind in kinds and (sequences is None or _sequence_of(path, kind) in (None, *sequences))
    ]
    if not paths:
        raise UserError(
            f"{folder}: holds nothing to release of {', '.join(kinds)}; run the project before"
        )
    progress = Progress(log, "read", len(paths), "files")

    def entry(item: tuple[PurePosixPath, str]) -> Entry:
        path, kind = item
        digest, size = _digest(folder / path)
        progress.step()
        return Entry(path.as_posix(), kind, size, digest)

    entries = ThreadPool(threads).map(entry, paths)
    told = {"format": FORMAT, **made_with, "files": [vars(one) for one in entries]}
    (folder / MANIFEST).write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    lines = [f"{one.sha256}  {one.path}\n" for one in entries]
    (folder / SUMS).write_text("".join(lines), encoding="utf-8")
    return entries


def check(folder: Path, *, threads: int = 1) -> tuple[int, Differences]:
    """Compare a dataset's ``folder`` with the ``release.json`` in it: how many files that lists,
    and what differs.

    Raises UserError where there is none, or it is broken.
    """
    listed = _read(folder / MANIFEST)

    def state(one: Entry) -> str:
        path = folder / one.path
        there = path.is_file()
        same = there and path.stat().st_size == one.bytes and _digest(path)[0] == one.sha256
        progress.step()
        return "" if same else "changed" if there else "missing"

    progress = Progress(log, "checked", len(listed), "files")
    states = ThreadPool(threads).map(state, listed)
    found: dict[str, list[str]] = {"missing": [], "changed": []}
    for one, said in zip(listed, states, strict=True):
        if said:
            found[said].append(one.path)
    known = {one.path for one in listed}
    kinds = {one.kind for one in listed}
    unknown = [
        path.as_posix()
        for path, kind in _files(folder)
        if kind in kinds and path.as_posix() not in known
    ]
    return len(listed), Differences(found["missing"], found["changed"], unknown)


def _files(folder: Path) -> list[tuple[PurePosixPath, str]]:
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; run the project before, or name another folder")
    found = []
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not path.is_symlink():
            relative = PurePosixPath(path.relative_to(folder).as_posix())
            kind = kind_of(relative)
            if kind is not None:
                found.append((relative, kind))
    return found


def _sequence_of(path: PurePosixPath, kind: str) -> str | None:
    """Whose file it is; None of the dataset as a whole."""
    if kind == "site":
        return path.parts[2] if path.parts[1] == "sequences" else None
    return path.parts[0] if kind in ("export", "artefact") else None


def _digest(path: Path) -> tuple[str, int]:
    found, size = hashlib.sha256(), 0
    with open(path, "rb") as file:
        while block := file.read(_BLOCK):
            found.update(block)
            size += len(block)
    return found.hexdigest(), size


def _read(path: Path) -> list[Entry]:
    """The files that a manifest lists; nothing that it says leads out of its folder."""
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        if told["format"] != FORMAT:
            raise UserError(
                f"{path}: is of format {told['format']!r}, expected {FORMAT}; check it with the "
                "version of this program that wrote it"
            )
        entries = [
            Entry(str(one["path"]), str(one["kind"]), int(one["bytes"]), str(one["sha256"]))
            for one in told["files"]
        ]
    except FileNotFoundError:
        raise UserError(
            f"{path}: there is no such file; name the folder of a released dataset, or write one "
            "with intercap release SETTINGS"
        ) from None
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise UserError(f"{path}: is no list of released files ({error!r})") from None
    for one in entries:
        pure = PurePosixPath(one.path)
        if pure.is_absolute() or ".." in pure.parts or kind_of(pure) is None:
            raise UserError(f"{path}: lists {one.path!r}, which is not a file of this dataset")
    return entries
