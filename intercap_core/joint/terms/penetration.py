"""Body in object and object in body: two penalties of interpenetration besides equation 6.

E_P of equations 5 and 6 is the body's self-penetration, part of the body's data. The paper's text
adds a penalty of body-object interpenetration ("as done in PROX") without a formula. Here it is by
distances to the object's mesh:

    body in object:  E = sum over vertices v of the body inside the object (depth(v) - tolerance)^2
    object in body:  E = sum over vertices v of the hands of a_v (depth(x_v) - tolerance)^2

x_v is the deepest of the object's points that lie nearest to v, and a_v the area of those that are
inside. A rim or a thin handle lies between the body's sparse vertices: none of them is inside the
object while its points are inside the body. The second term covers the hands alone, as a seated
person is in the seat by what clothes and flesh yield. Setting ``penetration_weight``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.body.joints import FIRST_FINGER, JOINT_INDEX
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.surface_tree import SurfaceTree
from intercap_core.geometry.rigid.surfaces import doubled_areas, sample_surface, vertex_normals
from intercap_core.joint.equations import BandedEquations
from intercap_core.joint.proximity import ON_SURFACE, along_by_object
from intercap_core.joint.skin import VERTICES_PER_MEASUREMENT
from intercap_core.joint.state import ALL, State, frame_chunks
from intercap_core.joint.terms.term import Data, Equation, JointTerm, TermContext

# Standard deviation of a depth beyond the tolerance, metres. Tuned on the studio: without both
# terms the mean penetration is 2.5 mm, with them 1.4 (bench/RESULTS.md, commit 86d72be); with 4 mm
# it is 0.17 mm larger.
PENETRATION_SIGMA = 0.003
PENETRATION_TOLERANCE = 0.001  # depth that costs nothing, metres: skin yields; tuned on the studio
# Skin samples this near to the object are searched for points of it, m: half the spacing of the
# samples, a thickness and the motion of a round. Tuned on the studio.
NEAR_SKIN = 0.05
# Half of a hand's thickness, m (anatomy): deeper points may be nearest to the skin of the far side.
DEEPEST_IN_BODY = 0.015
WATCHED_OUTSIDE = 0.003  # metres above the skin: points that may enter during a round; tuned

# Joints that carry the hands' skin.
_HANDS = [i for name, i in JOINT_INDEX.items() if name.endswith("_wrist") or i >= FIRST_FINGER]


def excess_depth(distance: np.ndarray) -> np.ndarray:
    """Residuals of signed distances, metres: negative beyond the tolerance, 0 elsewhere."""
    return np.minimum(distance + PENETRATION_TOLERANCE, 0.0)


class Penetration(JointTerm):
    """Depth of the skin's vertices inside the object."""

    name = "penetration"
    equation = Equation(
        symbol="body in object",
        source="beyond",
        formula="depth^2 of the body's vertices inside the object, beyond a tolerance",
        settings=("penetration_weight",),
    )
    needs = frozenset({Data.OBJECT})

    def __init__(self, context: TermContext) -> None:
        super().__init__(context)
        weight = context.settings.penetration_weight
        self._scale = weight / PENETRATION_SIGMA**2 / VERTICES_PER_MEASUREMENT

    def add(self, state: State, equations: BandedEquations) -> None:
        posed = self.geometry.at(state)
        near = posed.proximity
        depth = excess_depth(near.distance)
        weight = np.where(depth < 0, self.geometry.skin.share[None], 0.0)
        self.add_distances(posed, near, depth, weight * self._scale, equations)


@dataclass(frozen=True)
class EmbeddedPoints:
    """K points of the object inside one body's skin, or just outside."""

    point: np.ndarray  # (K,) indices among the object's points
    vertex: np.ndarray  # (K,) nearest vertex of the skin
    normal: np.ndarray  # (K, 3) direction out of the body
    distance: np.ndarray  # (K,) metres, negative inside


def find_embedded(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> EmbeddedPoints:
    """Find points (N, 3) inside a piece of skin, or just outside.

    ``vertices`` (V, 3) and outward ``faces`` (F, 3) are the skin.
    """
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
    return EmbeddedPoints(near, vertex, normal[near], distance[near])


@dataclass(frozen=True, eq=False)
class _DeepestPoints:
    """The deepest points of the object at K vertices of the body, in one frame or in T frames."""

    vertex: np.ndarray  # (K,) of the body
    local: np.ndarray  # (..., K, 3) points in the object's frame
    normal: np.ndarray  # (..., K, 3) out of the body, master frame
    offset: np.ndarray  # (..., K) n . (v - p): height of vertex v over the nearest skin p.
    share: np.ndarray  # (..., K) number of points that each stands for

    @classmethod
    def none(cls, *frames: int, vertex: np.ndarray | None = None) -> _DeepestPoints:
        """Zeros in the given number of frames."""
        vertex = np.zeros(0, int) if vertex is None else vertex
        shape = (*frames, len(vertex))
        return cls(
            vertex, np.zeros((*shape, 3)), np.zeros((*shape, 3)), np.zeros(shape), np.zeros(shape)
        )


def _in_box(points: np.ndarray, others: np.ndarray, margin: float) -> np.ndarray:
    """Mask (N,) of points (N, 3) in the box around ``others`` (M, 3), widened by ``margin``."""
    low, high = others.min(axis=0) - margin, others.max(axis=0) + margin
    return np.asarray(((points > low) & (points < high)).all(axis=1))


class ObjectInBody(JointTerm):
    """Depth of the object's surface inside the hands, at the vertices of the skin nearest to it.

    The nearest point p of the skin and the direction n stay fixed during a round. The distance is
    d = n . (x - v) + n . (v - p): the skin at p moves along with its nearest vertex v.
    """

    name = "object_in_body"
    equation = Equation(
        symbol="object in body",
        source="beyond",
        formula="a depth^2 of the object's deepest point at each vertex of the hands beyond the "
        "same tolerance, a the area of the points inside",
        settings=("penetration_weight",),
    )
    needs = frozenset({Data.OBJECT})

    def __init__(self, context: TermContext) -> None:
        super().__init__(context)
        geometry, weight = context.geometry, context.settings.penetration_weight
        mesh = geometry.mesh
        area = float(doubled_areas(mesh.vertices, mesh.faces).sum()) / 2
        # a point every 6 mm, so that a rim shows on a fingertip; at most 6,000
        count = int(np.clip(area / 0.006**2, 1, 6000))
        samples = sample_surface(mesh.vertices, mesh.faces, count)
        self._points = samples.of(mesh.vertices, mesh.faces)
        # 10 cm^2 are one measurement (tuned on the studio): a hand's breadth of a handle
        self._scale = weight / PENETRATION_SIGMA**2 * area / count / 1e-3
        model = geometry.model
        hand = np.isin(model.skinning_weights.argmax(1).numpy(), _HANDS)
        self._hands = hand[geometry.skin.vertices]
        self._skin = np.flatnonzero(hand)  # (V,) vertex ids
        faces = model.faces.numpy()
        self._faces = np.searchsorted(self._skin, faces[hand[faces].all(axis=1)])
        self._tree = SurfaceTree(model.template.numpy()[self._skin], self._faces)
        self._deepest = _DeepestPoints.none(0)

    def refresh(self, state: State) -> None:
        """Search the object's points inside the hands."""
        posed = self.geometry.at(state)
        near = self._hands & (np.abs(posed.proximity.distance) < NEAR_SKIN)  # (T, N)
        by_frame = {}
        for at in frame_chunks(len(state)):
            touching = np.flatnonzero(near[at].any(axis=1)).tolist()
            if not touching:
                continue
            skin = posed.posed(self._skin, at)
            for row in touching:
                t = at.start + row
                by_frame[t] = self._search_frame(t, state, skin[row], posed.skin[t, near[t]])
        vertex = np.unique(np.concatenate([[], *(frame.vertex for frame in by_frame.values())]))
        deepest = _DeepestPoints.none(len(state), vertex=vertex.astype(int))
        for t, frame in by_frame.items():
            own = np.searchsorted(vertex, frame.vertex)
            deepest.local[t, own], deepest.normal[t, own] = frame.local, frame.normal
            deepest.offset[t, own], deepest.share[t, own] = frame.offset, frame.share
        self._deepest = deepest

    def _search_frame(
        self, t: int, state: State, skin: np.ndarray, around: np.ndarray
    ) -> _DeepestPoints:
        """Search frame ``t``.

        Args:
            skin: (V, 3) posed vertices of the hands.
            around: (N, 3) samples of the skin near the object.
        """
        rotation, translation = state.rotation[t], state.translation[t]
        points = self._points @ rotation.T + translation
        some = np.flatnonzero(_in_box(points, around, NEAR_SKIN / 2))
        reach = max(DEEPEST_IN_BODY, WATCHED_OUTSIDE)
        some = some[self._tree.shaped(skin).distance(points[some], reach) < reach]
        if not len(some):
            return _DeepestPoints.none()
        # faces that are nearest to a point, and their neighbours, which determine normals
        close = _in_box(skin, points[some], 2 * reach)
        used, faces = np.unique(self._faces[close[self._faces].any(axis=1)], return_inverse=True)
        embedded = find_embedded(points[some], skin[used], faces.reshape(-1, 3))
        # the deepest point at each vertex, and the number of points inside there
        order = np.argsort(embedded.distance, kind="stable")
        vertex, first = np.unique(embedded.vertex[order], return_index=True)
        inside = np.bincount(embedded.vertex, embedded.distance < -PENETRATION_TOLERANCE, len(used))
        deepest = order[first]
        at, normal = skin[used[vertex]], embedded.normal[deepest]
        point = some[embedded.point[deepest]]
        along = ((points[point] - at) * normal).sum(axis=1)
        # vertices that are inside the object themselves belong to the term body in object
        own = self.geometry.field.signed_distance((at - translation) @ rotation)
        kept = own > -PENETRATION_TOLERANCE
        return _DeepestPoints(
            self._skin[used[vertex]][kept],
            self._points[point][kept],
            normal[kept],
            (embedded.distance[deepest] - along)[kept],
            np.maximum(inside[vertex], 1.0)[kept],
        )

    def add(self, state: State, equations: BandedEquations) -> None:
        """Add the depths at ``state`` of the points of the last :meth:`refresh`."""
        posed, deepest = self.geometry.at(state), self._deepest
        points = deepest.local @ state.rotation.transpose(0, 2, 1) + state.translation[:, None]
        skin = posed.posed(deepest.vertex) if len(deepest.vertex) else points
        residual = excess_depth(((points - skin) * deepest.normal).sum(axis=2) + deepest.offset)
        weight = np.where(residual < 0, deepest.share, 0.0) * self._scale

        def rows(frames: slice, index: np.ndarray) -> np.ndarray:
            normals = deepest.normal[frames, index]
            by_body = posed.vertices_by_body(frames, deepest.vertex[index], -normals[:, :, None])
            by_object = along_by_object(points[frames, index], normals, state.translation[frames])
            return np.concatenate([by_body, by_object[:, :, None]], axis=3)

        equations.add_rows(self.name, ALL, rows, weight, residual[..., None])
