"""Contact points behind a wall, by a ray cast that does not use :func:`.facing.facing_distance`.

A touched point of an object is behind a wall if every segment from it to the body within the
threshold crosses the object or lies inside it. A touched point inside the body is behind a wall if
on every steep line the body's surface is nearer on the point's outer side than through the object,
like a finger that passed through the wall of a cup.
"""

from __future__ import annotations

import numpy as np
import trimesh

from intercap_core import artefacts
from intercap_core.evaluation.contact import vertex_contact
from intercap_core.evaluation.tracks import read_body, read_object
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.surfaces import vertex_normals
from intercap_core.schemas import CONTACT_M, METRICS
from intercap_core.sequence_inputs import SequenceModels, SequencePaths

# Mean thickness (twice the volume by the area) below which an object is thin-walled, metres: a body
# can be within the threshold of both of its sides.
_THIN_M = 2 * CONTACT_M
_OFF_M = 2e-5  # segments start and end this far from the surfaces
_LINES = 100  # lines through a point inside the body; chosen
_STEEP = 0.3  # least cosine between a line and the normal, that of contact; tuned


def count_behind_wall(paths: SequencePaths, models: SequenceModels) -> np.ndarray:
    """Counts (2,): touched vertices of a thin-walled object, and those of them behind a wall.

    They are counted in all frames of a sequence after ``joint``; 0 for other objects. The artefacts
    of ``joint`` and ``metrics`` are read.
    """
    counts = np.zeros(2)
    if models.object_ is None:
        return counts
    mesh = ObjectMesh.load(models.object_)
    if not mesh.watertight or mesh.thickness > _THIN_M:
        return counts
    with artefacts.read(paths.metrics, METRICS) as metrics:
        if "object_contact_distance" not in metrics:
            return counts
        touched = vertex_contact(metrics["object_contact_distance"])
    body = read_body(paths.joint, "joint", models.body_models, models.gender)
    track, faces = read_object(paths.joint, "joint"), body.model.faces.numpy()
    normals = vertex_normals(mesh.vertices, mesh.faces)
    for t in np.flatnonzero(touched.any(1)):
        skin = (body.frame(int(t)) - track.translation[t]) @ track.rotation[t]
        at = touched[t]
        hidden = behind_wall(
            mesh.vertices[at], normals[at], (mesh.vertices, mesh.faces), (skin, faces)
        )
        counts += (at.sum(), hidden.sum())
    return counts


def behind_wall(
    points: np.ndarray,
    normals: np.ndarray,
    object_: tuple[np.ndarray, np.ndarray],
    body: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Mask (N,) of the touched points of an object that are behind a wall of it.

    Args:
        points, normals: (N, 3) of the object's surface, metres, and outward unit normals.
        object_, body: vertices (V, 3) in the frame of the points, and faces (F, 3).
    """
    result = np.zeros(len(points), bool)
    if len(points) == 0:
        return result
    wall, skin = DistanceField(*object_, threads=1), DistanceField(*body, threads=1)
    inside = skin.inside(points)
    result[inside] = True
    for ray in _directions(_LINES):
        along = normals @ ray
        ahead = np.sign(along)[:, None] * ray
        through = skin.first_hit(points, -ahead)
        crosses = wall.first_hit(points - _OFF_M * ahead, -ahead) < through
        sooner = skin.first_hit(points, ahead) < through
        result[inside] &= ((crosses & sooner) | (abs(along) < _STEEP))[inside]
    triangles = body[0][body[1]]
    low, high = points.min(0) - CONTACT_M, points.max(0) + CONTACT_M
    triangles = triangles[((triangles.max(1) > low) & (triangles.min(1) < high)).all(1)]
    for at in np.flatnonzero(~inside):
        start = np.broadcast_to(points[at], (len(triangles), 3))
        ways = trimesh.triangles.closest_point(triangles, start) - start
        length = np.linalg.norm(ways, axis=1)
        ways, length = ways[length < CONTACT_M + _OFF_M], length[length < CONTACT_M + _OFF_M]
        along = ways / np.maximum(length, _OFF_M)[:, None]
        starts = points[at] + _OFF_M * along
        blocked = wall.first_hit(starts, along) < length - 2 * _OFF_M
        result[at] = (blocked | wall.inside(starts)).all()
    return result


def _directions(count: int) -> np.ndarray:
    """Unit vectors (N, 3) spread evenly over the sphere (Fibonacci lattice)."""
    height = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    flat = np.sqrt(1 - height**2)
    return np.column_stack([flat * np.cos(angle), flat * np.sin(angle), height])
