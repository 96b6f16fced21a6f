"""True objects of the studio: meshes that differ a little from the catalogue's, which are tracked.

A real object never equals its scan. Therefore the true mesh is 0.5 % larger or smaller, has a
smooth error of the surface, and has other triangles."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from intercap_core.entries import ObjectEntry
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.mesh_files import load_mesh

# RMS of the smooth displacement along the normal, as a share of the object's radius (root mean
# square distance of its surface from its origin): 0.3 mm for a cup, 0.7 for a football, 1.4 for a
# suitcase, 1.9 for a chair. Wavelengths are proportional to the radius too.
SURFACE_ERROR = 0.006
WAVES = 48  # number of random plane waves whose sum is the displacement


# RGB of objects that do not have the mesh's own colours.
PAINTS = ((0.92, 0.91, 0.88), (0.13, 0.13, 0.14), (0.70, 0.12, 0.13), (0.11, 0.28, 0.60),
          (0.84, 0.42, 0.17), (0.16, 0.46, 0.31), (0.88, 0.76, 0.24),
          (0.50, 0.51, 0.53))  # fmt: skip


@dataclass(frozen=True)
class TrueObject:
    """The object as it truly is, object frame, metres."""

    name: str
    vertices: np.ndarray
    """(V, 3)."""
    faces: np.ndarray
    """(F, 3)."""
    colours: np.ndarray
    """(V, 3) RGB."""

    @classmethod
    def nothing(cls) -> TrueObject:
        """Return a mesh without faces, for a person alone."""
        vertices, faces = np.zeros((0, 3)), np.zeros((0, 3), np.int32)
        return cls("", vertices, faces, vertices)

    def __bool__(self) -> bool:
        """Whether there is an object."""
        return len(self.faces) > 0

    @cached_property
    def surface(self) -> DistanceField:
        """Distances to it."""
        return DistanceField(self.vertices, self.faces, threads=1)

    @property
    def standing_height(self) -> float:
        """Height of the origin when the object stands on the floor."""
        return float(-self.vertices[:, 2].min())


def true_mesh(entry: ObjectEntry, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mesh of the true object in one capture.

    Rigid motion is removed from the displacement, so that a true pose is also the best pose of the
    tracked mesh. Each face of the tracked mesh is split into four, at random places of its edges.

    Returns:
        vertices (V, 3) metres, faces (F, 3) int32 facing outward, colours (V, 3) uint8, in the
        frame of the mesh of ``entry``; equal for equal entry and seed.
    """
    source = load_mesh(Path(entry.mesh))
    rng = np.random.default_rng([seed, zlib.crc32(entry.name.encode())])
    vertices = np.asarray(source.vertices, np.float64)
    faces = np.asarray(source.faces, np.int64)
    colours = np.asarray(source.visual.vertex_colors, np.float64)[:, :3]
    vertices, faces, colours = _split_edges(vertices, faces, colours, rng)
    scale = 1 + 0.005 * rng.choice((-1, 1))
    vertices = scale * (vertices + _smooth_displacement(vertices, faces, rng))
    return vertices, faces.astype(np.int32), np.round(colours).astype(np.uint8)


def _split_edges(
    vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split each edge between 30 and 70 % of its length, each triangle into four."""
    corners = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, edge_of_side = np.unique(corners, axis=0, return_inverse=True)
    part = rng.uniform(0.3, 0.7, (len(edges), 1))
    middle = len(vertices) + edge_of_side.reshape(-1, 3)

    def add(values: np.ndarray) -> np.ndarray:
        return np.vstack([values, (1 - part) * values[edges[:, 0]] + part * values[edges[:, 1]]])

    a, b, c = faces.T
    ab, bc, ca = middle.T
    split = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], 1).reshape(-1, 3)
    return add(vertices), split, add(colours)


def _smooth_displacement(
    vertices: np.ndarray, faces: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """A random smooth displacement (V, 3) without rigid motion, metres.

    It is a function of the place, so that both sides of a thin wall move together and nothing
    intersects.
    """
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area_normal = np.cross(b - a, c - a) / 2
    weight, normals = np.zeros(len(vertices)), np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(weight, faces[:, corner], np.linalg.norm(area_normal, axis=1))
        np.add.at(normals, faces[:, corner], area_normal)
    weight /= weight.sum()
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    radius = np.sqrt(weight @ (vertices**2).sum(1))
    wavelength = radius * rng.uniform(0.25, 0.9, WAVES)
    direction = rng.normal(size=(WAVES, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    phase = vertices @ (2 * np.pi * direction / wavelength[:, None]).T
    field = np.cos(phase + rng.uniform(0, 2 * np.pi, WAVES)) @ rng.normal(size=(WAVES, 3))

    # Rigid part, which a tracker would take as pose: least squares of n . field = n . (w x v + t)
    rigid = np.concatenate([np.cross(vertices, normals), normals], 1)
    root = np.sqrt(weight)[:, None]
    motion = np.linalg.lstsq(root * rigid, root[:, 0] * (field * normals).sum(1), rcond=1e-4)[0]
    field -= np.cross(motion[:3], vertices) + motion[3:]
    rms = np.sqrt(weight @ (field * normals).sum(1) ** 2)
    return field * SURFACE_ERROR * radius / rms


GAP_M = 0.0003  # pressed skin stays this far outside, so that float32 keeps it outside
NEAR_M = 0.01  # points farther from the object's box are not tested


def press_out(
    points: np.ndarray, surface: DistanceField, stage_from_object: np.ndarray, bounds: np.ndarray
) -> np.ndarray:
    """Move points (N, 3) of the stage that are inside the object to its surface.

    Args:
        bounds: (2, 3) bounding box of the object in its own frame.
    """
    rotation, translation = stage_from_object[:3, :3], stage_from_object[:3, 3]
    local = (points - translation) @ rotation
    near = ((local > bounds[0] - NEAR_M) & (local < bounds[1] + NEAR_M)).all(1)
    ids = np.flatnonzero(near)
    if len(ids) == 0:
        return points
    ids = ids[surface.signed_distance(local[ids]) < GAP_M]
    if len(ids) == 0:
        return points
    moved = points.copy()
    at = local[ids]
    for _ in range(3):  # at a thin edge the nearest surface may change side
        inside = surface.signed_distance(at) < 0.5 * GAP_M
        if not inside.any():
            break
        closest = surface.closest(at[inside])
        at[inside] = closest.points + GAP_M * closest.normals
    moved[ids] = at @ rotation.T + translation
    return moved


def object_colours(
    look: str, vertices: np.ndarray, colours: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Colours (V, 3) RGB in [0, 1] of a true object.

    Args:
        look: "mesh" keeps ``colours`` (V, 3), "plain" has a single colour, "printed" has spots of
            other colours.
    """
    if look == "mesh":
        return colours
    first, *others = np.array(PAINTS)[rng.permutation(len(PAINTS))]
    painted = np.tile(first, (len(vertices), 1))
    if look == "printed":
        radius = np.linalg.norm(vertices - vertices.mean(0), axis=1).max()
        for paint in others[: rng.integers(3, 7)]:
            middle = vertices[rng.integers(len(vertices))]
            reach = radius * rng.uniform(0.15, 0.45)
            painted[np.linalg.norm(vertices - middle, axis=1) < reach] = paint
    return painted
