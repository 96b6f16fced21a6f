"""Geometry that several terms need at one state, computed once: skin, joints, the object."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch

from intercap_core.body.joints import NUM_JOINTS
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import BodyParameters
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.surface_tree import SurfaceTree
from intercap_core.geometry.rigid.surfaces import sample_surface
from intercap_core.geometry.solve.thread_pool import ThreadPool
from intercap_core.joint.proximity import Proximity, SearchableSurface, proximity
from intercap_core.joint.skin import Patches, SkinSamples
from intercap_core.joint.state import BODY, State, frame_chunks


class Geometry:
    """The meshes of body and object. Terms share one instance."""

    def __init__(
        self,
        model: BodyModel,
        mesh: ObjectMesh | None,
        field: DistanceField | None,
        patches: Patches,
        touched: SearchableSurface | None = None,
    ) -> None:
        """Choose samples of the skin.

        Args:
            mesh: the object; None without an object.
            field: distances to the object; None without an object.
            touched: part of the object that contact draws skin to; None for all of it.
        """
        self.model, self._mesh, self._field, self.patches = model, mesh, field, patches
        self.touched = touched
        self.skin = SkinSamples.select(model, patches)
        self._last: PosedGeometry | None = None

    @property
    def has_object(self) -> bool:
        """Whether there is an object. The object's properties need one."""
        return self._mesh is not None

    @property
    def mesh(self) -> ObjectMesh:
        """The object's mesh."""
        assert self._mesh is not None, "there is no object"
        return self._mesh

    @property
    def field(self) -> DistanceField:
        """Distances to the object's surface."""
        assert self._field is not None, "there is no object"
        return self._field

    @cached_property
    def moments(self) -> np.ndarray:
        """Six points (6, 3) that stand for the object's vertices, object frame.

        They have the mean and covariance of the vertices (:func:`moment_points`), but are at least
        0.3 m from the centre (tuned on the studio). Closer points, such as those of a thin object,
        would penalise its spin too little. At 0.3 m a hand's usual acceleration of 6 m/s^2 is
        6 / 0.3 = 20 rad/s^2.
        """
        return moment_points(self.mesh.vertices, 0.3)

    def at(self, state: State) -> PosedGeometry:
        """Return the geometry at ``state``; that of the last state object is cached."""
        if self._last is None or self._last.state is not state:
            self._last = PosedGeometry(self, state)
        return self._last


class PosedGeometry:
    """Points, distances and derivatives at a state, computed on first use; master frame, metres."""

    def __init__(self, geometry: Geometry, state: State) -> None:
        self._geometry, self.state = geometry, state

    @cached_property
    def _parameters(self) -> BodyParameters:
        return self.state.parameters(self._geometry.model)

    @cached_property
    def skin(self) -> np.ndarray:
        """Skin samples (T, N, 3)."""
        return self.posed(self._geometry.skin.vertices)

    def posed(self, vertices: np.ndarray, frames: slice = slice(None)) -> np.ndarray:
        """Positions (F, K, 3) of the body's vertices with these ids (K,) in F frames."""
        with torch.no_grad():
            body = self._geometry.model(self._parameters.frames(frames), vertex_ids=vertices)
        return body.vertices.double().numpy()

    def object_depth(self, threads: ThreadPool) -> np.ndarray:
        """Largest depth (T,) of the object's surface inside the body, metres; 0 without overlap.

        400 points of the object are compared with the whole posed body.
        """
        g, state, mesh = self._geometry, self.state, self._geometry.mesh
        points = sample_surface(mesh.vertices, mesh.faces, 400).of(mesh.vertices, mesh.faces)
        skin = SurfaceTree(g.model.template.numpy(), g.model.faces.numpy())
        vector, depth = self._parameters.vector(), np.zeros(len(state))
        for at in frame_chunks(len(state)):
            with torch.no_grad():
                bodies = g.model(g.model.parameters(vector[at]))
            posed = bodies.vertices.numpy()

            def deepest(frame: tuple[int, np.ndarray]) -> float:
                t, vertices = frame
                placed = points @ state.rotation[t].T + state.translation[t]
                in_box = (placed > vertices.min(axis=0)) & (placed < vertices.max(axis=0))
                near = placed[in_box.all(axis=1)]
                if not len(near):
                    return 0.0
                # no point is a metre deep; distances outside do not matter
                distance = skin.shaped(vertices).signed_distance(near, reach=0.01, deepest=1.0)
                return max(0.0, -float(distance.min()))

            depth[at] = threads.map(deepest, list(enumerate(posed, at.start)))
        return depth

    @cached_property
    def proximity(self) -> Proximity:
        """Distances of the skin samples to the object."""
        state = self.state
        return proximity(self._geometry.field, self.skin, state.rotation, state.translation)

    @cached_property
    def touching(self) -> Proximity:
        """Distances of the skin samples to the part of the object that contact draws them to."""
        touched, state = self._geometry.touched, self.state
        if touched is None:
            return self.proximity
        return proximity(touched, self.skin, state.rotation, state.translation)

    def skin_by_body(self, frames: slice, index: np.ndarray, axes: np.ndarray) -> np.ndarray:
        """As :meth:`vertices_by_body`, of the skin samples with these indices (K,)."""
        return self.vertices_by_body(frames, self._geometry.skin.vertices[index], axes)

    def vertices_by_body(self, frames: slice, ids: np.ndarray, axes: np.ndarray) -> np.ndarray:
        """Derivative (F, K, R, 168) of coordinates of vertices ``ids`` (K,) by the body's unknowns.

        ``frames`` is a slice of F frames. The coordinates are axis . vertex, with R ``axes``
        (F, K, R, 3) for each vertex.
        """
        model = self._geometry.model
        parameters = model.parameters(self._parameters.vector()[frames])
        lin = model.linearise(parameters, vertex_ids=ids, by_shape=False)
        along = torch.as_tensor(np.ascontiguousarray(axes), dtype=lin.points.dtype)
        return lin.along(along).double().numpy()

    @cached_property
    def joints(self) -> np.ndarray:
        """Joints (T, 55, 3)."""
        with torch.no_grad():
            body = self._geometry.model(self._parameters, vertex_ids=np.array([0]))
        return body.joints.double().numpy()

    @cached_property
    def joints_by_body(self) -> np.ndarray:
        """Derivative (T, 55, 3, 168) of the joints by the body's unknowns, float32."""
        model, vector = self._geometry.model, self._parameters.vector()
        jacobian = np.empty((len(vector), NUM_JOINTS, 3, BODY.stop), np.float32)
        for at in frame_chunks(len(vector)):
            parameters = model.parameters(vector[at])
            lin = model.linearise(
                parameters, vertex_ids=np.zeros(0, np.int64), joints=True, by_shape=False
            )
            jacobian[at] = lin.full().numpy()
        return jacobian

    @cached_property
    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Points :attr:`Geometry.moments` (T, 6, 3) and their derivative (T, 6, 3, 6)."""
        state = self.state
        return points_by_object(self._geometry.moments, state.rotation, state.translation)

    @cached_property
    def object_vertices(self) -> np.ndarray:
        """Vertices (T, V, 3) of the object."""
        turned = self._geometry.mesh.vertices @ self.state.rotation.transpose(0, 2, 1)
        return turned + self.state.translation[:, None]


def moment_points(vertices: np.ndarray, least: float = 0.0) -> np.ndarray:
    """Six points (6, 3) with the mean and covariance of ``vertices`` (V, 3).

    They are mean + and - sqrt(3 lambda_i) e_i, with lambda_i and e_i the eigenvalues and
    eigenvectors of the covariance. A sum of squares of an affine map over the vertices is V / 6
    times the same sum over these points. Points nearer to the mean than ``least``, metres, are
    moved out to this distance, which increases the covariance.
    """
    mean = vertices.mean(axis=0)
    covariance = np.cov((vertices - mean).T, bias=True)
    values, axes = np.linalg.eigh(covariance)
    arms = (axes * np.maximum(np.sqrt(3 * np.maximum(values, 0.0)), least)).T
    return np.concatenate([mean + arms, mean - arms])


def points_by_object(
    points: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Place object points (N, 3) in all frames; return them (T, N, 3) and their derivative.

    The derivative (T, N, 3, 6) is by the object's motion X' = exp(w)(X - t) + t + d, with t its
    translation: columns 0 to 2 are the turn w (rad), columns 3 to 5 the shift d (m).
    """
    arm = np.einsum("tij,nj->tni", rotation, points)
    jacobian = np.zeros((*arm.shape, 6))
    jacobian[..., 0, 1], jacobian[..., 0, 2] = arm[..., 2], -arm[..., 1]
    jacobian[..., 1, 0], jacobian[..., 1, 2] = -arm[..., 2], arm[..., 0]
    jacobian[..., 2, 0], jacobian[..., 2, 1] = arm[..., 1], -arm[..., 0]
    jacobian[..., [0, 1, 2], [3, 4, 5]] = 1.0
    return arm + translation[:, None], jacobian
