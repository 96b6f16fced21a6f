"""Manifests: lists of everything that an output was made from, by which outputs are compared.

An artefact holds its manifest in an attribute, a folder in a file, so that results stay valid when
they are moved or copied. The same inputs give the same manifest, byte by byte.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from intercap_core import artefacts

LIBRARIES = (
    "numpy", "numba", "torch", "scipy", "open3d-cpu", "open3d", "opencv-python-headless", "libigl",
    "trimesh", "av", "onnxruntime", "onnxruntime-gpu",
)  # fmt: skip
OWN_LIBRARIES = {"metrics": ("mujoco",)}  # libraries that influence only the results of one stage
FILE = ".made_from.json"  # manifest of a folder, inside it
FORMAT = 1
DATASET_OUTPUTS = (
    "site/index.html", "summary.json", "heatmaps.h5", "tables", "README.md", "card.json",
    "datasheet.md", "croissant.json", "export",
)  # fmt: skip
_PAGES = "sequences"  # folder of the sequences' pages in the site
_NOT_COMPARED = ("machine", "outputs")
_MAX_CHANGES = 3  # changed values named in one reason
_MAX_VALUE_LENGTH = 60  # characters of a value in a reason


@dataclass(frozen=True)
class Manifest:
    """Everything that one output was made from."""

    stage: str
    """Stage, or "studio" or "dataset"."""
    sequence: str
    """Sequence; "" for outputs of all sequences."""
    given: Mapping[str, Any]
    """Settings, table entries and annotation, by the argument of the stage's ``run``."""
    files: Mapping[str, Mapping[str, str]]
    """Checksums of files, by argument and by the file's name without its folder."""
    artefacts: Mapping[str, str]
    """Fingerprint of each artefact that was read, by stage."""
    code: Mapping[str, str]
    """Digests of the code, by package."""
    libraries: Mapping[str, str]
    """Versions of the libraries that influence numerical results."""
    machine: Mapping[str, str] = field(default_factory=dict)
    """Device and processor; reported, not part of the fingerprint."""
    outputs: Mapping[str, str] = field(default_factory=dict)
    """Checksum and size of each file of a folder, by relative path; not part of the fingerprint."""

    @property
    def fingerprint(self) -> str:
        """Digest of what it was made from; equal for outputs that can replace each other."""
        compared = {
            name: value for name, value in asdict(self).items() if name not in _NOT_COMPARED
        }
        return hashlib.sha256(_json(compared).encode()).hexdigest()[:24]

    def to_text(self) -> str:
        """Serialize: a line with a checksum (HDF5 has none for long attributes), then JSON."""
        text = _json({"format": FORMAT, **asdict(self)})
        return f"{_checksum(text)}\n{text}"

    @classmethod
    def from_text(cls, text: str) -> Manifest | None:
        """Parse the text of :meth:`to_text`; None if it is damaged or has another version."""
        checksum, _, text = text.partition("\n")
        if checksum != _checksum(text):
            return None
        try:
            values = json.loads(text)
            if values.pop("format") != FORMAT:
                return None
            manifest = cls(**values)
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            return None
        maps = (
            manifest.given, manifest.files, manifest.artefacts, manifest.code, manifest.libraries,
            manifest.outputs,
        )  # fmt: skip
        return manifest if all(isinstance(entries, dict) for entries in maps) else None

    def differences(self, before: Manifest) -> list[str]:
        """Reasons why this manifest differs from the one ``before``, most specific first."""
        libraries = [
            f"{name} {before.libraries.get(name, 'none')} → {self.libraries.get(name, 'none')}"
            for name in _changed(before.libraries, self.libraries)
        ]
        code = _changed(before.code, self.code)
        return [
            *_changed_values(before.given, self.given),
            *_changed_files(before.files, self.files),
            *([f"code of {', '.join(code)}"] if code else []),
            *([f"library {', '.join(libraries)}"] if libraries else []),
            *_changed_artefacts(before.artefacts, self.artefacts),
        ]


def to_plain(value: Any) -> Any:
    """A value as JSON holds it, so that it equals the value that is read back."""
    return json.loads(_json(value))


def read_manifest(output: Path) -> Manifest | None:
    """The manifest of an artefact or folder; None if it has none or it cannot be read."""
    if not (output if output.suffix == ".h5" else output / FILE).is_file():  # a pipe would block
        return None
    if output.suffix == ".h5":
        with contextlib.suppress(artefacts.Unreadable):
            return Manifest.from_text(artefacts.made_from(output))
        return None
    with contextlib.suppress(OSError, ValueError):
        return Manifest.from_text((output / FILE).read_text(encoding="utf-8"))
    return None


def write_manifest(output: Path, manifest: Manifest) -> None:
    """Add the manifest to an artefact or folder that is otherwise complete.

    That of a folder lists its files.
    """
    if output.is_dir():
        part = output / f"{FILE}.part"
        listed = replace(manifest, outputs=_list_files(output, manifest.stage))
        part.write_text(listed.to_text(), encoding="utf-8")
        os.replace(part, output / FILE)
    else:
        artefacts.put_made_from(output, manifest.to_text())


def file_digest(path: Path) -> str:
    """SHA-256 of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _list_files(folder: Path, stage: str) -> dict[str, str]:
    """Checksum and size of the files that a stage wrote into ``folder``, without hidden ones.

    The folder of the dataset's outputs also holds those of all sequences, which are left out. Of
    several links to a file, one is read; none if the manifest of a sequence's export lists it.
    """
    tops, known = [folder], {}
    if stage == "dataset":
        tops = [folder / name for name in (*DATASET_OUTPUTS, "site")]
        known = _listed_links(folder)
    files = {}
    for top in tops:
        for path in [top] if top.is_file() else sorted(top.rglob("*")):
            name = path.relative_to(folder).as_posix()
            hidden = any(part.startswith(".") for part in Path(name).parts)
            if path.is_file() and not hidden and not name.startswith(f"site/{_PAGES}/"):
                status = path.stat()
                inode = (status.st_dev, status.st_ino)
                if inode not in known:
                    known[inode] = f"{file_digest(path)}:{status.st_size}"
                files[name] = known[inode]
    return files


def _listed_links(folder: Path) -> dict[tuple[int, int], str]:
    """Checksum and size by device and inode of the files of all exports that have several links."""
    known = {}
    for listed in folder.glob(f"*/export/{FILE}"):
        manifest = read_manifest(listed.parent)
        for name, value in manifest.outputs.items() if manifest is not None else ():
            with contextlib.suppress(OSError):  # missing; not linked either
                status = (listed.parent / name).stat()
                if status.st_nlink > 1:
                    known[status.st_dev, status.st_ino] = value
    return known


@cache
def library_versions(stage: str = "") -> dict[str, str]:
    """Versions of the installed ``LIBRARIES`` and those of a stage, without the build tag after "+"
    (torch)."""
    versions = {}
    for name in (*LIBRARIES, *OWN_LIBRARIES.get(stage, ())):
        with contextlib.suppress(PackageNotFoundError):
            versions[name] = version(name).partition("+")[0]
    return versions


@cache
def processor() -> str:
    """Model name of this machine's processor."""
    with (
        contextlib.suppress(OSError),
        open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file,
    ):
        for line in file:
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _checksum(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _json(value: Any) -> str:
    return json.dumps(value, sort_keys=True, default=str, separators=(",", ":"))


def _changed(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    return [name for name in sorted({*before, *now}) if before.get(name) != now.get(name)]


def _changed_artefacts(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Reasons in words for artefacts that changed, or that only one of two outputs read."""
    changed = ", ".join(name for name in _changed(before, now) if name in before and name in now)
    return [
        *([f"{changed} changed"] if changed else []),
        *(f"{name} is now read" for name in sorted(now.keys() - before.keys())),
        *(f"{name} is no longer read" for name in sorted(before.keys() - now.keys())),
    ]


def _changed_values(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Reasons in words for changed settings, table entries and annotations."""
    reasons = []
    for name in _changed(before, now):
        old, new = before.get(name), now.get(name)
        if isinstance(old, dict) and isinstance(new, dict):
            changes = [
                f"{key} {_short(old.get(key))} → {_short(new.get(key))}"
                for key in _changed(old, new)
            ]
            more = len(changes) - _MAX_CHANGES
            rest = f" and {more} more" if more > 0 else ""
            reasons.append(f"{_label(name)}: {', '.join(changes[:_MAX_CHANGES])}{rest}")
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
    text = "none" if value is None else value if isinstance(value, str) else _json(value)
    return text if len(text) <= _MAX_VALUE_LENGTH else f"{text[: _MAX_VALUE_LENGTH - 1]}…"


def _changed_files(
    before: Mapping[str, Mapping[str, str]], now: Mapping[str, Mapping[str, str]]
) -> list[str]:
    """Reasons in words for changed files, at most ``_MAX_CHANGES`` and their number."""
    reasons = []
    for role in sorted({*before, *now}):
        old, new = before.get(role, {}), now.get(role, {})
        for name in sorted({*old, *new}):
            if name not in old:
                reasons.append(f"{_label(role)}: {name} is new")
            elif name not in new or new[name] == "missing" != old[name]:
                reasons.append(f"{_label(role)}: {name} is gone")
            elif old[name] != new[name]:
                reasons.append(f"{_label(role)}: {name} has another content")
    if len(reasons) > _MAX_CHANGES:
        return [*reasons[:_MAX_CHANGES], f"{len(reasons)} files in all"]
    return reasons
