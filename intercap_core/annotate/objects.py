"""Contact surface and symmetry of an object, in the files that its entry in objects.yaml names.

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
from intercap_core.geometry.rigid.mesh_files import load_mesh
from intercap_core.geometry.rigid.symmetry import SymmetryGroup
from intercap_core.project import Project, tidy

_SAME = 1e-6  # vertices closer than this share of the object's diameter are equal


def read_surface(project: Project, entry: ObjectEntry) -> dict[str, Any]:
    """Return the painted vertices, the path of their list, and its digest."""
    mesh = ObjectMesh.load(entry)
    ids = mesh.contact_vertices if entry.contact_vertices is not None else np.zeros(0, int)
    users = [n for n, row in project.sequences.items() if row.object == entry.name]
    return {
        "vertices": ids.tolist(), "path": str(_list_of(entry)), "digest": _digest(_list_of(entry)),
        "sequences": len(users),
    }  # fmt: skip


def save_surface(
    project: Project, entry: ObjectEntry, vertices: list[int], digest: str
) -> dict[str, Any]:
    """Write the painted vertices by their numbers in the mesh file; name the list in objects.yaml.

    Raises UserError if the list changed since it was read, or no vertex is painted.
    """
    mesh, path = ObjectMesh.load(entry), _list_of(entry)
    painted = np.zeros(len(mesh.vertices), bool)
    ids = np.array(vertices, int) if vertices else np.zeros(0, int)
    if not len(ids) or ids.min() < 0 or ids.max() >= len(painted):
        raise UserError(f"object {entry.name!r}: paint at least one of its {len(painted)} vertices")
    painted[ids] = True
    if _digest(path) != digest:
        raise UserError(f"{path}: was changed by somebody else in the meantime; reload the page")
    in_file = np.asarray(load_mesh(Path(entry.mesh)).vertices, np.float64)
    away, nearest = cKDTree(mesh.vertices).query(np.nan_to_num(in_file, nan=1e9))
    chosen = np.flatnonzero(painted[nearest] & (away <= _SAME * mesh.diameter))
    text = json.dumps(contact_list(chosen, in_file)) + "\n"
    document.replace(path, text)
    if entry.contact_vertices != path:
        _name_list(project, entry, path)
    return read_surface(project, entry.model_copy(update={"contact_vertices": path}))


def _list_of(entry: ObjectEntry) -> Path:
    """Return the list that the entry names if it is JSON, else a file next to the mesh."""
    named = entry.contact_vertices
    if named is not None and named.suffix == ".json":
        return named
    return Path(entry.mesh).with_suffix(".contact.json")


def _name_list(project: Project, entry: ObjectEntry, path: Path) -> None:
    objects = tidy(project.path.parent / project.config.objects)
    found = document.read(objects)
    changed = dict(found.sections[entry.name])
    changed["contact_vertices"] = os.path.relpath(path, objects.parent)
    document.save(found, document.with_changes(found, {entry.name: changed}))


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else document.NO_FILE


def read_symmetry(project: Project, entry: ObjectEntry) -> dict[str, Any]:
    """Return the object's symmetry and the digest of objects.yaml."""
    found = document.read(_file(project))
    settings = found.sections.get(entry.name) or {}
    users = [n for n, row in project.sequences.items() if row.object == entry.name]
    return {
        "symmetry": settings.get("symmetry") or {}, "path": str(found.path), "digest": found.digest,
        "sequences": len(users),
    }  # fmt: skip


def save_symmetry(
    project: Project, entry: ObjectEntry, symmetry: dict[str, Any], digest: str
) -> dict[str, Any]:
    """Write the object's symmetry, {} for none, into objects.yaml.

    Raises UserError if the symmetry is invalid, or objects.yaml changed since it was read.
    """
    try:
        SymmetryGroup.from_settings(Symmetry.model_validate(symmetry))
    except (ValidationError, ValueError) as error:
        fault = str(error).splitlines()[0][:200]
        raise UserError(f"object {entry.name!r}: symmetry is invalid ({fault})") from None
    found = document.read(_file(project))
    if found.problem:
        raise UserError(found.problem)
    if found.digest != digest:
        raise UserError(
            f"{found.path}: was changed by somebody else in the meantime; reload the page"
        )
    own = {k: v for k, v in dict(found.sections[entry.name]).items() if k != "symmetry"}
    own |= {"symmetry": symmetry} if symmetry else {}
    document.save(found, document.with_changes(found, {entry.name: own}))
    return read_symmetry(project, entry)


def _file(project: Project) -> Path:
    return tidy(project.path.parent / project.config.objects)
