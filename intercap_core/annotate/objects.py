"""Contact surface and symmetry of an object, in objects.yaml and the files that it names.

Both belong to the object and therefore to all of its sequences.
"""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError
from scipy.spatial import cKDTree

from intercap_core.annotate import document
from intercap_core.entries import ObjectEntry, Symmetry
from intercap_core.errors import UserError
from intercap_core.geometry.rigid.contact_vertices import contact_list
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.mesh_files import file_vertices, load_mesh
from intercap_core.geometry.rigid.symmetry import SymmetryGroup
from intercap_core.project import Project, tidy
from intercap_core.validation import describe

_CHANGED = "{}: was changed by another annotator; reload the page"


def read_surface(project: Project, entry: ObjectEntry) -> dict[str, Any]:
    """Return the vertices of likely contact, which the user paints, and their file."""
    mesh = ObjectMesh.load(entry)
    ids = mesh.contact_vertices if entry.contact_vertices is not None else np.zeros(0, int)
    path = _vertex_list(entry)
    return {
        "vertices": ids.tolist(), "path": str(path), "digest": _digest(path),
        "sequences": _count_sequences(project, entry),
    }  # fmt: skip


def save_surface(
    project: Project, entry: ObjectEntry, vertices: list[int], digest: str
) -> dict[str, Any]:
    """Write the painted vertices by their numbers in the mesh file; name the list in objects.yaml.

    Raises UserError if the list changed since it was read, or no vertex is painted.
    """
    mesh, path = ObjectMesh.load(entry), _vertex_list(entry)
    painted = np.zeros(len(mesh.vertices), bool)
    ids = np.array(vertices, int) if vertices else np.zeros(0, int)
    if not len(ids) or ids.min() < 0 or ids.max() >= len(painted):
        raise UserError(f"object {entry.name!r}: paint at least one of its {len(painted)} vertices")
    painted[ids] = True
    if _digest(path) != digest:
        raise UserError(_CHANGED.format(path))
    in_file = file_vertices(Path(entry.mesh), load_mesh(Path(entry.mesh)))
    away, nearest = cKDTree(mesh.vertices).query(np.nan_to_num(in_file, nan=1e9))
    # loading merges equal vertices: each vertex of the file gets the paint of its merged vertex
    same = away <= 1e-6 * mesh.diameter
    chosen = np.flatnonzero(painted[nearest] & same)
    document.replace(path, json.dumps(contact_list(chosen, in_file)) + "\n")
    if entry.contact_vertices != path:
        objects = document.read(_file(project))
        relative = os.path.relpath(path, objects.path.parent)
        _save_entry(objects, entry, {"contact_vertices": relative})
    return read_surface(project, entry.model_copy(update={"contact_vertices": path}))


def _vertex_list(entry: ObjectEntry) -> Path:
    """Return the list that the entry names if it is JSON, else a file next to the mesh."""
    named = entry.contact_vertices
    if named is not None and named.suffix == ".json":
        return named
    return Path(entry.mesh).with_suffix(".contact.json")


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else document.NO_FILE


def read_symmetry(project: Project, entry: ObjectEntry) -> dict[str, Any]:
    """Return the object's symmetry and the digest of objects.yaml."""
    objects = document.read(_file(project))
    settings = objects.sections.get(entry.name) or {}
    return {
        "symmetry": settings.get("symmetry") or {}, "path": str(objects.path),
        "digest": objects.digest, "sequences": _count_sequences(project, entry),
    }  # fmt: skip


def save_symmetry(
    project: Project, entry: ObjectEntry, symmetry: dict[str, Any], digest: str
) -> dict[str, Any]:
    """Write the object's symmetry, {} for none, into objects.yaml.

    Raises UserError if the symmetry is invalid, or objects.yaml changed since it was read.
    """
    try:
        SymmetryGroup.from_settings(Symmetry.model_validate(symmetry))
    except ValidationError as error:
        fault = describe(error, Symmetry, f"object {entry.name!r}", "symmetry")[0]
        raise UserError(fault) from None
    except ValueError as error:
        fault = str(error).splitlines()[0][:200]
        raise UserError(f"object {entry.name!r}: symmetry is invalid ({fault})") from None
    objects = document.read(_file(project))
    if objects.problem:
        raise UserError(objects.problem)
    if objects.digest != digest:
        raise UserError(_CHANGED.format(objects.path))
    _save_entry(objects, entry, {"symmetry": symmetry or None})
    return read_symmetry(project, entry)


def _save_entry(objects: document.Document, entry: ObjectEntry, changes: dict[str, Any]) -> None:
    """Change settings of an object in objects.yaml; None removes a setting."""
    settings = {**objects.sections[entry.name], **changes}
    settings = {key: value for key, value in settings.items() if value is not None}
    document.save(objects, document.with_changes(objects, {entry.name: settings}))


def _count_sequences(project: Project, entry: ObjectEntry) -> int:
    return sum(row.object == entry.name for row in project.sequences.values())


def _file(project: Project) -> Path:
    return tidy(project.path.parent / project.config.objects)
