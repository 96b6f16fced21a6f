"""Close small holes of a mesh.

A hole is a loop of edges that belong to one face each. It gets a new vertex at its centre and a fan
of triangles to it. This suits nearly flat holes only, so holes wider than a limit are left open.
Vertices of the file keep their numbers, so that lists of contact vertices stay valid.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from intercap_core.errors import UserError
from intercap_core.geometry.rigid.mesh_files import get_colours, read_mesh

OUTPUT_SUFFIXES = (".ply", ".obj")


@dataclass(frozen=True)
class Hole:
    """One loop of open edges."""

    loop: np.ndarray
    """(n,) vertex indices, in the winding order of the missing faces."""
    width_m: float
    """Largest distance between two of its vertices."""
    middle: np.ndarray
    """(3,) mean of its vertices, metres in the mesh's frame."""
    bulge_m: float
    """RMS distance of its vertices from their plane."""

    def __str__(self) -> str:
        at = ", ".join(f"{value:.3f}" for value in self.middle)
        return (
            f"{len(self.loop)} edges, {1e3 * self.width_m:.1f} mm wide, "
            f"{1e3 * self.bulge_m:.1f} mm off its plane, at ({at}) m"
        )


@dataclass(frozen=True)
class Closed:
    """Result of :func:`close_mesh`."""

    closed: tuple[Hole, ...]
    """The holes, widest first."""
    strays: int
    """Number of open edges that form no loop."""
    faces_added: int
    """Number of new faces."""
    watertight: bool
    """Whether every edge of the result joins two faces."""


def close_mesh(source: Path, output: Path, *, widest_m: float | None, share: float) -> Closed:
    """Write ``source`` with its holes closed to ``output``.

    Vertices keep their order and new ones follow. Textures become vertex colours. Raises UserError
    if a hole is wider than the limit, if there is none, or if a file cannot be used.

    Args:
        source: mesh file.
        output: mesh file that must not exist.
        widest_m: closes holes up to this width; None = up to ``share`` of the object's length.
        share: see ``widest_m``.
    """
    if output.exists():
        raise UserError(f"{output}: exists, and is not written over; name another file")
    if output.suffix.lower() not in OUTPUT_SUFFIXES:
        raise UserError(f"{output}: expected a name that ends in {' or '.join(OUTPUT_SUFFIXES)}")
    mesh = read_mesh(source)
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    first_at = _first_at_place(vertices)
    faces = _with_consistent_winding(vertices, first_at, faces)
    holes, strays = find_holes(vertices, first_at[faces])
    if not holes:
        raise UserError(
            f"{source}: has no hole to close"
            + (f", but {strays} open edges that form no loop; use a remesher" if strays else "")
        )
    length = float(np.ptp(vertices[np.unique(faces)], axis=0).max())
    limit = share * length if widest_m is None else widest_m
    wide = [hole for hole in holes if hole.width_m > limit]
    if wide:
        raise UserError(_refusal(source, wide, limit, length))
    added = [  # a fan of faces from each hole's edges to its middle
        np.stack([hole.loop, np.roll(hole.loop, -1), np.full(len(hole.loop), middle)], axis=1)
        for middle, hole in enumerate(holes, len(vertices))
    ]
    middles = np.array([hole.middle for hole in holes])
    colours = get_colours(mesh)
    around = [colours[hole.loop].mean(0).round().astype(np.uint8) for hole in holes]
    result = trimesh.Trimesh(
        np.concatenate([vertices, middles]),
        np.concatenate([faces, *added]),
        vertex_colors=np.concatenate([colours, around]),
        process=False,
        validate=False,
    )
    _write(result, output)
    return Closed(tuple(holes), strays, sum(map(len, added)), _is_closed(first_at[faces], added))


def find_holes(vertices: np.ndarray, faces: np.ndarray) -> tuple[list[Hole], int]:
    """Return the holes of a mesh, widest first, and the number of open edges in no hole.

    Open edges, which belong to one face, are followed from vertex to vertex. A loop is a hole if a
    path reaches one of its own vertices again. Edges between faces of inconsistent winding, and
    chains of edges that do not close, form no hole.

    Args:
        vertices: (V, 3) metres.
        faces: (F, 3); coinciding vertices must have one index.
    """
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(1)]
    directed = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    _, first, count = np.unique(
        np.sort(directed, axis=1), axis=0, return_index=True, return_counts=True
    )
    # the missing face has the opposite winding
    edges = directed[first[count == 1]][:, ::-1]
    leaving: dict[int, list[int]] = defaultdict(list)
    for start, end in edges.tolist():
        leaving[start].append(end)
    holes, used = [], 0
    for start in sorted(leaving):
        path = [start]
        while leaving[path[-1]]:
            at = leaving[path[-1]].pop()
            if at not in path:
                path.append(at)
                continue
            # holes may touch at a vertex: the rest of the path is continued
            loop = path[path.index(at) :]
            path = path[: path.index(at) + 1]
            if len(loop) >= 3:
                holes.append(_hole(vertices, np.array(loop)))
                used += len(loop)
    holes.sort(key=lambda hole: -hole.width_m)
    return holes, len(edges) - used


def _hole(vertices: np.ndarray, loop: np.ndarray) -> Hole:
    """Measure the hole of a loop (n,) of vertex indices."""
    points = vertices[loop]
    middle = points.mean(0)
    width = max(np.linalg.norm(points - point, axis=1).max() for point in points)
    # smallest singular value: root of the summed squared distances from the plane
    across = np.linalg.svd(points - middle, compute_uv=False)[-1] if len(points) > 3 else 0.0
    return Hole(loop, float(width), middle, float(across / np.sqrt(len(points))))


def _with_consistent_winding(
    vertices: np.ndarray, first_at: np.ndarray, faces: np.ndarray
) -> np.ndarray:
    """Return faces (F, 3) with consistent winding."""
    joined = trimesh.Trimesh(vertices, first_at[faces], process=False, validate=False)
    if not joined.is_winding_consistent:
        trimesh.repair.fix_winding(joined)
    turned = (np.asarray(joined.faces) != first_at[faces]).any(1)
    return np.where(turned[:, None], faces[:, ::-1], faces)


def _first_at_place(vertices: np.ndarray) -> np.ndarray:
    """Return the index (V,) of the first vertex at the same position, to 0.1 micrometre."""
    _, first, inverse = np.unique(vertices.round(7), axis=0, return_index=True, return_inverse=True)
    return first[inverse.reshape(-1)]


def _is_closed(faces: np.ndarray, added: Sequence[np.ndarray]) -> bool:
    """Return whether every edge of the faces (F, 3) and of those added joins two faces."""
    whole = np.concatenate([faces[(faces != np.roll(faces, 1, axis=1)).all(1)], *added])
    edges = np.sort(whole[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return bool((np.unique(edges, axis=0, return_counts=True)[1] == 2).all())


def _refusal(source: Path, wide: Sequence[Hole], limit: float, length: float) -> str:
    """Return the message for holes wider than the limit; limit and length in metres."""
    listed = "; ".join(str(hole) for hole in wide[:4])
    more = f" and {len(wide) - 4} more" if len(wide) > 4 else ""
    return (
        f"{source}: {len(wide)} holes are wider than {1e3 * limit:.1f} mm (the object is "
        f"{1e3 * length:.0f} mm long): {listed}{more}; the shape of the missing surface is "
        "unknown, so nothing was written: scan or model it (MeshLab, Blender), or, if a flat cover "
        "is right, add "
        f"--widest-mm {np.ceil(1e3 * max(hole.width_m for hole in wide)):.0f}"
    )


def _write(mesh: trimesh.Trimesh, output: Path) -> None:
    """Write a mesh to a temporary file and rename it; raises UserError if that fails."""
    part = output.with_name(f".{output.stem}.part{output.suffix}")
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        mesh.export(part)
        part.replace(output)
    except OSError as error:
        raise UserError(
            f"{output}: cannot be written ({error.strerror}); name another file"
        ) from None
    finally:
        part.unlink(missing_ok=True)
