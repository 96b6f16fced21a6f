"""Holes of a mesh closed, where covering them is honest: small beside the object.

A hole is a loop of edges of one face each. It gets a new vertex at its middle and a fan of
triangles to it: right for what is nearly flat, a guess for anything else, so that holes wider than
a stated width are left alone. Vertices of the file keep their numbers, lists of contact vertices
stay right.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from intercap_core.errors import UserError
from intercap_core.geometry.rigid.mesh_files import colours_of, read_mesh

SAME_PLACE_DECIMALS = 7  # vertices nearer than 0.1 micrometre are one, as the stages join them
WRITTEN = (".ply", ".obj")


@dataclass(frozen=True)
class Hole:
    """One loop of open edges: the numbers of its vertices (n,), in the order of the missing faces.

    ``width_m`` between its farthest vertices, ``middle`` (3,) metres in the mesh's frame,
    ``bulge_m`` how far its vertices stand off its own plane, RMS.
    """

    loop: np.ndarray
    width_m: float
    middle: np.ndarray
    bulge_m: float

    def __str__(self) -> str:
        at = ", ".join(f"{value:.3f}" for value in self.middle)
        return (
            f"{len(self.loop)} edges, {1e3 * self.width_m:.1f} mm wide, "
            f"{1e3 * self.bulge_m:.1f} mm off its plane, at ({at}) m"
        )


@dataclass(frozen=True)
class Closed:
    """What became of a mesh's holes; ``strays`` are open edges that form no loop of their own."""

    closed: tuple[Hole, ...]
    strays: int
    faces_added: int
    watertight: bool


def close_mesh(source: Path, output: Path, *, widest_m: float | None, share: float) -> Closed:
    """Write ``source`` with its holes closed to ``output``, which must not exist.

    Holes up to ``widest_m``, metres, are closed; None = up to ``share`` of the object's length.
    Vertices stay, in order; the new ones follow. Textures become colours of vertices. Raises
    UserError where a hole is wider, where there is none, and where the files cannot be used.
    """
    if output.exists():
        raise UserError(f"{output}: exists, and is not written over; name another file")
    if output.suffix.lower() not in WRITTEN:
        raise UserError(f"{output}: expected a name that ends in {' or '.join(WRITTEN)}")
    mesh = read_mesh(source)
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    one = _one_of_place(vertices)
    faces = _wound_alike(vertices, one, faces)
    holes, strays = find_holes(vertices, one[faces])
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
    added = [_fan(hole, len(vertices) + k) for k, hole in enumerate(holes)]
    middles = np.array([hole.middle for hole in holes])
    colours = colours_of(mesh)
    around = [colours[hole.loop].mean(0).round().astype(np.uint8) for hole in holes]
    result = trimesh.Trimesh(
        np.concatenate([vertices, middles]),
        np.concatenate([faces, *added]),
        vertex_colors=np.concatenate([colours, around]),
        process=False,
        validate=False,
    )
    _write(result, output)
    return Closed(tuple(holes), strays, sum(map(len, added)), _is_closed(one[faces], added))


def find_holes(vertices: np.ndarray, faces: np.ndarray) -> tuple[list[Hole], int]:
    """Holes of a mesh (V, 3) and (F, 3), widest first, and the open edges that are in none.

    Vertices of one place must have one number. Edges around which faces look different ways, or
    that end where no other begins, are in none.
    """
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(1)]
    directed = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    _, first, count = np.unique(
        np.sort(directed, axis=1), axis=0, return_index=True, return_counts=True
    )
    # the missing face would run along its edges the other way
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
            loop = path[path.index(at) :]  # a hole that touches another ends where it was met
            path = path[: path.index(at) + 1]
            if len(loop) >= 3:
                holes.append(_hole(vertices, np.array(loop)))
                used += len(loop)
    holes.sort(key=lambda hole: -hole.width_m)
    return holes, len(edges) - used


def _hole(vertices: np.ndarray, loop: np.ndarray) -> Hole:
    points = vertices[loop]
    middle = points.mean(0)
    width = max(np.linalg.norm(points - point, axis=1).max() for point in points)
    across = np.linalg.svd(points - middle, compute_uv=False)[-1] if len(points) > 3 else 0.0
    return Hole(loop, float(width), middle, float(across / np.sqrt(len(points))))


def _fan(hole: Hole, middle: int) -> np.ndarray:
    """Faces (n, 3) from each edge of the hole to its ``middle``'s number."""
    following = np.roll(hole.loop, -1)
    return np.stack([hole.loop, following, np.full(len(hole.loop), middle)], axis=1)


def _wound_alike(vertices: np.ndarray, one: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The faces (F, 3), turned where neighbours look different ways."""
    joined = trimesh.Trimesh(vertices, one[faces], process=False, validate=False)
    if not joined.is_winding_consistent:
        trimesh.repair.fix_winding(joined)
    turned = (np.asarray(joined.faces) != one[faces]).any(1)
    return np.where(turned[:, None], faces[:, ::-1], faces)


def _one_of_place(vertices: np.ndarray) -> np.ndarray:
    """The first vertex (V,) at each vertex's place."""
    _, first, inverse = np.unique(
        vertices.round(SAME_PLACE_DECIMALS), axis=0, return_index=True, return_inverse=True
    )
    return first[inverse.reshape(-1)]


def _is_closed(faces: np.ndarray, added: Sequence[np.ndarray]) -> bool:
    whole = np.concatenate([faces[(faces != np.roll(faces, 1, axis=1)).all(1)], *added])
    edges = np.sort(whole[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return bool((np.unique(edges, axis=0, return_counts=True)[1] == 2).all())


def _refusal(source: Path, wide: Sequence[Hole], limit: float, length: float) -> str:
    told = "; ".join(str(hole) for hole in wide[:4])
    more = f" and {len(wide) - 4} more" if len(wide) > 4 else ""
    return (
        f"{source}: {len(wide)} holes are wider than {1e3 * limit:.1f} mm (the object is "
        f"{1e3 * length:.0f} mm long): {told}{more}; nobody knows what surface is there, so "
        "nothing was written: scan or model it (MeshLab, Blender), or, where a flat cover is "
        "right, say "
        f"--widest-mm {np.ceil(1e3 * max(hole.width_m for hole in wide)):.0f}"
    )


def _write(mesh: trimesh.Trimesh, output: Path) -> None:
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
