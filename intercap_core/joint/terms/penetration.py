"""Body in object, beside equation 6: vertices of the body inside the object.

    E = sum over vertices v of the body inside the object of (depth(v) - tolerance)^2

Equation 6 sums E_P of equation 5 (:mod:`intercap_core.body_fit.self_term`), over frames, and
the text adds "we also penalize the body-object interpenetration, as done in PROX" without a symbol.
This is that term: beyond the paper's formulas, against the moving object, and by the distance to
its mesh instead of a voxel grid.

Body in object: named in the text of equation 6 ("as done in PROX"), without a symbol there.

Beyond the paper's formulas: its E_P is equation 5, the self-penetration. Weighed by the setting
``penetration_weight``; residuals in :mod:`intercap_core.joint.terms.penetration_residual`.
E_P_self itself is part of the body's data.

Object in body, beside equation 6: points of the object's surface inside the body.

    E = sum over vertices v of the skin of a_v (depth(x_v) - tolerance)^2

x_v is the deepest of the object's points that lie nearest to v, none deeper than
``DEEPEST_IN_BODY``, and a_v the area of those that are inside.

A rim, a thin handle or a seat's edge lies between the body's sparse vertices, so that none of them
is inside the object while its points are inside the body. Beyond the paper; the other side of
:mod:`.penetration`.

The nearest point p of the skin and the direction n out of the body are found once in a round and
held, d = n . (x - v) + n . (v - p): the skin there moves along with its nearest vertex v.

Object in body (beyond the paper): the other side of :mod:`.penetration`, of the same weight.

Residuals in :mod:`intercap_core.joint.terms.object_in_body_residual`. Of hands alone: what they
hold is thin
enough to lie between their vertices. Who sits is in the seat by what clothes and flesh yield, over
an area on which the vertices of :mod:`.penetration` are dense, and would be lifted off it. Left out
where the skin's own vertex is inside the object, which that term pushes out: a depth counts once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.surfaces import sample_surface, vertex_normals
from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.proximity import ON_SURFACE, along_by_object
from intercap_core.joint.skin import VERTICES_PER_MEASUREMENT
from intercap_core.joint.state import ALL, State
from intercap_core.joint.terms.term import Term, add_distances

# Depth of a vertex inside the object beyond the tolerance, metres. Tuned on the studio.
PENETRATION_SIGMA = 0.003
# Points of the object's surface that are looked for inside the body: their spacing, metres, so that
# a rim shows on a fingertip, and how many at most.
OBJECT_SPACING, MAX_OBJECT_POINTS = 0.006, 6000
# Area of the object inside the body that is one measurement, m^2: a hand's breadth of a handle.
# Tuned on the studio.
OBJECT_AREA_PER_MEASUREMENT = 1e-3
# Skin whose nearest sample is farther than this from the object has none of it inside, metres: half
# the spacing of samples, a thickness and the way of a round.
NEAR_SKIN = 0.05
# Contact leaves the mesh up to this deep in the surface, metres: skin yields. Tuned on the studio.
PENETRATION_TOLERANCE = 0.001
# Points of the object deeper than this inside the body are left out, metres: half of a hand's
# thickness (anatomy), beyond which the nearest skin may be that of its far side.
DEEPEST_IN_BODY = 0.015
# Points so far outside the skin may enter it during a round, metres. Tuned on the studio.
WATCHED_OUTSIDE = 0.003

# Joints that carry the hands' skin.
_HANDS = [
    i
    for name, i in JOINT_INDEX.items()
    if name.endswith("_wrist") or i >= JOINT_INDEX["left_index1"]
]


def weigh_depths(distance: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (T, N) in metres and weights (T, N) of body vertices.

    ``distance`` (T, N) signed distances to the object, negative inside; ``share`` (N,) how many
    vertices of the whole mesh each vertex stands for. Only vertices deeper than
    ``PENETRATION_TOLERANCE`` have weight; the residual is zero at that depth.
    """
    residual = np.minimum(distance + PENETRATION_TOLERANCE, 0.0)
    return residual, np.where(residual < 0, share[None], 0.0)


class Penetration(Term):
    """Depth of the skin's vertices inside the object."""

    name = "penetration"

    def __init__(self, geometry: Geometry, weight: float) -> None:
        self._geometry = geometry
        self._scale = weight / PENETRATION_SIGMA**2 / VERTICES_PER_MEASUREMENT

    def add(self, state: State, equations: NormalEquations) -> None:
        """Add the depths at ``state``."""
        posed = self._geometry.at(state)
        near = posed.proximity
        depth, weight = weigh_depths(near.distance, self._geometry.skin.share)
        add_distances(self.name, posed, near, depth, weight * self._scale, None, equations)


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


def find_embedded(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> Embedded:
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


class ObjectInBody(Term):
    """Depth of the object's surface inside the hands, at the vertices of the skin nearest to it."""

    name = "object_in_body"

    def __init__(self, geometry: Geometry, weight: float) -> None:
        self._geometry = geometry
        mesh = geometry.mesh
        a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
        area = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2
        count = int(np.clip(area / OBJECT_SPACING**2, 1, MAX_OBJECT_POINTS))
        samples = sample_surface(mesh.vertices, mesh.faces, count)
        self._points = samples.of(mesh.vertices, mesh.faces)
        self._scale = weight / PENETRATION_SIGMA**2 * area / count / OBJECT_AREA_PER_MEASUREMENT
        model = geometry.model
        self._faces = model.faces.cpu().numpy().astype(np.int64)
        template = model.template.double().cpu().numpy()
        carrier = model.skinning_weights.argmax(1).cpu().numpy()
        self._hands = np.isin(carrier, _HANDS)[geometry.skin.vertices]
        self._sample_of = cKDTree(template[geometry.skin.vertices]).query(template)[1]
        self._vertices = np.zeros(0, int)  # (K,) of the body, held against points of the object
        self._local = np.zeros((0, 0, 3))  # (T, K, 3) those points, in its frame
        self._normals = np.zeros((0, 0, 3))
        self._beside = np.zeros((0, 0))  # (T, K) n . (v - p), metres
        self._share = np.zeros((0, 0))  # (T, K) how many points each stands for

    def refresh(self, state: State) -> None:
        """Look for the object's points inside the body anew."""
        posed, frames = self._geometry.at(state), len(state)
        near = self._hands & (np.abs(posed.proximity.distance) < NEAR_SKIN)  # (T, N)
        ids = np.flatnonzero(near.any(axis=0)[self._sample_of])
        skin = posed.posed(ids) if len(ids) else np.zeros((frames, 0, 3))
        place = np.full(len(self._sample_of), -1)
        place[ids] = np.arange(len(ids))
        found = [
            self._in_frame(t, state, skin[t], ids, place, posed.skin[t, near[t]], near[t])
            for t in range(frames)
        ]
        self._vertices = np.unique(np.concatenate([held[0] for held in found]))
        shape = (frames, len(self._vertices))
        self._local, self._normals = np.zeros((*shape, 3)), np.zeros((*shape, 3))
        self._beside, self._share = np.zeros(shape), np.zeros(shape)
        for t, (vertex, local, normal, beside, share) in enumerate(found):
            at = np.searchsorted(self._vertices, vertex)
            self._local[t, at], self._normals[t, at] = local, normal
            self._beside[t, at], self._share[t, at] = beside, share

    def _in_frame(
        self,
        t: int,
        state: State,
        skin: np.ndarray,
        ids: np.ndarray,
        place: np.ndarray,
        around: np.ndarray,
        near: np.ndarray,
    ) -> tuple[np.ndarray, ...]:
        """Frame ``t``'s vertices (K,), the deepest point (K, 3) of the object at each, its normal
        (K, 3), how far the vertex is off the nearest skin along it (K,), and the points' number
        (K,)."""
        none = (np.zeros(0, int), *(np.zeros((0, 3)),) * 2, *(np.zeros(0),) * 2)
        rotation, translation = state.rotation[t], state.translation[t]
        points = self._points @ rotation.T + translation
        faces = place[self._faces[near[self._sample_of[self._faces]].all(axis=1)]]
        if not len(faces):
            return none
        low, high = around.min(axis=0) - NEAR_SKIN / 2, around.max(axis=0) + NEAR_SKIN / 2
        some = np.flatnonzero(((points > low) & (points < high)).all(axis=1))
        if not len(some):
            return none
        used, faces = np.unique(faces, return_inverse=True)
        held = find_embedded(points[some], skin[used], faces.reshape(-1, 3))
        order = np.argsort(held.distance, kind="stable")
        vertex, first = np.unique(held.vertex[order], return_index=True)
        inside = np.bincount(held.vertex, held.distance < -PENETRATION_TOLERANCE, len(used))
        deepest = order[first]
        at, normal = skin[used[vertex]], held.normal[deepest]
        point = some[held.point[deepest]]
        along = ((points[point] - at) * normal).sum(axis=1)
        own = self._geometry.field.signed_distance((at - translation) @ rotation)
        kept = own > -PENETRATION_TOLERANCE
        return (
            ids[used[vertex]][kept],
            self._points[point][kept],
            normal[kept],
            (held.distance[deepest] - along)[kept],
            np.maximum(inside[vertex], 1.0)[kept],
        )

    def add(self, state: State, equations: NormalEquations) -> None:
        """Add the depths at ``state`` of the points of the last :meth:`refresh`."""
        posed, normals = self._geometry.at(state), self._normals
        points = self._local @ state.rotation.transpose(0, 2, 1) + state.translation[:, None]
        skin = posed.posed(self._vertices) if len(self._vertices) else points
        distance = ((points - skin) * normals).sum(axis=2) + self._beside
        residual, _ = weigh_depths(distance, np.ones(len(self._vertices)))
        weight = np.where(residual < 0, self._share, 0.0) * self._scale

        def rows(frames: slice, index: np.ndarray) -> np.ndarray:
            axes = -normals[frames, index, None]
            by_body = posed.vertices_by_body(frames, self._vertices[index], axes)
            by_object = along_by_object(
                points[frames, index], normals[frames, index], state.translation[frames]
            )
            return np.concatenate([by_body, by_object[:, :, None]], axis=3)

        equations.add_rows(self.name, ALL, rows, weight, residual[..., None])
