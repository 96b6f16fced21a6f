"""Colours that a mesh file brings: of its vertices, or of its texture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from intercap_core.geometry.rigid.constants import PAINT_POINTS
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.mesh_files import TEXTURE_ERRORS, load_mesh


@dataclass(frozen=True, eq=False)
class Paint:
    """Evenly spread points of a coloured surface: ``points`` and outward unit ``normals`` (N, 3) in
    the object's frame, metres; ``colours`` (N, 3) uint8, sRGB."""

    points: np.ndarray
    normals: np.ndarray
    colours: np.ndarray

    @classmethod
    def load(cls, path: Path, outward: ObjectMesh) -> Paint | None:
        """The colours of a mesh file; None where it has none or only one.

        ``outward`` is the object that was loaded from it and knows which side of a face is out. A
        texture that cannot be read counts as none.
        """
        mesh = load_mesh(path)
        visual = mesh.visual
        if visual is None or not visual.defined:
            return None
        sampled = trimesh.sample.sample_surface(mesh, PAINT_POINTS, seed=0, return_barycentric=True)
        points, face, weights = sampled[0], sampled[1], sampled[2]
        try:
            colours = _colours(mesh, face, weights)
        except TEXTURE_ERRORS:
            return None
        if not np.ptp(colours, axis=0).any():
            return None
        points = np.asarray(points)
        surface = DistanceField(outward.vertices, outward.faces, watertight=outward.watertight)
        return cls(points, surface.closest(points).normals, colours)


def _colours(mesh: Any, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Colours (N, 3) uint8 at barycentric ``weights`` (N, 3) of faces (N,)."""
    corners = mesh.faces[face]
    if mesh.visual.kind != "texture":
        of_corner = np.asarray(mesh.visual.vertex_colors, float)[corners, :3]
        return np.rint(np.einsum("nk,nkc->nc", weights, of_corner)).astype(np.uint8)
    material = mesh.visual.material
    if hasattr(material, "to_simple"):
        material = material.to_simple()
    at = np.einsum("nk,nkc->nc", weights, np.asarray(mesh.visual.uv, float)[corners])
    return trimesh.visual.color.uv_to_color(at, material.image)[:, :3]
