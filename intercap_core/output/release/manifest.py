"""Manifest of a released dataset: files with digests, and their origin; and its check."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from intercap_core.errors import UserError
from intercap_core.geometry.solve.thread_pool import ThreadPool
from intercap_core.progress import Progress

log = logging.getLogger(__name__)

MANIFEST, SUMS = "release.json", "release.sha256"
FORMAT = 1
KINDS = ("card", "tables", "site", "export", "artefact")
_RECORDINGS = "recordings"  # folder of the studio's recordings and truth, not released


@dataclass(frozen=True)
class ReleasedFile:
    """One released file."""

    path: str
    """Path relative to the dataset's folder."""
    kind: str
    """One of KINDS."""
    bytes: int
    sha256: str


def kind_of(path: PurePosixPath) -> str | None:
    """Return the kind of a file in a dataset's folder; None if it is not part of the dataset."""
    if any(part.startswith(".") for part in path.parts) or path.parts[0] == _RECORDINGS:
        return None
    if len(path.parts) == 1:
        return None if path.name in (MANIFEST, SUMS) else "card"
    if path.parts[0] in ("tables", "site", "export"):
        return path.parts[0]
    return "export" if path.parts[1] == "export" else "artefact"


def write(
    folder: Path,
    made_with: Mapping[str, Any],
    *,
    kinds: Sequence[str] = KINDS,
    sequences: Sequence[str] | None = None,
    threads: int = 1,
) -> list[ReleasedFile]:
    """Write ``release.json`` and ``release.sha256`` (for sha256sum -c) into ``folder``.

    Args:
        made_with: versions and settings, for JSON.
        kinds: kinds of files to release.
        sequences: sequences to release, by default all.

    Raises UserError if there are no such files.
    """
    paths = [
        (path, kind)
        for path, kind in _files(folder)
        if kind in kinds and (sequences is None or _sequence_of(path, kind) in (None, *sequences))
    ]
    if not paths:
        raise UserError(
            f"{folder}: has no files to release ({', '.join(kinds)}); run the project first"
        )
    progress = Progress(log, "read", len(paths), "files")

    def read_entry(item: tuple[PurePosixPath, str]) -> ReleasedFile:
        path, kind = item
        file = folder / path
        entry = ReleasedFile(path.as_posix(), kind, file.stat().st_size, _digest(file))
        progress.step()
        return entry

    entries = ThreadPool(threads).map(read_entry, paths)
    content = {"format": FORMAT, **made_with, "files": [vars(entry) for entry in entries]}
    (folder / MANIFEST).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    lines = [f"{entry.sha256}  {entry.path}\n" for entry in entries]
    (folder / SUMS).write_text("".join(lines), encoding="utf-8")
    return entries


def check(folder: Path, *, threads: int = 1) -> tuple[int, dict[str, list[str]]]:
    """Compare a dataset's ``folder`` with its release.json.

    Returns the number of listed files, and the paths that are "missing", that are "changed" in size
    or checksum, and that are "not in the list". Raises UserError if release.json is missing or
    broken.
    """
    listed = _read(folder / MANIFEST)

    def compare(entry: ReleasedFile) -> str:
        path = folder / entry.path
        exists = path.is_file()
        same = exists and path.stat().st_size == entry.bytes and _digest(path) == entry.sha256
        progress.step()
        return "as released" if same else "changed" if exists else "missing"

    progress = Progress(log, "checked", len(listed), "files")
    states = ThreadPool(threads).map(compare, listed)
    found = {
        state: [entry.path for entry, own in zip(listed, states, strict=True) if own == state]
        for state in ("missing", "changed")
    }
    known, kinds = {entry.path for entry in listed}, {entry.kind for entry in listed}
    found["not in the list"] = [
        path.as_posix()
        for path, kind in _files(folder)
        if kind in kinds and path.as_posix() not in known
    ]
    return len(listed), found


def _files(folder: Path) -> list[tuple[PurePosixPath, str]]:
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; run the project first, or name another folder")
    files = [
        PurePosixPath(path.relative_to(folder).as_posix())
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.is_symlink()
    ]
    return [(path, kind) for path in files if (kind := kind_of(path)) is not None]


def _sequence_of(path: PurePosixPath, kind: str) -> str | None:
    """Return the sequence of a file; None for files of the whole dataset."""
    if kind == "site":
        return path.parts[2] if path.parts[1] == "sequences" else None
    of_all = path.parts[0] == "export" or kind not in ("export", "artefact")
    return None if of_all else path.parts[0]


def _digest(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _read(path: Path) -> list[ReleasedFile]:
    """Read a manifest; paths that lead out of its folder are refused."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] != FORMAT:
            raise UserError(
                f"{path}: has format {content['format']!r}, expected {FORMAT}; check it with the "
                "version of this program that wrote it"
            )
        entries = [
            ReleasedFile(str(f["path"]), str(f["kind"]), int(f["bytes"]), str(f["sha256"]))
            for f in content["files"]
        ]
    except FileNotFoundError:
        raise UserError(
            f"{path}: no such file; name the folder of a released dataset, or write a release "
            "with intercap release SETTINGS"
        ) from None
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise UserError(f"{path}: is not a manifest of a release ({error!r})") from None
    for entry in entries:
        pure = PurePosixPath(entry.path)
        if pure.is_absolute() or ".." in pure.parts or kind_of(pure) is None:
            raise UserError(f"{path}: lists {entry.path!r}, which is not a file of this dataset")
    return entries
