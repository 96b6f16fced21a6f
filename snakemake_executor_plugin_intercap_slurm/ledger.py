"""Ledger of submitted Slurm jobs, so that a run can adopt the jobs of a killed one."""

from __future__ import annotations

import getpass
import hashlib
import json
import os
import uuid
from collections.abc import Collection, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

MARKS = "out_of_date"  # folder of the marks of stale outputs
Stamp = tuple[int, int]  # modification time in nanoseconds, and size


def run_name(prefix: str | None) -> str:
    """Slurm's job name for this folder and user, the same for every run."""
    place = f"{getpass.getuser()}:{Path.cwd().resolve()}"
    name = str(uuid.uuid5(uuid.NAMESPACE_URL, place))
    return f"{prefix}_{name}" if prefix else name


def stamp(path: str | os.PathLike[str]) -> Stamp | None:
    """Modification time and size of a file or folder; None if it does not exist."""
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size


def members(job: Any) -> list[Any]:
    """Jobs of a group in their order, or the single job."""
    return list(job) if job.is_group() else [job]


@dataclass(frozen=True)
class JobEntry:
    """A submitted job."""

    outputs: tuple[str, ...]
    """Files that it writes."""
    digest: str
    """Digest of its rules, parameters and inputs. A submitted job whose digest differs from the
    present one is outdated."""
    logs: dict[str, Stamp | None]
    """Stamps of its stages' logs before the submission, by path."""
    slurm_id: str = ""
    """Number of the Slurm job."""
    slurm_log: str = ""
    """Path of Slurm's log."""

    @classmethod
    def of(cls, job: Any) -> JobEntry:
        """Entry of a job before its submission, without the fields of Slurm."""
        parts = members(job)
        outputs = sorted({str(path) for part in parts for path in part.output})
        content = [
            [(part.rule.name, sorted(map(repr, part.params.items()))) for part in parts],
            sorted(
                (str(path), stamp(path))
                for path in job.input
                # each run rewrites its marks; the params contain the fingerprint behind a mark
                if str(path) not in outputs and MARKS not in Path(path).parts
            ),
        ]
        logs = {str(path): stamp(path) for part in parts for path in part.log}
        return cls(tuple(outputs), hashlib.sha256(repr(content).encode()).hexdigest(), logs)

    def submitted(self, slurm_id: str, slurm_log: str) -> JobEntry:
        """The entry after the submission."""
        return replace(self, slurm_id=slurm_id, slurm_log=slurm_log)


class Ledger:
    """Entries of a folder's jobs, each in the file ``<number of the Slurm job>.json``."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def write(self, entry: JobEntry) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        part = self._folder / f".{entry.slurm_id}.part"
        part.write_text(json.dumps(asdict(entry)), encoding="utf-8")
        part.replace(self._file(entry.slurm_id))

    def remove(self, slurm_id: str) -> None:
        self._file(slurm_id).unlink(missing_ok=True)

    def keep(self, live: Collection[str]) -> list[JobEntry]:
        """Remove the entries of jobs that are not in ``live``; returns the others."""
        kept = []
        for path in sorted(self._folder.glob("*.json")):
            if path.stem in live and (entry := _read(path)) is not None:
                kept.append(entry)
            else:
                path.unlink(missing_ok=True)
        return kept

    def _file(self, slurm_id: str) -> Path:
        return self._folder / f"{slurm_id}.json"


def by_outputs(entries: Iterable[JobEntry]) -> dict[tuple[str, ...], JobEntry]:
    return {entry.outputs: entry for entry in entries}


def _read(path: Path) -> JobEntry | None:
    """The entry in a file; None if the file is damaged."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        logs = {name: tuple(value) if value else None for name, value in values["logs"].items()}
        return JobEntry(**{**values, "outputs": tuple(values["outputs"]), "logs": logs})
    except (ValueError, TypeError, KeyError, AttributeError):
        return None
