"""Normals of triangle meshes, and points spread evenly over their surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Increments of the two-dimensional golden-ratio sequence, which spreads barycentric coordinates
# evenly without a random generator (Roberts 2018, "The Unreasonable Effectiveness of Quasirandom
# Sequences").
_STEP_U, _STEP_V = 0.7548776662466927, 0.5698402909980532


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return outward unit normals (F, 3)."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-18)


def doubled_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return twice the area (F,) of each face, square metres."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return area-weighted outward unit normals (V, 3)."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    of_faces = np.cross(b - a, c - a)
    normals = np.stack(
        [
            np.bincount(faces.ravel(), np.repeat(of_faces[:, axis], 3), minlength=len(vertices))
            for axis in range(3)
        ],
        1,
    )
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-18)


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Points spread evenly over a mesh's area."""

    faces: np.ndarray
    """(N,) face of each point."""
    barycentric: np.ndarray
    """(N, 3) weights of the face's corners."""

    def of(self, values: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        """Return values (N, ...) at the points, interpolated from vertex values (V, ...).

        triangles: (F, 3) faces of the mesh.
        """
        corners = triangles[self.faces]
        weights = self.barycentric.reshape(len(self.faces), 3, *([1] * (values.ndim - 1)))
        return sum(values[corners[:, k]] * weights[:, k] for k in range(3))

    def __len__(self) -> int:
        return len(self.faces)


def sample_surface(vertices: np.ndarray, triangles: np.ndarray, count: int) -> SurfaceSamples:
    """Return ``count`` points spread evenly over the area of a mesh (V, 3), (F, 3).

    The choice is deterministic.
    """
    reached = np.cumsum(doubled_areas(vertices, triangles))
    faces = np.searchsorted(reached, (np.arange(count) + 0.5) / count * reached[-1])
    number = np.arange(1, count + 1)
    u, v = (number * _STEP_U) % 1, (number * _STEP_V) % 1
    outside = u + v > 1
    u[outside], v[outside] = 1 - u[outside], 1 - v[outside]
    return SurfaceSamples(np.minimum(faces, len(triangles) - 1), np.column_stack([1 - u - v, u, v]))
