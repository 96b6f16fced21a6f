"""What ``intercap tables`` does."""

from __future__ import annotations

from dataclasses import dataclass
from dataclasses import replace as changed
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from intercap_core.config import Name
from intercap_core.errors import UserError
from intercap_core.tables import behave, intercap
from intercap_core.tables.project_files import write_project


@dataclass(frozen=True)
class Tables:
    """Files written, sequences listed, and what the user must know."""

    written: list[Path]
    sequences: int
    remarks: list[str]


def write_tables(
    layout: str,
    root: Path,
    output: Path,
    *,
    dataset: str | None,
    sources: intercap.Sources,
    objects: Path,
    replace: bool,
) -> Tables:
    """Write the project of a release into ``output``; see the layouts' modules.

    Raises UserError where the release is not as it must be, and where files are there that would
    be written over, unless ``replace``.
    """
    name = dataset or layout
    try:
        TypeAdapter(Name).validate_python(name)
    except ValidationError:
        raise UserError(
            f"--dataset is {name!r}: a name has letters, digits, _ and - only, and does not start "
            "with -"
        ) from None
    for path in (root, sources.calibrations, sources.annotations, sources.meshes, sources.results):
        if path is not None and not path.is_dir():
            raise UserError(f"{path}: there is no such folder; correct the path")
    if layout == "intercap":
        draft = intercap.draft(root, sources, dataset=name, objects=objects)
    elif layout == "behave":
        if changed(sources, results=None) != intercap.Sources():
            raise UserError(
                "layout 'behave' has calibration, meshes and detections in places of its own; "
                "leave out --calibrations, --annotations, --meshes, --keypoints and --candidates"
            )
        draft = behave.draft(root, dataset=name, results=sources.results)
    else:
        raise UserError(f"layout {layout!r} is not known, expected intercap or behave")
    written = write_project(draft, output, replace=replace)
    remarks = draft.remarks + [
        f"{row.columns['sequence']}: {remark}" for row in draft.rows for remark in row.remarks
    ]
    return Tables(written, len(draft.rows), remarks)
