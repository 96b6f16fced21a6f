"""Write a project's settings, tables and annotations for existing recordings."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.inputs.documents import dump_yaml

COLUMNS = (
    "sequence", "subject", "object", "layout", "recordings", "calibration", "keypoints",
    "candidates", "results", "truth", "annotation",
)  # fmt: skip
REQUIRED = [name for name, info in SequenceEntry.model_fields.items() if info.is_required()]


@dataclass(frozen=True)
class Sources:
    """Folders outside of that of the recordings.

    None = searched for near the recordings; results are optional.
    """

    calibrations: Path | None = None
    """Holds ``calibration_first``, ``calibration_second`` and ``calibration_third``."""
    annotations: Path | None = None
    """Holds a folder for each sequence."""
    meshes: Path | None = None
    """Holds ``01.ply``, ``02.ply``, ..."""
    keypoints: Path | None = None
    """Holds a folder for each sequence."""
    candidates: Path | None = None
    """Holds a folder for each sequence."""
    results: Path | None = None
    """The release's own results, a folder for each sequence."""


@dataclass
class Row:
    """One sequence of the table."""

    columns: dict[str, str | Path]
    """Cells by column."""
    remarks: list[str] = field(default_factory=list)
    """Comments above the row."""
    cameras: list[str] = field(default_factory=list)
    """Names of the cameras, as far as they are known."""


@dataclass
class Draft:
    """Content of a project's files."""

    dataset: str
    """Name of the project."""
    rows: list[Row] = field(default_factory=list)
    """The sequences."""
    subjects: dict[str, str] = field(default_factory=dict)
    """Gender by subject."""
    subject_remarks: list[str] = field(default_factory=list)
    """Comments of subjects.tsv."""
    objects: Path | dict[str, dict[str, Any]] = field(default_factory=dict)
    """An existing objects.yaml, or entries whose ``mesh`` and ``contact_vertices`` are paths."""
    annotations: dict[str, str] = field(default_factory=dict)
    """Text by path below the folder of annotations."""
    remarks: list[str] = field(default_factory=list)
    """Comments of config.yaml, which are also shown to the user."""

    def all_remarks(self) -> list[str]:
        """Remarks on the project, then those on each sequence with its name."""
        of_rows = [
            f"{row.columns['sequence']}: {text}" for row in self.rows for text in row.remarks
        ]
        of_subjects = [f"subjects.tsv: {text}" for text in self.subject_remarks]
        return self.remarks + of_subjects + of_rows


def write_project(draft: Draft, folder: Path, *, replace: bool) -> list[Path]:
    """Write config.yaml and the files that it names into ``folder``; returns their paths.

    Paths are written relative to the file that holds them. Raises UserError, before anything is
    written, if a file exists and ``replace`` is False, or if a path holds a tab or a line break.
    """
    files = {
        "config.yaml": _config(draft, folder),
        "sequences.tsv": _sequences(draft.rows, folder),
        "subjects.tsv": _subjects(draft),
    }
    if not isinstance(draft.objects, Path):
        files["objects.yaml"] = _objects(draft.objects, folder)
    files |= {f"annotations/{path}": text for path, text in draft.annotations.items()}
    existing = [folder / name for name in files if os.path.lexists(folder / name)]
    if existing and not replace:
        more = f" (and {len(existing) - 1} more)" if len(existing) > 1 else ""
        raise UserError(
            f"{existing[0]}: exists already{more}, so nothing was written; name another output "
            "folder, or add --replace to overwrite these files"
        )
    written = []
    try:
        for name, text in files.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
            written.append(path)
    except OSError as error:
        raise UserError(
            f"{path}: cannot be written ({error.strerror}); name another output folder"
        ) from None
    return written


def _config(draft: Draft, folder: Path) -> str:
    lines = [f"# {remark}" for remark in draft.remarks]
    objects = draft.objects if isinstance(draft.objects, Path) else folder / "objects.yaml"
    settings = {"dataset": draft.dataset, "objects": _relative(objects, folder)}
    return "\n".join([*lines, dump_yaml(settings)])


def _sequences(rows: list[Row], folder: Path) -> str:
    used = [
        name for name in COLUMNS if name in REQUIRED or any(row.columns.get(name) for row in rows)
    ]
    lines = []
    for row in rows:
        lines += [f"# {remark}" for remark in row.remarks]
        lines.append("\t".join(_cell(row.columns.get(name, ""), folder) for name in used))
    return "\n".join(["\t".join(used), *lines, ""])


def _cell(value: str | Path, folder: Path) -> str:
    text = _relative(value, folder) if isinstance(value, Path) else value
    if any(character in text for character in "\t\r\n"):
        raise UserError(
            f"{text!r}: a path with a tab or a line break cannot stand in a table; rename it"
        )
    return text


def _subjects(draft: Draft) -> str:
    lines = [f"# {remark}" for remark in draft.subject_remarks]
    lines.append("subject\tgender\theight")
    lines += [f"{name}\t{gender}\t" for name, gender in sorted(draft.subjects.items())]
    return "\n".join([*lines, ""])


def _objects(entries: dict[str, dict[str, Any]], folder: Path) -> str:
    written = {
        name: {
            key: _relative(value, folder) if isinstance(value, Path) else value
            for key, value in entry.items()
        }
        for name, entry in entries.items()
    }
    return dump_yaml(written)


def _relative(path: Path, folder: Path) -> str:
    # As the loader joins them: by text, so that links stay links.
    return os.path.relpath(os.path.abspath(path), os.path.abspath(folder))
