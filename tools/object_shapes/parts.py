"""Solid primitives and the union of coloured parts into one watertight mesh."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold, Mesh, OpType

from intercap_core.geometry.rigid.surfaces import vertex_normals

Colour = tuple[int, int, int]
Rule = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(vertices (V, 3), normals (V, 3)) -> (V,) bool: which vertices are likely to be touched."""


@dataclass(frozen=True)
class Part:
    """One solid of one colour; ``touched`` says which of its vertices are likely contacts."""

    name: str
    solid: Manifold
    colour: Colour
    touched: bool | Rule = False


@dataclass(frozen=True)
class Built:
    """The union of parts: origin at the volume centroid, faces outward."""

    vertices: np.ndarray  # (V, 3) metres
    faces: np.ndarray  # (F, 3)
    colours: np.ndarray  # (V, 3) uint8
    contact_vertices: np.ndarray  # (K,) sorted vertex ids


def box(size: Sequence[float], centre: Sequence[float]) -> Manifold:
    """An axis-aligned box of edge lengths ``size`` around ``centre``."""
    return Manifold.cube(tuple(size), True).translate(tuple(centre))


def rounded_box(
    size: Sequence[float], centre: Sequence[float], radius: float, segments: int = 12
) -> Manifold:
    """A box with all edges rounded by ``radius``: the hull of eight spheres."""
    half = np.asarray(size) / 2 - radius
    ball = Manifold.sphere(radius, segments)
    corners = [
        ball.translate(tuple(half * (sx, sy, sz)))
        for sx in (-1, 1)
        for sy in (-1, 1)
        for sz in (-1, 1)
    ]
    return Manifold.batch_hull(corners).translate(tuple(centre))


def rod(
    start: Sequence[float],
    end: Sequence[float],
    radius: float,
    end_radius: float | None = None,
    segments: int = 12,
) -> Manifold:
    """A (tapered) cylinder between two points."""
    return tube([start, end], [radius, radius if end_radius is None else end_radius], segments)


def disc(
    centre: Sequence[float], axis: int, radius: float, width: float, segments: int = 24
) -> Manifold:
    """A cylinder of ``width`` along coordinate ``axis`` around ``centre``: a wheel, a button."""
    offset = np.zeros(3)
    offset[axis] = width / 2
    return rod(np.asarray(centre) - offset, np.asarray(centre) + offset, radius, segments=segments)


def tube(
    path: Sequence[Sequence[float]] | np.ndarray,
    radius: float | Sequence[float] | np.ndarray,
    segments: int = 12,
    *,
    closed: bool = False,
    flatten: float = 1.0,
    side: Sequence[float] | None = None,
) -> Manifold:
    """A ring swept along a polyline, capped at both ends unless ``closed``.

    Rings stand normal to the path. ``side`` fixes the ring's first axis (else it is transported
    along the path); the second axis is scaled by ``flatten``.
    """
    points = np.asarray(path, float)
    count = len(points)
    radii = np.broadcast_to(np.asarray(radius, float), count)
    if closed:
        tangents = np.roll(points, -1, 0) - np.roll(points, 1, 0)
    else:
        tangents = np.gradient(points, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    first = (
        np.asarray(side, float) if side is not None else np.eye(3)[np.argmin(np.abs(tangents[0]))]
    )
    angles = 2 * np.pi * (np.arange(segments) + 0.5) / segments
    rings = []
    for point, tangent, r in zip(points, tangents, radii, strict=True):
        u = np.asarray(side, float) if side is not None else first
        u = u - tangent * (u @ tangent)
        u /= np.linalg.norm(u)
        first = u
        v = np.cross(tangent, u) * flatten
        rings.append(point + r * (np.cos(angles)[:, None] * u + np.sin(angles)[:, None] * v))
    return rings_to_solid(np.array(rings), closed=closed)


def rings_to_solid(rings: np.ndarray, *, closed: bool = False) -> Manifold:
    """Rings (N, S, 3), each anticlockwise about the path's direction, to a closed solid."""
    count, segments, _ = rings.shape
    index = np.arange(count * segments).reshape(count, segments)
    nxt = np.roll(index, -1, axis=1)
    spans = count if closed else count - 1
    faces = []
    for i in range(spans):
        a, b = index[i], nxt[i]
        c, d = index[(i + 1) % count], nxt[(i + 1) % count]
        faces += [np.stack([a, b, d], 1), np.stack([a, d, c], 1)]
    vertices = rings.reshape(-1, 3)
    if not closed:
        for ring, flip in ((0, True), (count - 1, False)):
            centre = len(vertices)
            vertices = np.vstack([vertices, rings[ring].mean(0)])
            cap = np.stack([np.full(segments, centre), index[ring], nxt[ring]], 1)
            faces.append(cap[:, ::-1] if flip else cap)
    return solid_from(vertices, np.concatenate(faces))


def solid_from(vertices: np.ndarray, faces: np.ndarray) -> Manifold:
    """A watertight triangle mesh as a solid; raises ValueError when it is not one."""
    solid = Manifold(Mesh(np.asarray(vertices, np.float32), np.asarray(faces, np.uint32)))
    if solid.is_empty() or solid.volume() <= 0:
        raise ValueError(f"the mesh is no outward watertight solid: {solid.status()}")
    return solid


def revolve(profile: Sequence[Sequence[float]], segments: int = 32) -> Manifold:
    """The closed polygon (radius, height) turned about the z axis."""
    section = CrossSection([np.asarray(profile, float).tolist()])
    return Manifold.revolve(section, segments)


def plate(outline: np.ndarray, thickness: float, radius: float = 0.0, layers: int = 0) -> Manifold:
    """A polygon (N, 2) in x, y, corners rounded by ``radius``, from z = 0 to ``thickness``."""
    section = CrossSection([np.asarray(outline, float).tolist()])
    if radius:
        section = section.offset(-radius, JoinType.Round).offset(
            radius, JoinType.Round, circular_segments=24
        )
    return Manifold.extrude(section, thickness, layers)


def arc(
    centre: Sequence[float],
    radius: float,
    start_deg: float,
    end_deg: float,
    count: int,
    plane: tuple[int, int] = (0, 2),
) -> np.ndarray:
    """Points on a circle in the plane of two coordinate axes: (count, 3)."""
    angles = np.radians(np.linspace(start_deg, end_deg, count))
    points = np.tile(np.asarray(centre, float), (count, 1))
    points[:, plane[0]] += radius * np.cos(angles)
    points[:, plane[1]] += radius * np.sin(angles)
    return points


def union(parts: Sequence[Part], edge_length: float) -> Built:
    """All parts as one solid, edges no longer than ``edge_length`` metres.

    Every triangle remembers the part that it came from; a vertex takes the part that comes last
    in the list among its triangles' parts, so details are listed after the parts that carry them.
    """
    originals = [part.solid.as_original() for part in parts]
    ids = [solid.original_id() for solid in originals]
    solid = Manifold.batch_boolean(originals, OpType.Add)
    solid = solid.simplify(1e-5).refine_to_length(edge_length)
    if len(solid.decompose()) != 1:
        raise ValueError("the parts do not touch each other")
    mesh = solid.to_mesh64()
    vertices = np.asarray(mesh.vert_properties, float)[:, :3]
    faces = np.asarray(mesh.tri_verts, np.int64)
    part_of_face = np.zeros(len(faces), int)
    for begin, end, original in zip(
        mesh.run_index[:-1], mesh.run_index[1:], mesh.run_original_id, strict=True
    ):
        part_of_face[begin // 3 : end // 3] = ids.index(original)
    vertices, faces = _merge(vertices, faces, mesh)
    part_of_vertex = np.zeros(len(vertices), int)
    np.maximum.at(part_of_vertex, faces.ravel(), np.repeat(part_of_face, 3))

    normals = vertex_normals(vertices, faces)
    touched = np.zeros(len(vertices), bool)
    for number, part in enumerate(parts):
        mine = part_of_vertex == number
        rule = part.touched
        touched |= mine & (rule if isinstance(rule, bool) else rule(vertices, normals))
    colours = np.array([part.colour for part in parts], np.uint8)[part_of_vertex]
    return Built(vertices - _centroid(vertices, faces), faces, colours, np.flatnonzero(touched))


def _merge(vertices: np.ndarray, faces: np.ndarray, mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Join the duplicates that the solid lists along borders between parts."""
    target = np.arange(len(vertices))
    target[np.asarray(mesh.merge_from_vert, int)] = np.asarray(mesh.merge_to_vert, int)
    used, faces = np.unique(target[faces], return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


def _centroid(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Centre of mass of the solid at uniform density: tetrahedra from the origin."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    volumes = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6
    return (volumes[:, None] * (a + b + c) / 4).sum(0) / volumes.sum()


def ring_stack(
    heights: np.ndarray, radii: np.ndarray, *, lobes: int, depth: float, twist_deg: float
) -> Manifold:
    """Star-shaped rings of ``lobes`` pleats, turned along z like a furled canopy."""
    segments = 4 * lobes
    angles = 2 * np.pi * np.arange(segments) / segments
    twist = np.radians(twist_deg) * np.linspace(0, 1, len(heights))
    rings = []
    for height, radius, turn in zip(heights, radii, twist, strict=True):
        r = radius * (1 - depth * (0.5 - 0.5 * np.cos(lobes * angles)))
        rings.append(
            np.stack(
                [r * np.cos(angles + turn), r * np.sin(angles + turn), np.full(segments, height)], 1
            )
        )
    return rings_to_solid(np.array(rings))
