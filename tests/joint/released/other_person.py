"""A person of SMPL-H's number of vertices, who is no body of ours and none of the studio's meshes.

The studio's skin is decimated, and single faces are split until it has 6,890 vertices; each vertex
keeps its place on the studio's mesh, so that it follows that skin through every pose.
"""

from __future__ import annotations

import functools

import numpy as np

from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.open3d_core import o3d
from intercap_core.studio.subjects import Subject

VERTICES = 6890


@functools.cache
def _mesh(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Faces (F, 3) of the new mesh, and of each vertex its face on the studio's (V,) and its
    barycentric weights there (V, 3)."""
    subject = Subject.load(name)
    whole = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(subject.rest), o3d.utility.Vector3iVector(subject.faces)
    )
    simple = whole.simplify_quadric_decimation(13_000)
    vertices, faces = np.asarray(simple.vertices), np.asarray(simple.triangles).astype(np.int64)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    missing = VERTICES - len(vertices)
    assert 0 <= missing <= len(faces)
    split = np.argsort(-area, kind="stable")[:missing]
    new = len(vertices) + np.arange(missing)
    parts = [np.delete(faces, split, axis=0)]
    for i in range(3):
        parts.append(np.column_stack([faces[split, i], faces[split, (i + 1) % 3], new]))
    vertices = np.concatenate([vertices, vertices[faces[split]].mean(1)])
    found = DistanceField(subject.rest, subject.faces).closest(vertices)
    return np.concatenate(parts), found.faces, found.barycentric


def other_person(
    pose: np.ndarray, transl: np.ndarray, *, name: str = "s02"
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (T, 6890, 3) and faces of one of the studio's people under SMPL-X's poses (T, 165)
    and translations (T, 3)."""
    subject = Subject.load(name)
    faces, at, weights = _mesh(name)
    corners = subject.skin(pose, transl).vertices[:, subject.faces[at]]
    return np.einsum("vk,tvkc->tvc", weights, corners), faces


def smplh_pose(pose: np.ndarray, *, off_deg: float, seed: int = 0) -> np.ndarray:
    """SMPL-H's 156 numbers of poses (T, 165), each joint ``off_deg`` degrees off: rest poses and
    joints of two bodies are not the same."""
    theirs = np.delete(pose.reshape(-1, 55, 3), [22, 23, 24], axis=1)
    off = np.random.default_rng(seed).normal(size=theirs.shape[1:])
    off *= np.radians(off_deg) / np.linalg.norm(off, axis=1, keepdims=True)
    return (theirs + off).reshape(len(pose), 156)
