"""What an output was made from, kept with it: the one thing that decides on making it again.

Wherever results lie, each says which settings, tables, annotation, files, code, libraries and
earlier artefacts it was made from. An artefact has its record in an attribute, a folder in a file.
The same inputs give the same record, so the same bytes.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from intercap_core import artefacts
from intercap_core.errors import UserError

LIBRARIES = (
    "numpy", "numba", "torch", "scipy", "open3d-cpu", "open3d", "opencv-python-headless", "libigl",
    "trimesh", "av", "onnxruntime", "onnxruntime-gpu",
)  # fmt: skip
FILE = ".made_from.json"  # beside what a folder holds
FORMAT = 1
_TOLD = 3  # values that differ, named in one reason
_WIDEST = 60  # characters of a value in a reason


@dataclass(frozen=True)
class Record:
    """What one output was made from.

    ``given``: settings, table entries and annotation by the name that the stage has for them;
    ``files``: digests of files by the same names and the file's own; ``artefacts``: identity of
    each artefact that was read; ``code``: digests by room; ``libraries``: versions of those that
    decide numbers. ``machine`` says on what it was computed, which another machine may do as well:
    it is told and decides nothing.
    """

    stage: str
    sequence: str
    given: Mapping[str, Any]
    files: Mapping[str, Mapping[str, str]]
    artefacts: Mapping[str, str]
    code: Mapping[str, str]
    libraries: Mapping[str, str]
    machine: Mapping[str, str] = field(default_factory=dict)

    @property
    def identity(self) -> str:
        """Digest of all but the machine: equal records, results as good as each other."""
        told = {name: value for name, value in asdict(self).items() if name != "machine"}
        return hashlib.sha256(_text(told).encode()).hexdigest()[:24]

    def to_text(self) -> str:
        """A line of its own digest (HDF5 has no checksum for long attributes), and JSON; equal
        records, equal text."""
        text = _text({"format": FORMAT, **asdict(self)})
        return f"{_sum(text)}\n{text}"

    @classmethod
    def from_text(cls, text: str) -> Record | None:
        """None where the text is damaged, or no record of this version."""
        said, _, text = text.partition("\n")
        if said != _sum(text):
            return None
        try:
            told = json.loads(text)
            if told.pop("format") != FORMAT:
                return None
            record = cls(**told)
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            return None
        maps = (record.given, record.files, record.artefacts, record.code, record.libraries)
        return record if all(isinstance(one, dict) for one in maps) else None

    def differences(self, before: Record) -> list[str]:
        """What is other than it was ``before``, in words, most telling first; empty of none."""
        return [
            *_given(before.given, self.given),
            *_files(before.files, self.files),
            *_named("code of", before.code, self.code, values=False),
            *_named("library", before.libraries, self.libraries, values=True),
            *_earlier(before.artefacts, self.artefacts),
        ]


def plain(value: Any) -> Any:
    """A value as JSON has it, so that it compares equal to what is read back."""
    return json.loads(_text(value))


def read_record(output: Path) -> Record | None:
    """The record of an artefact or folder; None where there is none that can be read."""
    if output.suffix == ".h5":
        with contextlib.suppress(artefacts.Unreadable):
            return Record.from_text(artefacts.made_from(output))
        return None
    with contextlib.suppress(OSError, ValueError):
        return Record.from_text((output / FILE).read_text(encoding="utf-8"))
    return None


def add_record(output: Path, record: Record) -> None:
    """Put the record into an artefact or a folder that is complete but for it."""
    if output.is_dir():
        part = output / f"{FILE}.part"
        part.write_text(record.to_text(), encoding="utf-8")
        os.replace(part, output / FILE)
    else:
        artefacts.put_made_from(output, record.to_text())


@cache
def libraries() -> dict[str, str]:
    """Versions of the libraries that decide numbers; which build of torch it is does not count."""
    found = {}
    for name in LIBRARIES:
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name).partition("+")[0]
    return found


@cache
def processor() -> str:
    """The kind of this machine's processor, as it calls itself."""
    with (
        contextlib.suppress(OSError),
        open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file,
    ):
        for line in file:
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def check_sequence(output: Path, record: Record | None, sequence: str) -> None:
    """Raise UserError where a record says that the output is of another sequence."""
    if record is not None and record.sequence != sequence:
        raise UserError(
            f"{output}: holds sequence {record.sequence!r}, expected {sequence!r}; delete it and "
            f"re-run stage {record.stage!r} for sequence {sequence!r}"
        )


def _sum(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _text(value: Any) -> str:
    return json.dumps(value, sort_keys=True, default=str, separators=(",", ":"))


def _given(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    reasons = []
    for name in sorted({*before, *now}):
        old, new = before.get(name), now.get(name)
        if old == new:
            continue
        if isinstance(old, dict) and isinstance(new, dict):
            keys = [key for key in sorted({*old, *new}) if old.get(key) != new.get(key)]
            changes = [f"{key} {_short(old.get(key))} → {_short(new.get(key))}" for key in keys]
            more = f" and {len(changes) - _TOLD} more" if len(changes) > _TOLD else ""
            reasons.append(f"{_label(name)}: {', '.join(changes[:_TOLD])}{more}")
        else:
            reasons.append(f"{_label(name)}: {_short(old)} → {_short(new)}")
    return reasons


_LABELS = {
    "settings": "settings",
    "joint": "settings of joint",
    "body_fit": "settings of body_fit",
    "object_track": "settings of object_track",
    "object_": "object's entry",
    "subject": "subject's entry",
    "sequence": "row of the table",
    "frames_to_drop": "annotation, drop_frames",
    "floor": "annotation, floor",
    "starts": "annotation, starts",
    "poses": "annotation, object_poses",
    "contact": "annotation, contact",
    "subject_points": "annotation, subject",
    "left_right": "annotation, left_right",
}


def _label(name: str) -> str:
    return _LABELS.get(name, name.replace("_", " "))


def _short(value: Any) -> str:
    text = "none" if value is None else value if isinstance(value, str) else _text(value)
    return text if len(text) <= _WIDEST else f"{text[: _WIDEST - 1]}…"


def _files(
    before: Mapping[str, Mapping[str, str]], now: Mapping[str, Mapping[str, str]]
) -> list[str]:
    reasons = []
    for role in sorted({*before, *now}):
        old, new = before.get(role, {}), now.get(role, {})
        for name in sorted({*old, *new}):
            if name not in old:
                reasons.append(f"{_label(role)}: {name} is new")
            elif name not in new or new[name] == "missing":
                reasons.append(f"{_label(role)}: {name} is gone")
            elif old[name] != new[name]:
                reasons.append(f"{_label(role)}: {name} has another content")
    return reasons if len(reasons) <= _TOLD else [*reasons[:_TOLD], f"{len(reasons)} files in all"]


def _named(
    what: str, before: Mapping[str, str], now: Mapping[str, str], *, values: bool
) -> list[str]:
    names = [name for name in sorted({*before, *now}) if before.get(name) != now.get(name)]
    if not names:
        return []
    if values:
        names = [f"{name} {before.get(name, 'none')} → {now.get(name, 'none')}" for name in names]
    return [f"{what} {', '.join(names)}"]


def _earlier(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    names = [name for name in sorted({*before, *now}) if before.get(name) != now.get(name)]
    return [f"{', '.join(names)} made anew"] if names else []
