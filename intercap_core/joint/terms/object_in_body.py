"""Object in body (beyond the paper): the other side of :mod:`.penetration`, of the same weight.

Residuals in :mod:`intercap_core.joint.terms.object_in_body_residual`. Of hands alone: what they
hold is thin
enough to lie between their vertices. Who sits is in the seat by what clothes and flesh yield, over
an area on which the vertices of :mod:`.penetration` are dense, and would be lifted off it. Left out
where the skin's own vertex is inside the object, which that term pushes out: a depth counts once.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.geometry.rigid.surface_samples import sample_surface
from intercap_core.joint.constants import (
    MAX_OBJECT_POINTS,
    NEAR_SKIN,
    OBJECT_AREA_PER_MEASUREMENT,
    OBJECT_SPACING,
    PENETRATION_SIGMA,
)
from intercap_core.joint.energy_constants import PENETRATION_TOLERANCE
from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.proximity import along_by_object
from intercap_core.joint.state import ALL, State
from intercap_core.joint.terms import object_in_body_residual as object_in_body
from intercap_core.joint.terms import penetration_residual as penetration
from intercap_core.joint.terms.term import Term

# Joints that carry the hands' skin.
_HANDS = [
    i
    for name, i in JOINT_INDEX.items()
    if name.endswith("_wrist") or i >= JOINT_INDEX["left_index1"]
]


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
        held = object_in_body.embedded(points[some], skin[used], faces.reshape(-1, 3))
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
        residual, _ = penetration.weights(distance, np.ones(len(self._vertices)))
        weight = np.where(residual < 0, self._share, 0.0) * self._scale

        def rows(frames: slice, index: np.ndarray) -> np.ndarray:
            axes = -normals[frames, index, None]
            by_body = posed.vertices_by_body(frames, self._vertices[index], axes)
            by_object = along_by_object(
                points[frames, index], normals[frames, index], state.translation[frames]
            )
            return np.concatenate([by_body, by_object[:, :, None]], axis=3)

        equations.add_rows(self.name, ALL, rows, weight, residual[..., None])
