"""Rigid meshes of objects: checks, safe repairs, contact vertices, symmetry and colours."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from intercap_core.entries import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.geometry.rigid.contact_vertices import read_contact_vertices
from intercap_core.geometry.rigid.mesh_files import (
    TEXTURE_ERRORS,
    file_vertices,
    get_colours,
    load_mesh,
    read_mesh,
)
from intercap_core.geometry.rigid.surfaces import face_normals
from intercap_core.geometry.rigid.symmetry import SymmetryGroup

log = logging.getLogger(__name__)

# Sizes of objects that people handle, metres.
HANDLED_MAX_M, HANDLED_MIN_M = 3.0, 0.02
UNITS = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254}


@dataclass(frozen=True, eq=False)
class ObjectMesh:
    """A rigid object in the frame of its mesh file."""

    name: str
    """Name in objects.yaml."""
    vertices: np.ndarray
    """(V, 3) float64, metres."""
    faces: np.ndarray
    """(F, 3) int32, wound so that normals point outward."""
    contact_vertices: np.ndarray
    """(K,) int64, sorted: vertices that people are likely to touch."""
    symmetry: SymmetryGroup
    """Motions that do not change the object's appearance."""
    colours: np.ndarray
    """(V, 3) uint8, sRGB."""
    watertight: bool = True
    """Whether every edge joins two faces, so that inside and outside are defined everywhere."""

    @classmethod
    def load(cls, entry: ObjectEntry) -> ObjectMesh:
        """Load and check the mesh, contact vertices and symmetry of an objects.yaml entry.

        Coinciding vertices are merged, faces of inconsistent winding are turned, small holes are
        closed and faces without area are left out, each with a warning. If holes remain,
        ``watertight`` is false. Raises UserError that names the file, the fault and the next step.
        """
        path = Path(entry.mesh)
        mesh = read_mesh(path)
        in_file, loaded = file_vertices(path, mesh), np.asarray(mesh.vertices)
        _check_size(path, mesh)
        mesh, place = _without_loose_vertices(path, mesh)
        mesh, new_id = _repair(path, mesh)
        _check_volume(path, mesh)
        try:
            symmetry = SymmetryGroup.from_settings(entry.symmetry)
        except ValueError as error:
            raise UserError(
                f"object {entry.name!r}: symmetry is impossible ({error}); correct it in "
                "objects.yaml"
            ) from None
        contact = _contact_places(entry.contact_vertices, path, in_file, loaded, place)
        ids = np.arange(len(mesh.vertices)) if contact is None else np.unique(new_id[contact])
        result = cls(
            entry.name,
            np.asarray(mesh.vertices, np.float64),
            np.asarray(mesh.faces, np.int32),
            ids.astype(np.int64),
            symmetry,
            get_colours(mesh)[:, :3].copy(),
            bool(mesh.is_watertight),
        )
        _check_symmetry(path, result)
        return result

    @cached_property
    def face_normals(self) -> np.ndarray:
        """Outward unit normals (F, 3)."""
        return face_normals(self.vertices, self.faces)

    @cached_property
    def centre_of_mass(self) -> np.ndarray:
        """Centre of mass (3,) at uniform density, or of the surface if it is not closed."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        centroids = (a + b + c) / 3
        if not self.watertight:
            areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
            return (areas[:, None] * centroids).sum(0) / areas.sum()
        # sum of tetrahedra from a point near the object, which limits rounding errors
        middle = self.vertices.mean(0)
        volumes = np.einsum("ij,ij->i", a - middle, np.cross(b - middle, c - middle))
        return (volumes[:, None] * (0.75 * centroids + 0.25 * middle)).sum(0) / volumes.sum()

    @property
    def thickness(self) -> float:
        """Mean thickness of a closed mesh, metres: twice its volume by its area."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        volume = (a * np.cross(b, c)).sum() / 6
        return float(4 * volume / np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())

    def simplified(self, max_faces: int, tolerance_m: float = 0.0005) -> ObjectMesh:
        """Return the object with about ``max_faces`` faces, for rendering and search.

        Every vertex of the object is within ``tolerance_m`` of the simplified surface; the number
        of faces is increased until that holds. The default is below the sensor's noise. Contact
        vertices are left out. Returns the mesh itself if it is small enough.
        """
        from intercap_core.geometry.rigid.distance import DistanceField, o3d

        full = o3d.geometry.TriangleMesh(
            o3d.utility.Vector3dVector(self.vertices), o3d.utility.Vector3iVector(self.faces)
        )
        count = max_faces
        while count < 0.8 * len(self.faces):
            simple = full.simplify_quadric_decimation(count)
            vertices = np.asarray(simple.vertices)
            faces = np.asarray(simple.triangles).astype(np.int32)
            if DistanceField(vertices, faces).distance(self.vertices).max() < tolerance_m:
                return replace(
                    self,
                    vertices=vertices,
                    faces=faces,
                    contact_vertices=np.zeros(0, np.int64),
                    colours=np.full((len(vertices), 3), 128, np.uint8),
                )
            count = count * 3 // 2
        return self

    @cached_property
    def radius(self) -> float:
        """Largest distance of a vertex from the centre of mass, metres."""
        return float(np.linalg.norm(self.vertices - self.centre_of_mass, axis=1).max())

    def centre_at(self, pose: np.ndarray) -> np.ndarray:
        """Return the centre of mass (..., 3) at poses a_from_object (..., 4, 4), in frame a,
        metres."""
        return pose[..., :3, :3] @ self.centre_of_mass + pose[..., :3, 3]

    @cached_property
    def diameter(self) -> float:
        """Largest distance between two vertices, metres (BOP's scale of pose errors)."""
        from scipy.spatial import ConvexHull
        from scipy.spatial.distance import pdist

        return float(pdist(self.vertices[ConvexHull(self.vertices).vertices]).max())


@dataclass(frozen=True, eq=False)
class Paint:
    """Colours of an object: points spread over its surface, with normals and colours."""

    points: np.ndarray
    """(N, 3) metres, object frame."""
    normals: np.ndarray
    """(N, 3) outward unit normals."""
    colours: np.ndarray
    """(N, 3) uint8, sRGB."""

    @classmethod
    def load(cls, path: Path, outward: ObjectMesh) -> Paint | None:
        """Return the colours of a mesh file, or None if it has no colours or a single one.

        A texture that cannot be read counts as no colours.

        Args:
            path: mesh file.
            outward: the object loaded from it, whose faces are wound outward.
        """
        from intercap_core.geometry.rigid.distance import DistanceField

        mesh = load_mesh(path)
        visual = mesh.visual
        if visual is None or not visual.defined:
            return None
        points, face, weights = trimesh.sample.sample_surface(
            mesh, 20_000, seed=0, return_barycentric=True
        )[:3]
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
    """Return colours (N, 3) uint8 at barycentric ``weights`` (N, 3) of faces (N,)."""
    corners = mesh.faces[face]
    if mesh.visual.kind != "texture":
        of_corner = np.asarray(mesh.visual.vertex_colors, float)[corners, :3]
        return np.rint(np.einsum("nk,nkc->nc", weights, of_corner)).astype(np.uint8)
    material = mesh.visual.material
    if hasattr(material, "to_simple"):
        material = material.to_simple()
    at = np.einsum("nk,nkc->nc", weights, np.asarray(mesh.visual.uv, float)[corners])
    return trimesh.visual.color.uv_to_color(at, material.image)[:, :3]


def _check_size(path: Path, mesh: trimesh.Trimesh) -> None:
    """Raise UserError if the size of a mesh is impossible for an object, warn if unusual."""
    extent = float(np.ptp(mesh.vertices[np.unique(mesh.faces)], axis=0).max())
    if not 0.01 <= extent <= 5.0:
        fitting = [f"{unit} ({scale:g})" for unit, scale in UNITS.items()
                   if HANDLED_MIN_M <= extent * scale <= HANDLED_MAX_M]  # fmt: skip
        unit = f"; it looks like {' or '.join(fitting)}" if fitting else ""
        raise UserError(
            f"{path}: is {extent:.4g} m long, expected {HANDLED_MIN_M} to {HANDLED_MAX_M:g} m"
            f"{unit}: scale it so that its unit is the metre"
        )
    away = float(np.abs(mesh.vertices[np.unique(mesh.faces)]).max())
    # scans may be a room's width away from the origin; at 50 m single precision rounds to 4 um
    if away > 50:
        raise UserError(
            f"{path}: has vertices {away:.4g} m from its origin, expected at most 50 m; move the "
            "object to its origin, in metres"
        )
    if away > HANDLED_MAX_M + extent:
        log.warning(
            "%s: lies up to %.3g m from its origin, expected less than %g m; check its unit, or "
            "move the object to its origin",
            path, away, HANDLED_MAX_M,
        )  # fmt: skip
    if not HANDLED_MIN_M <= extent <= HANDLED_MAX_M:
        log.warning(
            "%s: is %.3g m long, people handle objects of %g to %g m; check its unit",
            path, extent, HANDLED_MIN_M, HANDLED_MAX_M,
        )  # fmt: skip


def _check_symmetry(path: Path, mesh: ObjectMesh) -> None:
    """Raise UserError if a symmetry moves the centre of mass by over half of the extent."""
    centre, symmetry = mesh.centre_of_mass, mesh.symmetry
    elements = symmetry.elements(4)
    moved = np.linalg.norm(elements[:, :3, :3] @ centre + elements[:, :3, 3] - centre, axis=1).max()
    if symmetry.sphere:
        moved = max(moved, 2 * float(np.linalg.norm(centre)))
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    if moved > 0.5 * extent:  # scans and symmetries of appearance deviate by less
        raise UserError(
            f"object {mesh.name!r}: its symmetry moves the centre of {path} by {moved:.3g} m, "
            f"expected less than {0.5 * extent:.2g} m; correct the offset or translation of the "
            "symmetry (metres, frame of the mesh) in objects.yaml"
        )


def _check_volume(path: Path, mesh: trimesh.Trimesh) -> None:
    """Raise UserError if the mesh encloses no volume."""
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    volume = float(mesh.volume) if len(mesh.faces) else 0.0
    if not volume > 1e-8 * extent**3:  # less is a flat sheet with rounding errors
        raise UserError(
            f"{path}: encloses {volume:.3g} m^3 at {extent:.3g} m of length, expected a body with "
            "thickness; export a closed surface instead of a flat sheet"
        )


def _without_loose_vertices(
    path: Path, mesh: trimesh.Trimesh
) -> tuple[trimesh.Trimesh, np.ndarray]:
    """Remove vertices that no face uses, which would count in the size of the mesh.

    Returns:
        The mesh.
        (V_file,) new index of each vertex of the file, -1 = removed.
    """
    count = len(mesh.vertices)
    used = np.unique(mesh.faces)
    place = np.full(count, -1)
    place[used] = np.arange(len(used))
    if len(used) == count:
        return mesh, place
    log.warning("%s: left out %d vertices that no face uses", path, count - len(used))
    kept = trimesh.Trimesh(
        np.asarray(mesh.vertices)[used],
        place[np.asarray(mesh.faces)],
        vertex_colors=get_colours(mesh)[used],
        process=False,
        validate=False,
    )
    return kept, place


def _repair(path: Path, mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, np.ndarray]:
    """Repair a mesh as :meth:`ObjectMesh.load` describes.

    Returns:
        A mesh of consistent winding, perhaps with holes.
        (V,) new index of each vertex of ``mesh``.
    """
    new_id = np.arange(len(mesh.vertices))
    if mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0:
        return mesh, new_id
    colours = get_colours(mesh)
    vertices, first, new_id = np.unique(
        np.asarray(mesh.vertices).round(7), axis=0, return_index=True, return_inverse=True
    )
    faces = new_id.reshape(-1)[np.asarray(mesh.faces)]
    proper = (
        (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    )
    mesh = trimesh.Trimesh(
        vertices, faces[proper], vertex_colors=colours[first], process=False, validate=False
    )
    done = []
    if not proper.all():
        done.append(f"left out {(~proper).sum()} faces without area")
    if not mesh.is_winding_consistent:
        trimesh.repair.fix_winding(mesh)
        done.append("turned faces of inconsistent winding")
    if not mesh.is_watertight:
        before = len(mesh.faces)
        trimesh.repair.fill_holes(mesh)
        if len(mesh.faces) > before:
            done.append(f"closed holes with {len(mesh.faces) - before} faces")
    if mesh.volume < 0:
        trimesh.repair.fix_inversion(mesh)
        done.append("turned all faces outward")
    if done:
        log.warning("%s: %s", path, "; ".join(done))
    if not mesh.is_watertight:
        edges = np.sort(mesh.edges, axis=1)
        _, count = np.unique(edges, axis=0, return_counts=True)
        open_share = float((count != 2).mean())
        # more is a collection of loose faces; a box of few faces without lid has a quarter
        if open_share > 0.35:
            raise UserError(
                f"{path}: {open_share:.0%} of its edges do not join two faces, so it has no "
                "inside; close the surface (e.g. with MeshLab's or Blender's remesher)"
            )
        log.warning(
            "%s: not watertight, %.1f %% of its edges are open: object_track draws both sides of "
            "its faces, joint and metrics decide inside by winding numbers, so contact and "
            "penetration near the holes are uncertain; `intercap close-mesh` closes small holes",
            path, 100 * open_share,
        )  # fmt: skip
    return mesh, new_id.reshape(-1)


def _contact_places(
    listed: Path | None, path: Path, vertices: np.ndarray, loaded: np.ndarray, place: np.ndarray
) -> np.ndarray | None:
    """Return indices (K,) of likely-contact vertices after ``place``, or None without a list.

    Args:
        listed: file of the list.
        path: mesh file.
        vertices: (V, 3) as the mesh file numbers them.
        loaded: (W, 3) of the loaded mesh, which may repeat and reorder them.
        place: (W,) new index of each loaded vertex, -1 = removed.
    """
    if listed is None:
        return None
    ids = read_contact_vertices(Path(listed), path, vertices)
    if path.suffix.lower() == ".stl":
        log.warning(
            "%s: its numbers count the corners of all triangles of %s, because STL numbers no "
            "vertices; use a .ply or .obj for a list that another program made",
            listed, path,
        )  # fmt: skip
    if np.array_equal(vertices, loaded, equal_nan=True):
        places = place[ids]
    else:
        same = cKDTree(np.nan_to_num(loaded, nan=1e9)).query_ball_point(vertices[ids], 1e-7)
        places = place[np.unique(np.concatenate([[], *same]).astype(int))]
    if (places < 0).all():
        raise UserError(
            f"{listed}: no face of the mesh uses any of its {len(ids)} vertices; the list belongs "
            f"to another mesh than {path}: choose the vertices again"
        )
    return places[places >= 0]
