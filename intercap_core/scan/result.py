"""The finished mesh of a scan: frame, colours, symmetry and figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.open3d_core import o3d
from intercap_core.scan.fusion import Posed, vertex_colours
from intercap_core.scan.proposal import ProposedSymmetry, propose_symmetry, standing_frame
from intercap_core.scan.volume import ClosedSurface

EXPLAINED_M = 0.015  # distance of a point that shows the mesh: noise of depth and of the poses
MESH_FACES = 20_000  # of the finished mesh; edges of 2 mm on a cup


@dataclass(frozen=True, eq=False)
class ScannedMesh:
    """A scanned object in its own frame."""

    vertices: np.ndarray
    """(V, 3) metres."""
    faces: np.ndarray
    """(F, 3), normals outward."""
    measured: np.ndarray
    """(V,) bool: depth images measured the vertex; the others close holes."""
    colours: np.ndarray
    """(V, 3) uint8, sRGB."""
    symmetry: ProposedSymmetry
    """Rotations that map the shape onto itself."""
    turned_deg: float
    """Largest rotation between two frame sets."""
    sets: int
    """Frame sets that were fused."""
    explained_share: float = 1.0
    """Share of the recordings' points of the object that are near the mesh."""
    apart_share: float = 0.0
    """Share of the measured surface in separate parts, which are left out."""

    @property
    def watertight(self) -> bool:
        """Whether every edge joins two faces."""
        return bool(trimesh.Trimesh(self.vertices, self.faces, process=False).is_watertight)

    @property
    def closed_share(self) -> float:
        """Share of the area that no depth image measured."""
        areas = trimesh.triangles.area(self.vertices[self.faces])
        return float(areas[~self.measured[self.faces].all(1)].sum() / areas.sum())

    def figures(self) -> dict[str, str]:
        """Figures for people, by name."""
        size = " x ".join(f"{1e3 * side:.0f}" for side in np.ptp(self.vertices, axis=0))
        volume = trimesh.Trimesh(self.vertices, self.faces, process=False).volume
        return {
            "size": f"{size} mm",
            "volume": f"{1e3 * volume:.3g} litres",
            "closed without measurement": f"{self.closed_share:.1%} of the surface",
            "watertight": "yes" if self.watertight else "no",
            "symmetry of the shape": self.symmetry.words,
            "turned by": f"{self.turned_deg:.0f} degrees",
            "frame sets": str(self.sets),
            "points explained": f"{self.explained_share:.0%} within {1e3 * EXPLAINED_M:.0f} mm",
        }


def simplified(surface: ClosedSurface, faces: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a smoother mesh with at most ``faces`` faces.

    Smoothing is Taubin's (1995), which does not shrink the object.
    """
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(surface.vertices), o3d.utility.Vector3iVector(surface.faces)
    )
    mesh = mesh.filter_smooth_taubin(10)
    if len(surface.faces) > faces:
        mesh = mesh.simplify_quadric_decimation(faces)
    mesh.remove_unreferenced_vertices()
    return np.asarray(mesh.vertices).copy(), np.asarray(mesh.triangles).copy()


def finish(surface: ClosedSurface, parts: Sequence[Posed], up: np.ndarray | None) -> ScannedMesh:
    """Finish the fused surface of some recordings.

    ``up``: (3,) direction up of the standing object, in the surface's frame; None = the frame is
    kept.
    """
    vertices, faces = simplified(surface, MESH_FACES)
    measured = surface.measured[cKDTree(surface.vertices).query(vertices)[1]]
    colours = vertex_colours(vertices, parts)
    if up is not None:
        vertices = apply(standing_frame(vertices, faces, up), vertices)
    rotations = [np.stack([part.poses[t][:3, :3] for t in part.sets]) for part in parts]
    turned = max(
        float(Rotation.from_matrix(r[first].T @ r).magnitude().max())
        for r in rotations
        for first in range(0, len(r), max(1, len(r) // 10))
    )
    symmetry = propose_symmetry(vertices, faces)
    sets = sum(map(len, rotations))
    points = np.concatenate([part.points(t)[::10] for part in parts for t in part.sets])
    field = DistanceField(surface.vertices, surface.faces)
    explained = float((field.distance(points) < EXPLAINED_M).mean())
    return ScannedMesh(
        vertices, faces, measured, colours, symmetry, float(np.degrees(turned)), sets,
        explained, surface.apart_share,
    )  # fmt: skip
