"""True objects of the studio: the catalogue's meshes made a little different from what is tracked.

A real object is never the scanned mesh: it is scaled by half a percent, its surface is off by a
smooth part of its size, and another scan would have other triangles.
"""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np

from intercap_core.config import ObjectEntry
from intercap_core.geometry.rigid.mesh_files import load_mesh

SCALE_ERROR = 0.005  # of the true size, up or down
# RMS of the smooth displacement along the normal, in parts of the object's radius (root mean square
# distance of its surface from its origin): 0.3 mm of a cup, 0.7 of a football, 1.4 of a suitcase,
# 1.9 of a chair. Waves are as long as the radius says, so a cup is no more crumpled than a chair.
SURFACE_ERROR = 0.006
WAVELENGTHS = (0.25, 0.9)  # of the surface error, in parts of the object's radius
WAVES = 48


def true_mesh(entry: ObjectEntry, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The object as it truly is in one capture.

    Returns vertices (V, 3) in metres, faces (F, 3) int32 facing outward and colours (V, 3) uint8,
    in the object frame of ``entry``'s mesh: the rigid part of the displacement is taken out, so a
    true pose is also the best pose of the tracked mesh. Four times the faces of the tracked mesh,
    every edge split at a random place. The same entry and seed give the same mesh.
    """
    source = load_mesh(Path(entry.mesh))
    rng = np.random.default_rng([seed, zlib.crc32(entry.name.encode())])
    vertices = np.asarray(source.vertices, np.float64)
    faces = np.asarray(source.faces, np.int64)
    colours = np.asarray(source.visual.vertex_colors, np.float64)[:, :3]
    vertices, faces, colours = _split_edges(vertices, faces, colours, rng)
    scale = 1 + SCALE_ERROR * rng.choice((-1, 1))
    vertices = scale * (vertices + _smooth_displacement(vertices, faces, rng))
    return vertices, faces.astype(np.int32), np.round(colours).astype(np.uint8)


def _split_edges(
    vertices: np.ndarray,
    faces: np.ndarray,
    colours: np.ndarray,
    rng: np.random.Generator,
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
    vertices: np.ndarray,
    faces: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """A random smooth vector field (V, 3) without rigid motion, in metres.

    A field over space moves both sides of a thin wall together, so nothing intersects.
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
    wavelength = radius * rng.uniform(*WAVELENGTHS, WAVES)
    direction = rng.normal(size=(WAVES, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    phase = vertices @ (2 * np.pi * direction / wavelength[:, None]).T
    field = np.cos(phase + rng.uniform(0, 2 * np.pi, WAVES)) @ rng.normal(size=(WAVES, 3))

    # least squares of normal displacement = n . (omega x v + t): what a tracker would take as pose
    rigid = np.concatenate([np.cross(vertices, normals), normals], 1)
    root = np.sqrt(weight)[:, None]
    motion = np.linalg.lstsq(root * rigid, root[:, 0] * (field * normals).sum(1), rcond=1e-4)[0]
    field -= np.cross(motion[:3], vertices) + motion[3:]
    rms = np.sqrt(weight @ (field * normals).sum(1) ** 2)
    return field * SURFACE_ERROR * radius / rms
