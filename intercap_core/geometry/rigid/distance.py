"""Queries of a triangle mesh by Embree: distances, and inside or outside.

Queries use Open3D's RaycastingScene (Embree). The search tree is built once in the mesh's own
frame, so callers transform query points of a moving object into that frame.

A point is inside a closed mesh if a ray from it crosses the surface an odd number of times. For a
surface with holes this fails, since a ray may leave through a hole. There a point is inside if its
generalised winding number exceeds a half (Jacobson et al. 2013, by the hierarchy of Barill et al.
2018). The depth of such a point is limited by its distance to the convex hull, because the surface
is missing at the holes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import igl
import numpy as np

from intercap_core.geometry.rigid.open3d_core import o3d

# Directions of rays whose crossings are counted. A point is outside if the first ray has an even
# number of crossings (no error on 10,000 points). Else all five vote, since a ray may pass along an
# edge. The directions are oblique to the coordinate planes, to which faces of modelled objects are
# often parallel.
_DIRECTIONS = np.array(
    [[0.83, 0.31, 0.46], [-0.39, 0.77, 0.51], [0.27, -0.43, 0.86], [-0.57, -0.61, -0.55],
     [0.41, 0.53, -0.74]]
)  # fmt: skip


@dataclass(frozen=True)
class Closest:
    """The nearest surface point of each query."""

    points: np.ndarray
    """(N, 3) metres."""
    faces: np.ndarray
    """(N,) int32 indices."""
    barycentric: np.ndarray
    """(N, 3) weights of the face's corners."""
    normals: np.ndarray
    """(N, 3) outward unit normals of the faces."""


class DistanceField:
    """Signed distance to a triangle mesh, negative inside the solid; a cup's hollow is outside.

    Queries are in the mesh's frame. Arrays are float64, but computed in float32 with errors up to
    1e-6 of the coordinates' size.

    Attributes:
        box: (2, 3) smallest and largest coordinates, metres.

    Args:
        vertices: (V, 3) metres.
        faces: (F, 3), wound outward.
        watertight: the mesh is closed, so rays decide inside and outside; else winding numbers.
        threads: 0 = all cores; the result does not depend on it.
    """

    def __init__(
        self, vertices: np.ndarray, faces: np.ndarray, *, watertight: bool = True, threads: int = 0
    ) -> None:
        vertices = np.ascontiguousarray(vertices, np.float32)
        faces = np.ascontiguousarray(faces, np.uint32)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
            raise ValueError(f"vertices {vertices.shape} and faces {faces.shape} are no mesh")
        self.box = np.array([vertices.min(0), vertices.max(0)], np.float64)
        self._scene = build_scene(vertices, faces, threads)
        self._open = None if watertight else _OpenSurface(vertices, faces, threads)

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance (N,) of points (N, 3) to the surface, metres, negative inside.

        For points inside an open surface it is that to :meth:`boundary`.
        """
        if self._open is not None:
            inside, closest = self.boundary(points)
            distance = np.linalg.norm(np.reshape(points, (-1, 3)) - closest.points, axis=1)
        else:
            inside, distance = self.inside(points), self.distance(points)
        return np.where(inside, -distance, distance)

    def boundary(self, points: np.ndarray) -> tuple[np.ndarray, Closest]:
        """Return which points (N, 3) are inside, and the closest point of the solid's boundary.

        The boundary is the surface. For points inside an open surface it is the convex hull if that
        is closer, so that no depth exceeds the object's thickness. Faces and barycentric weights
        always belong to the surface.
        """
        inside, closest = self.inside(points), self.closest(points)
        if self._open is not None and inside.any():
            closest = self._open.nearer(np.reshape(points, (-1, 3)), inside, closest)
        return inside, closest

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance (N,) of points (N, 3) to the surface, metres, never negative."""
        query = o3d.core.Tensor.from_numpy(np.ascontiguousarray(points, np.float32).reshape(-1, 3))
        return self._scene.compute_distance(query).numpy().astype(np.float64)

    def met(self, start: np.ndarray, ahead: np.ndarray) -> np.ndarray:
        """Return whether rays from ``start`` (N, 3) along ``ahead`` (N, 3) hit the surface (N,)."""
        rays = o3d.core.Tensor.from_numpy(np.concatenate([start, ahead], 1).astype(np.float32))
        return self._scene.test_occlusions(rays).numpy()

    def first_hit(self, start: np.ndarray, ahead: np.ndarray) -> np.ndarray:
        """Return the length (N,) of rays from ``start`` (N, 3) along unit vectors to the surface.

        Metres; infinite if a ray hits nothing.
        """
        rays = o3d.core.Tensor.from_numpy(np.concatenate([start, ahead], 1).astype(np.float32))
        return self._scene.cast_rays(rays)["t_hit"].numpy().astype(np.float64)

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Return whether points (N, 3) are inside the solid: (N,) bool.

        In a watertight mesh, points outside of the bounding box need no ray, and most others one.
        If its number of crossings is odd, the majority of five rays decides: a ray through an edge
        may count it twice or not at all.
        """
        query = np.asarray(points, np.float32).reshape(-1, 3)
        if self._open is not None:
            return self._open.inside(query)
        low, high = self.box.astype(np.float32)
        asked = np.flatnonzero(((query >= low) & (query <= high)).all(1))
        asked = asked[self._odd(query[asked], _DIRECTIONS[0])]
        votes = np.zeros(len(query), int)
        for direction in _DIRECTIONS:
            votes[asked] += self._odd(query[asked], direction)
        return 2 * votes > len(_DIRECTIONS)

    def _odd(self, query: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return whether rays from points (N, 3) cross the surface an odd number of times."""
        towards = np.broadcast_to(direction.astype(np.float32), query.shape)
        rays = o3d.core.Tensor.from_numpy(np.concatenate([query, towards], 1))
        return self._scene.count_intersections(rays).numpy() % 2 == 1

    def closest(self, points: np.ndarray) -> Closest:
        """Return the closest surface points of points (N, 3)."""
        return _closest(self._scene, points)


class SurfacePart:
    """Distances to a part of a mesh's surface.

    The part consists of the faces whose corners are all among the vertices ``part``, and of all
    faces around a vertex of ``part`` that has no such face.

    Args:
        whole: field of the whole mesh, which decides what is inside the object.
        vertices: (V, 3) metres.
        faces: (F, 3)
        part: (K,) vertex indices.
    """

    def __init__(
        self, whole: DistanceField, vertices: np.ndarray, faces: np.ndarray, part: np.ndarray
    ) -> None:
        corners = np.isin(faces, part)
        spanned = corners.all(axis=1)
        alone = np.setdiff1d(part, faces[spanned])
        spanned |= np.isin(faces, alone).any(axis=1)
        if not spanned.any():
            raise ValueError(f"vertices {part.tolist()} are corners of no face")
        self._whole, self.box = whole, whole.box
        self._scene = build_scene(
            np.ascontiguousarray(vertices, np.float32),
            np.ascontiguousarray(faces[spanned], np.uint32),
            threads=0,
        )
        self._face = np.flatnonzero(spanned).astype(np.int32)

    def boundary(self, points: np.ndarray) -> tuple[np.ndarray, Closest]:
        """Return which points (N, 3) are inside the object below the part, and the part's closest
        points.

        A point inside the object that is nearer to another part of the surface counts as outside,
        because its distance to this part is not its depth.
        """
        inside, nearest = self._whole.boundary(points)
        closest = _closest(self._scene, points)
        query = np.reshape(points, (-1, 3))
        distance = np.linalg.norm(query - closest.points, axis=1)
        depth = np.linalg.norm(query - nearest.points, axis=1)
        faces = self._face[closest.faces]
        below = inside & (distance < depth + 1e-6)  # metres: rounding of float32 in an object
        return below, Closest(closest.points, faces, closest.barycentric, closest.normals)


class _OpenSurface:
    """The solid that a surface with open edges nearly encloses."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, threads: int) -> None:
        self._vertices = vertices.astype(np.float64)
        self._faces = faces.astype(np.int64)
        self._low, self._high = vertices.min(0), vertices.max(0)
        import trimesh  # slow import, which closed surfaces do not need

        hull = trimesh.convex.convex_hull(self._vertices)
        self._hull = build_scene(
            np.asarray(hull.vertices, np.float32), np.asarray(hull.faces, np.uint32), threads
        )

    def inside(self, query: np.ndarray) -> np.ndarray:
        """Return whether the winding number at points (N, 3) exceeds a half: (N,) bool."""
        result = np.zeros(len(query), bool)
        near = np.flatnonzero(((query > self._low) & (query < self._high)).all(1))
        if len(near):
            points = query[near].astype(np.float64)
            winding = igl.fast_winding_number(self._vertices, self._faces, points)
            result[near] = winding > 0.5
        return result

    def nearer(self, points: np.ndarray, inside: np.ndarray, closest: Closest) -> Closest:
        """Return ``closest`` with points and normals of the convex hull if that is closer.

        Args:
            points: (N, 3) metres.
            inside: (N,) bool; other points keep their closest point.
            closest: closest points (N) of the surface.
        """
        at = np.flatnonzero(inside)
        hull = _closest(self._hull, points[at])
        to_hull, to_surface = (
            np.linalg.norm(points[at] - of, axis=1) for of in (hull.points, closest.points[at])
        )
        closer = to_hull < to_surface
        place, normals = closest.points.copy(), closest.normals.copy()
        place[at[closer]], normals[at[closer]] = hull.points[closer], hull.normals[closer]
        return Closest(place, closest.faces, closest.barycentric, normals)


def build_scene(vertices: np.ndarray, faces: np.ndarray, threads: int) -> Any:
    """Return the search tree of float32 vertices (V, 3) and uint32 faces (F, 3)."""
    scene = o3d.t.geometry.RaycastingScene(nthreads=threads)
    scene.add_triangles(o3d.core.Tensor.from_numpy(vertices), o3d.core.Tensor.from_numpy(faces))
    return scene


def _closest(scene: Any, points: np.ndarray) -> Closest:
    query = o3d.core.Tensor.from_numpy(np.ascontiguousarray(points, np.float32).reshape(-1, 3))
    answer = scene.compute_closest_points(query)
    uv = answer["primitive_uvs"].numpy().astype(np.float64)
    return Closest(
        answer["points"].numpy().astype(np.float64),
        answer["primitive_ids"].numpy().astype(np.int32),
        np.column_stack([1 - uv.sum(1), uv]),
        answer["primitive_normals"].numpy().astype(np.float64),
    )
