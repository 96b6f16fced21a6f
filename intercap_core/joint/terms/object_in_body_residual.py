"""Object in body, beside equation 6: points of the object's surface inside the body.

    E = sum over vertices v of the skin of a_v (depth(x_v) - tolerance)^2

x_v is the deepest of the object's points that lie nearest to v, none deeper than
``DEEPEST_IN_BODY``, and a_v the area of those that are inside.

A rim, a thin handle or a seat's edge lies between the body's sparse vertices, so that none of them
is inside the object while its points are inside the body. Beyond the paper; the other side of
:mod:`.penetration`.

The nearest point p of the skin and the direction n out of the body are found once in a round and
held, d = n . (x - v) + n . (v - p): the skin there moves along with its nearest vertex v.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.normals import vertex_normals
from intercap_core.joint.energy_constants import DEEPEST_IN_BODY, ON_SURFACE, WATCHED_OUTSIDE


@dataclass(frozen=True)
class Embedded:
    """K points of the object in or at one body's skin.

    ``point`` (K,) their places among the object's points, ``vertex`` (K,) the skin's vertex that
    each is held against, ``normal`` (K, 3) out of the body, ``distance`` (K,) metres, negative
    inside.
    """

    point: np.ndarray
    vertex: np.ndarray
    normal: np.ndarray
    distance: np.ndarray


def embedded(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> Embedded:
    """Points (N, 3) inside a piece of skin, vertices (V, 3) and outward ``faces`` (F, 3), or just
    outside; those deeper than ``DEEPEST_IN_BODY`` are left out: they may be behind its far side."""
    closest = DistanceField(vertices, faces).closest(points)
    corners = faces[closest.faces]
    smooth = (vertex_normals(vertices, faces)[corners] * closest.barycentric[..., None]).sum(axis=1)
    offset = points - closest.points
    length = np.linalg.norm(offset, axis=1)
    sign = np.where((offset * smooth).sum(axis=1) < 0, -1.0, 1.0)
    normal = sign[:, None] * offset / np.maximum(length, ON_SURFACE)[:, None]
    normal = np.where((length < ON_SURFACE)[:, None], closest.normals, normal)
    distance = sign * length
    near = np.flatnonzero((distance > -DEEPEST_IN_BODY) & (distance < WATCHED_OUTSIDE))
    vertex = corners[near, closest.barycentric[near].argmax(axis=1)]
    return Embedded(near, vertex, normal[near], distance[near])
