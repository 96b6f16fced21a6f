"""Motions that leave an object looking the same: the section ``symmetry`` of its entry in
objects.yaml, which all sequences that have it share.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import ValidationError

from intercap_core.annotate import document
from intercap_core.config import ObjectEntry, Symmetry
from intercap_core.errors import UserError
from intercap_core.geometry.rigid.symmetry import SymmetryGroup
from intercap_core.project import Project, tidy


def read_symmetry(project: Project, entry: ObjectEntry) -> dict[str, Any]:
    """The object's symmetry as objects.yaml has it, and the digest to save it by."""
    found = document.read(_file(project))
    told = found.sections.get(entry.name) or {}
    users = [n for n, row in project.sequences.items() if row.object == entry.name]
    return {
        "symmetry": told.get("symmetry") or {}, "path": str(found.path), "digest": found.digest,
        "sequences": len(users),
    }  # fmt: skip


def save_symmetry(
    project: Project, entry: ObjectEntry, symmetry: dict[str, Any], digest: str
) -> dict[str, Any]:
    """Write the object's symmetry, {} = none; the file's other lines stay.

    Raises UserError where it is impossible, or objects.yaml is another file than was read.
    """
    try:
        SymmetryGroup.from_settings(Symmetry.model_validate(symmetry))
    except (ValidationError, ValueError) as error:
        told = str(error).splitlines()[0][:200]
        raise UserError(f"object {entry.name!r}: symmetry is impossible ({told})") from None
    found = document.read(_file(project))
    if found.problem:
        raise UserError(found.problem)
    if found.digest != digest:
        raise UserError(
            f"{found.path}: was changed by somebody else meanwhile; load the page again"
        )
    own = {k: v for k, v in dict(found.sections[entry.name]).items() if k != "symmetry"}
    own |= {"symmetry": symmetry} if symmetry else {}
    document.save(found, document.with_changes(found, {entry.name: own}))
    return read_symmetry(project, entry)


def _file(project: Project) -> Path:
    return tidy(project.path.parent / project.config.objects)
