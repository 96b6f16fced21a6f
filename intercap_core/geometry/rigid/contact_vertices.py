"""Lists of the vertices of a mesh that people are likely to touch.

A file contains the vertex ids alone: JSON, .npz, or a pickle as InterCap released. A file as
:func:`contact_list` makes it (JSON or .npz) also contains the number of vertices and the digest of
the mesh. The digest detects that the mesh was replaced, even if all ids still exist.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.errors import UserError
from intercap_core.inputs.arrays import read_arrays, read_pickle
from intercap_core.inputs.documents import read_json
from intercap_core.inputs.files import UnreadableFile, printable, quoted

_IDS, _COUNT, _DIGEST = "contact_vertices", "mesh_vertices", "mesh_digest"


def contact_list(ids: Sequence[int] | np.ndarray, vertices: np.ndarray) -> dict[str, Any]:
    """Return the content of a list of ``ids`` (K,) chosen on a file's ``vertices`` (V, 3)."""
    return {
        _COUNT: len(vertices),
        _DIGEST: digest_vertices(vertices),
        _IDS: [int(vertex) for vertex in ids],
    }


def digest_vertices(vertices: np.ndarray) -> str:
    """Return the SHA-256 of a mesh file's vertices (V, 3), in order, in single precision."""
    return hashlib.sha256(np.ascontiguousarray(vertices, "<f4").tobytes()).hexdigest()


def read_contact_vertices(path: Path, mesh: Path, vertices: np.ndarray) -> np.ndarray:
    """Return the ids (K,) of likely-contact vertices listed in a file.

    Raises UserError that names the list if it is missing, no list of ids, or of another mesh.

    Args:
        path: the list.
        mesh: the mesh file.
        vertices: (V, 3) of the mesh file, metres.
    """
    values = _read(path)
    if isinstance(values, Mapping):
        _check_mesh(path, values, mesh, vertices)
        values = values.get(_IDS)
    if isinstance(values, set | frozenset):
        values = list(values)
    try:
        ids = np.asarray(values)
    except (ValueError, TypeError, OverflowError):
        ids = np.empty(0, object)
    whole = ids.dtype.kind in "iu" or (
        ids.dtype.kind == "f" and bool(np.isfinite(ids).all()) and np.array_equal(ids, ids.round())
    )
    if ids.ndim != 1 or len(ids) == 0 or not whole:
        raise UserError(f"{path}: not a list of vertex ids; write it as a JSON list [0, 1, ...]")
    if len(ids) == len(vertices) and ids.max() <= 1:
        raise UserError(
            f"{path}: is a mask of all {len(vertices)} vertices; write the ids of the marked ones"
        )
    if ids.min() < 0 or ids.max() >= len(vertices):
        outside = quoted(int(ids.max() if ids.max() >= len(vertices) else ids.min()))
        raise UserError(
            f"{path}: names vertex {outside}, the mesh has {len(vertices)}; the list belongs to "
            f"another mesh than {mesh}: choose the vertices again, or leave 'contact_vertices' out "
            "of objects.yaml"
        )
    return ids.astype(np.int64)


def _check_mesh(path: Path, values: Mapping[str, Any], mesh: Path, vertices: np.ndarray) -> None:
    """Raise UserError if the list states that it belongs to other vertices."""
    for key, actual in ((_COUNT, len(vertices)), (_DIGEST, digest_vertices(vertices))):
        expected = values.get(key)
        if expected is not None and str(expected) != str(actual):
            raise UserError(
                f"{path}: was chosen on a mesh with {key} {_shown(expected)}, {mesh} has {actual}; "
                "the mesh was changed after the list was made: choose the vertices again, or leave "
                "'contact_vertices' out of objects.yaml"
            )


def _shown(value: Any) -> str:
    return printable(str(value)[:80])


def _read(path: Path) -> Any:
    """Return the content of a list by its suffix: ids, or a mapping as of :func:`contact_list`."""
    if not path.is_file():
        raise UserError(
            f"{path}: there is no such list of contact vertices; correct 'contact_vertices' in "
            "objects.yaml or leave it out"
        )
    if path.suffix == ".pkl":
        return read_pickle(path)
    if path.suffix == ".npz":
        return _from_npz(path)
    try:
        return read_json(path)
    except UnreadableFile as error:
        raise UserError(
            f"{path}: not a JSON list of vertex ids ({error.reason}); write it as [0, 1, ...]"
        ) from None


def _from_npz(path: Path) -> Any:
    """Return the arrays of an .npz; without the name of the ids, its first array has the ids."""
    arrays = read_arrays(path, advice="save the .npz of vertex ids again")
    if not arrays:
        raise UserError(f"{path}: not a readable .npz of vertex ids (it is empty); save it again")
    return arrays if _IDS in arrays else {**arrays, _IDS: next(iter(arrays.values()))}
