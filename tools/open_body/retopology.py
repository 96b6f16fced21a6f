"""Another tessellation of the source's skin, tied to it by barycentric coordinates.

Hands, feet and head are enlarged before the decimation, or it would spend all triangles on the
trunk; the blow-up also keeps the nearest-surface search on the right finger.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.body.joints import JOINT_INDEX, JOINT_NAMES
from intercap_core.geometry.rigid.surfaces import vertex_normals

from .source import Source


@dataclass(frozen=True)
class Retopology:
    """faces (F,3) of the new mesh; its vertices lie at (face, barycentric) of the source mesh, and
    the source's vertices at (face, barycentric) of the new one.
    """

    faces: np.ndarray
    source_face: np.ndarray
    source_bary: np.ndarray
    back_face: np.ndarray
    back_bary: np.ndarray


def at(vertices: np.ndarray, faces: np.ndarray, face: np.ndarray, bary: np.ndarray) -> np.ndarray:
    """Points (N,3) at (face (N,), barycentric (N,3)) of a mesh."""
    return np.einsum("nk,nkc->nc", bary, vertices[faces[face]])


def enlarged(template: np.ndarray, weights: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """The mesh with hands, feet and head blown up, so that neighbours are far apart."""
    out = template.copy()
    fingers = {s: [i for i, n in enumerate(JOINT_NAMES) if n.startswith(s) and n[-1] in "123"]
               for s in ("left", "right")}  # fmt: skip
    parts = [(["head", "jaw", "left_eye_smplhf", "right_eye_smplhf"], "head", 1.7)]
    for side in ("left", "right"):
        parts.append(([f"{side}_ankle", f"{side}_foot"], f"{side}_ankle", 1.6))
        parts.append(([f"{side}_wrist"], f"{side}_wrist", 3.0))
    for names, centre, scale in parts:
        ids = [JOINT_INDEX[n] for n in names]
        if centre.endswith("wrist"):
            ids += fingers[centre.split("_")[0]]
        share = weights[:, ids].sum(1, keepdims=True)
        out += share * (scale - 1) * (template - joints[JOINT_INDEX[centre]])
    return out


def closest(
    points: np.ndarray, normals: np.ndarray, vertices: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Nearest (face, barycentric) whose normal agrees; nearest of all where none nearby does."""
    import open3d as o3d
    import trimesh

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(vertices.astype(np.float32), faces.astype(np.uint32))
    hit = scene.compute_closest_points(points.astype(np.float32))
    face = hit["primitive_ids"].numpy().astype(np.int64)
    uv = hit["primitive_uvs"].numpy().astype(float)
    bary = np.c_[1 - uv.sum(1), uv]
    cross = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]],
                     vertices[faces[:, 2]] - vertices[faces[:, 0]])  # fmt: skip
    face_normals = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-12)
    wrong = np.flatnonzero((face_normals[face] * normals).sum(1) < 0.2)
    centres = vertices[faces].mean(1)
    for i in wrong:
        near = np.argsort(np.linalg.norm(centres - points[i], axis=1), kind="stable")[:60]
        near = near[face_normals[near] @ normals[i] > 0.2]
        if not len(near):
            continue
        triangles = vertices[faces[near]]
        own = trimesh.triangles.closest_point(triangles, np.tile(points[i], (len(near), 1)))
        best = np.linalg.norm(own - points[i], axis=1).argmin()
        face[i] = near[best]
        bary[i] = trimesh.triangles.points_to_barycentric(
            triangles[best : best + 1], own[best : best + 1]
        )[0]
    return face, np.clip(bary, 0, 1) / np.clip(bary, 0, 1).sum(1, keepdims=True)


def remesh(source: Source, template: np.ndarray, joints: np.ndarray, faces: int) -> Retopology:
    """About `faces` triangles: split in four, then merged by quadric error; eyeballs stay."""
    import open3d as o3d
    import trimesh

    big = enlarged(template, source.weights, joints)
    is_eye = source.weights[:, [23, 24]].sum(1) > 0.5
    eye_face = is_eye[source.faces].all(1)
    skin = trimesh.Trimesh(big, source.faces[~eye_face], process=False)
    skin.remove_unreferenced_vertices()
    v, f = trimesh.remesh.subdivide(skin.vertices, skin.faces)
    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(v), o3d.utility.Vector3iVector(f))
    small = mesh.simplify_quadric_decimation(faces)
    eye_ids = np.flatnonzero(is_eye)
    new_id = np.full(len(big), -1)
    new_id[eye_ids] = len(small.vertices) + np.arange(len(eye_ids))
    vertices = np.concatenate([np.asarray(small.vertices), big[eye_ids]])
    triangles = np.concatenate([np.asarray(small.triangles), new_id[source.faces[eye_face]]])
    face, bary = closest(vertices, vertex_normals(vertices, triangles), big, source.faces)
    on_source = at(big, source.faces, face, bary)
    back_face, back_bary = closest(big, vertex_normals(big, source.faces), on_source, triangles)
    return Retopology(triangles, face, bary, back_face, back_bary)
