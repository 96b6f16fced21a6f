"""The energy of equation 6 around one state, as normal equations.

Every residual is divided by the standard deviation that its source leaves unexplained, so that a
term's weight in the settings is 1 where it is as strong as its evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from intercap_core.body.model import BodyModel
from intercap_core.config import JointSettings
from intercap_core.contact.patches import Patches
from intercap_core.energy import contact, ground, penetration, smoothness
from intercap_core.energy.proximity import Proximity, proximity
from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.skin import Skin
from intercap_core.joint.state import BODY, OBJECT, SIZE, State
from intercap_core.rigid.distance import DistanceField
from intercap_core.rigid.mesh import ObjectMesh

# What is left of a true contact after skin, mesh and calibration errors, metres. A patch counts as
# one measurement, and so do about ten neighbouring vertices inside the object or under the floor.
CONTACT_SIGMA = 0.003
PENETRATION_SIGMA = 0.003
GROUND_SIGMA = 0.005
VERTICES_PER_MEASUREMENT = 10.0
# Accelerations of everyday motion, m/s^2: trunk and limbs stay below some of them outside impacts,
# hands reach ten, carried objects are in between.
BODY_ACCELERATION = 6.0
FINGER_ACCELERATION = 10.0
OBJECT_ACCELERATION = 6.0
# How fast a sequential fit's lasting errors change: a random walk, metres in one second.
BODY_DRIFT = 0.010
OBJECT_DRIFT = 0.004
STILL = 2e-5  # metres that an object at rest moves between frames
# Neighbouring points move as one: so many of them are one measurement of a correction.
POINTS_PER_MOTION = {"body_drift": 2.0, "object_drift": 2.0}
ROBUST_FACTOR = 2.0  # accelerations beyond so many sigmas count as a start, a stop or an impact
_FIRST_FINGER = 25


@dataclass(frozen=True)
class Ground:
    """A floor: ``point`` (3,) and upward unit ``normal`` (3,), master frame, metres."""

    point: np.ndarray
    normal: np.ndarray


@dataclass
class Problem:
    """All that equation 6 needs beside the state.

    ``start`` is the sequential fits' state, ``body_known`` and ``object_known`` (T,) the frames in
    which they are believed, ``object_still`` (T-1,) the steps over which the object rests. ``data``
    add E_B and E_O to the equations; ``probability`` (T, R) that each region touches (Q); ``floor``
    is None where none was seen.
    """

    model: BodyModel
    mesh: ObjectMesh
    field: DistanceField
    patches: Patches
    data: Sequence[Callable[[State, NormalEquations], None]]
    probability: np.ndarray
    floor: Ground | None
    fps: float
    settings: JointSettings
    start: State
    body_known: np.ndarray
    object_known: np.ndarray
    object_still: np.ndarray

    def __post_init__(self) -> None:
        self.skin = Skin.watch(self.model, self.patches)
        self._moments = smoothness.moment_points(self.mesh.vertices)
        fingers = np.arange(55) >= _FIRST_FINGER
        self._joint_sigma = np.where(fingers, FINGER_ACCELERATION, BODY_ACCELERATION)
        parameters = self.start.parameters(self.model)
        joints = self.model(parameters, vertex_ids=np.array([0])).joints
        self._start_joints = joints.double().cpu().numpy()
        self._start_object, _ = smoothness.points_by_object(
            self._moments, self.start.rotation, self.start.translation
        )
        self.refresh(self.start)

    def equations(self, state: State) -> NormalEquations:
        """Linearise every term at ``state``."""
        out = NormalEquations(len(state))
        for add in self.data:
            add(state, out)
        self._near_object(state, out)
        self._body_motion(state, out)
        self._object_motion_and_ground(state, out)
        return out

    def refresh(self, state: State) -> None:
        """Take anew which vertices carry the contact and on how many the object stands."""
        near = self.proximity(state)[1].distance[:, self.skin.patch]
        self._spread = contact.shares(near, self.patches.patch, self.patches.region_of_patch)
        if self.floor is not None:
            below = (
                ground.residuals(self._object_at(state), self.floor.point, self.floor.normal) < 0
            )
            self._standing = np.maximum(below.sum(axis=1, keepdims=True), 4)

    def proximity(self, state: State) -> tuple[np.ndarray, Proximity]:
        """Skin vertices (T, N, 3) in the master frame, and their distance to the object."""
        with torch.no_grad():
            body = self.model(state.parameters(self.model), vertex_ids=self.skin.vertices)
        points = body.vertices.double().cpu().numpy()
        return points, proximity(self.field, points, state.rotation, state.translation)

    def _near_object(self, state: State, out: NormalEquations) -> None:
        """E_C and E_P, and E_G of the same vertices."""
        points, near = self.proximity(state)
        probability = self.probability[:, self.patches.region_of_patch]
        at_patch = near.distance[:, self.skin.patch]
        touch, weight, energy = contact.term(
            at_patch, self.patches.patch, self._spread, probability
        )
        scale = self.settings.contact_weight / CONTACT_SIGMA**2
        residual, touching = np.zeros_like(near.distance), np.zeros_like(near.distance)
        residual[:, self.skin.patch], touching[:, self.skin.patch] = touch, weight * scale
        self._add_coupled("contact", state, near, residual, touching, energy * scale, out)
        deep, inside = penetration.weights(near.distance, self.skin.share)
        scale = self.settings.penetration_weight / PENETRATION_SIGMA**2 / VERTICES_PER_MEASUREMENT
        self._add_coupled("penetration", state, near, deep, inside * scale, None, out)
        if self.floor is not None:
            height = ground.residuals(points, self.floor.point, self.floor.normal)
            below = np.where(height < 0, self.skin.share, 0.0)
            below *= self.settings.ground_weight / GROUND_SIGMA**2 / VERTICES_PER_MEASUREMENT
            active = np.flatnonzero(below.any(axis=0))
            normal = np.broadcast_to(self.floor.normal, points.shape)
            rows = self._body_rows(state, normal, active)
            out.add_rows("ground", slice(0, BODY), rows, below[:, active], height[:, active])

    def _body_rows(self, state: State, normals: np.ndarray, index: np.ndarray) -> np.ndarray:
        """Rows (T, A, 168) of n^T d point / d body for the skin vertices ``index`` (A,), with
        ``normals`` (T, N, 3) of all."""
        if not len(index):
            return np.zeros((len(state), 0, BODY))
        lin = self.model.linearise(
            state.parameters(self.model), vertex_ids=self.skin.vertices[index]
        )
        directions = torch.as_tensor(
            np.ascontiguousarray(normals[:, index]),
            dtype=lin.points.dtype,
            device=lin.points.device,
        )
        return lin.along(directions[:, :, None])[:, :, 0, :BODY].double().cpu().numpy()

    def _add_coupled(
        self,
        term: str,
        state: State,
        near: Proximity,
        residual: np.ndarray,
        weight: np.ndarray,
        energy: float | None,
        out: NormalEquations,
    ) -> None:
        """Rows that move with both the body and the object."""
        index = np.flatnonzero(weight.any(axis=0))
        rows = np.concatenate(
            [self._body_rows(state, near.normals, index), near.by_object[:, index]], axis=2
        )
        out.add_rows(term, slice(0, SIZE), rows, weight[:, index], residual[:, index], energy)

    def _object_at(self, state: State) -> np.ndarray:
        """The object's vertices (T, V, 3) in the master frame."""
        turned = np.einsum("tij,nj->tni", state.rotation, self.mesh.vertices)
        return turned + state.translation[:, None]

    def _body_motion(self, state: State, out: NormalEquations) -> None:
        """E_S on the 55 joints."""
        lin = self.model.linearise(
            state.parameters(self.model), vertex_ids=np.zeros(0, np.int64), joints=True
        )
        joints = lin.joints.double().cpu().numpy()
        frames = len(joints)
        if frames < 3:
            return
        acceleration = smoothness.accelerations(joints, self.fps) / self._joint_sigma[:, None]
        weight, energy = smoothness.robust(acceleration, ROBUST_FACTOR)
        weight = np.repeat(weight * self.settings.body_smoothness, 3, axis=1)
        jacobian = lin.full()[..., :BODY].double().cpu().numpy()
        out.add_differences(
            "body_motion",
            slice(0, BODY),
            smoothness.ACCELERATION,
            (jacobian * (self.fps**2 / self._joint_sigma[:, None, None])).reshape(frames, -1, BODY),
            weight,
            acceleration.reshape(frames - 2, -1),
            energy * self.settings.body_smoothness,
        )
        self._add_drift(
            "body_drift", slice(0, BODY), joints, self._start_joints, jacobian, BODY_DRIFT,
            self.body_known, np.zeros(frames - 1, bool), out,
        )  # fmt: skip

    def _add_drift(
        self,
        term: str,
        columns: slice,
        points: np.ndarray,
        start: np.ndarray,
        jacobian: np.ndarray,
        drift: float,
        known: np.ndarray,
        still: np.ndarray,
        out: NormalEquations,
    ) -> None:
        """Corrections of points (T, N, 3) against the sequential fit's change slowly, and not at
        all over ``still`` (T-1,) steps."""
        frames, count = points.shape[:2]
        noise = smoothness.jitter(start, known)
        sigma = np.sqrt(drift**2 / self.fps + 2 * noise**2)
        change = np.diff(points - start, axis=0).reshape(frames - 1, -1)
        slow = known[1:] & known[:-1] & ~still
        for pairs, limit, tie in ((slow, sigma, False), (still, STILL, True)):
            weight = np.repeat(pairs[:, None] / limit**2, 3 * count, axis=1)
            weight /= POINTS_PER_MOTION[term]
            out.add_differences(
                term,
                columns,
                smoothness.RATE,
                jacobian.reshape(frames, 3 * count, -1),
                weight,
                change,
                0.5 * float((weight * change**2).sum()),
                tie=tie,
            )

    def _object_motion_and_ground(self, state: State, out: NormalEquations) -> None:
        """E_A and E_G'."""
        points, jacobian = smoothness.points_by_object(
            self._moments, state.rotation, state.translation
        )
        frames = len(points)
        if frames >= 3:
            acceleration = smoothness.accelerations(points, self.fps) / OBJECT_ACCELERATION
            weight, energy = smoothness.robust(acceleration, ROBUST_FACTOR)
            weight = np.repeat(weight * self.settings.object_smoothness, 3, axis=1)
            out.add_differences(
                "object_motion",
                OBJECT,
                smoothness.ACCELERATION,
                jacobian.reshape(frames, -1, 6) * (self.fps**2 / OBJECT_ACCELERATION),
                weight,
                acceleration.reshape(frames - 2, -1),
                energy * self.settings.object_smoothness,
            )
            self._add_drift(
                "object_drift", OBJECT, points, self._start_object, jacobian, OBJECT_DRIFT,
                self.object_known, self.object_still, out,
            )  # fmt: skip
        if self.floor is not None:
            moved = self._object_at(state)
            height = ground.residuals(moved, self.floor.point, self.floor.normal)
            # the object stands on few vertices: together they count as one measurement
            weight = (height < 0) / self._standing
            weight = weight * self.settings.ground_weight / GROUND_SIGMA**2
            rows = ground.by_object(moved, state.translation, self.floor.normal)
            out.add_rows("ground", OBJECT, rows, weight, height)
