"""Smooth motion: E_S (body, A.1) and E_A (object, A.3) of equation 6.

Weighed by lambda_S and lambda_A (settings ``body_smoothness`` and ``object_smoothness``); what
differs from the paper is in :mod:`intercap_core.joint.smoothness`. Recordings of fewer than three
frames have no acceleration.

E_S of equation 6 in LEMO's learned marker space (A.1, A.2), where the user has its weights.

    E_S = k / 2 sum over t of || z(t+1) - z(t) ||^2,  Z = F_S(steps of the markers)

F_S is :class:`intercap_core.body.lemo.MotionEncoder`. It takes the place of the joints' small
accelerations (:class:`.motion.BodyMotion`) and is weighed by the same lambda_S
(``body_smoothness``). k, which stands for 1 / Q(T - 2), makes them equally strong: a body that
moves as one, with everyday accelerations that change at random, costs as much here as there before
it is robust. That follows from the user's weights and ``BODY_ACCELERATION`` alone.

Energy and gradient are exact: by automatic differentiation as far as the markers, then by the
body's Jacobian. Its curvature ties 22 frames together, three fit into the equations' bands. To
a shift in time the encoder is blind but for which side of zero its leaky ReLUs are on: with K its
derivative, z(t+1) - z(t) changes by K of the change of the steps' difference, the markers'
acceleration a. So k |K|^2 |da|^2 / 2, with the spectral norm, bounds it, and ties three frames. K
is that of the everyday motion above; where the ReLUs differ from its, or between frames, it is no
bound: a step that raises the energy is refused, as everywhere here, and damped. It is steeper than
the energy along most directions, so that steps are shorter than those of the other terms.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from intercap_core.body import lemo
from intercap_core.body.joints import JOINT_INDEX, NUM_JOINTS
from intercap_core.body.lemo import MotionEncoder
from intercap_core.joint.equations import ACCELERATION, NormalEquations
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.state import BODY, OBJECT, State
from intercap_core.joint.terms.term import Term

# Standard deviation of accelerations in everyday motion, m/s^2: trunk and limbs stay below some
# of them outside impacts, hands reach ten, carried objects are in between. Tuned on the studio.
BODY_ACCELERATION = 6.0
FINGER_ACCELERATION = 10.0
OBJECT_ACCELERATION = 6.0
# Steps of the motion that says how strong and how steep a learned prior of it is, and iterations in
# which the steepest direction is found.
PROBE_STEPS, SPECTRAL_ITERATIONS = 16, 5
# Accelerations beyond so many standard deviations count as a start, a stop or an impact. Tuned on
# the studio.
ACCELERATION_OUTLIER = 2.0

_FIRST_FINGER = JOINT_INDEX["left_index1"]  # joints from here on are the fingers'
_HIPS = [JOINT_INDEX["left_hip"], JOINT_INDEX["right_hip"]]


def accelerations(points: np.ndarray, fps: float) -> np.ndarray:
    """Second differences (T-2, N, 3) of points (T, N, 3), in units per second squared."""
    return (points[:-2] - 2 * points[1:-1] + points[2:]) * fps**2


def pseudo_huber(acceleration: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Pseudo-Huber weights (T-2, N) and energies (T-2,) of accelerations (T-2, N, 3): quadratic
    below ``scale``, linear above."""
    root = np.sqrt(1.0 + np.square(acceleration / scale).sum(axis=2))
    return 1.0 / root, scale**2 * (root - 1.0).sum(axis=1)


class BodyMotion(Term):
    """E_S: small accelerations of the 55 joints."""

    name = "body_motion"

    def __init__(self, geometry: Geometry, fps: float, weight: float) -> None:
        self._geometry, self._fps, self._weight = geometry, fps, weight
        fingers = np.arange(NUM_JOINTS) >= _FIRST_FINGER
        self._sigma = np.where(fingers, FINGER_ACCELERATION, BODY_ACCELERATION)

    def add(self, state: State, equations: NormalEquations) -> None:
        """Add E_S at ``state``."""
        if len(state) < 3:
            return
        joints, jacobian = self._geometry.at(state).joints
        acceleration = accelerations(joints, self._fps) / self._sigma[:, None]
        weight, energy = pseudo_huber(acceleration, ACCELERATION_OUTLIER)
        unit = self._fps**2 / self._sigma
        equations.add_rows(
            self.name,
            BODY,
            lambda at, some: jacobian[at, some] * unit[some, None, None],
            weight * self._weight,
            acceleration,
            energy * self._weight,
            stencil=ACCELERATION,
        )


class ObjectMotion(Term):
    """E_A: small accelerations of the object's points."""

    name = "object_motion"

    def __init__(self, geometry: Geometry, fps: float, weight: float) -> None:
        self._geometry, self._fps, self._weight = geometry, fps, weight

    def add(self, state: State, equations: NormalEquations) -> None:
        """Add E_A at ``state``."""
        if len(state) < 3:
            return
        points, jacobian = self._geometry.at(state).moments
        acceleration = accelerations(points, self._fps) / OBJECT_ACCELERATION
        weight, energy = pseudo_huber(acceleration, ACCELERATION_OUTLIER)
        unit = self._fps**2 / OBJECT_ACCELERATION
        equations.add_rows(
            self.name,
            OBJECT,
            lambda at, some: jacobian[at, some] * unit,
            weight * self._weight,
            acceleration,
            energy * self._weight,
            stencil=ACCELERATION,
        )


class LearnedMotion(Term):
    """E_S by the ``encoder``; ``up`` (3,) is the master frame's unit vector against gravity.

    For recordings of ``lemo.FEWEST_FRAMES`` or more at ``lemo.FRAMES_PER_SECOND``.
    """

    name = "body_motion"

    def __init__(
        self, geometry: Geometry, encoder: MotionEncoder, up: np.ndarray, weight: float
    ) -> None:
        self._geometry, self._encoder, self._up = geometry, encoder, up
        everyday = _everyday(encoder)
        with torch.no_grad():
            jumps = torch.diff(encoder.latents(everyday), dim=0).double()
        self._scale = weight * 3 * NUM_JOINTS / (lemo.LATENT * float(jumps.square().mean()))
        self._curvature = self._scale * _squared_norm(encoder, everyday)
        self._axes = np.eye(3)

    def refresh(self, state: State) -> None:
        """Take anew where the first frame's body faces."""
        left, right = self._geometry.at(state).joints[0][0, _HIPS]
        across = right - left - self._up * (self._up @ (right - left))
        across /= np.linalg.norm(across)
        self._axes = np.stack([across, np.cross(self._up, across), self._up])

    def add(self, state: State, equations: NormalEquations) -> None:
        """Add E_S at ``state`` with the heading of the last :meth:`refresh`."""
        markers = self._markers(state).requires_grad_()
        jumps = torch.diff(self._encoder.latents(self._steps(markers)), dim=0)
        energy = 0.5 * self._scale * jumps.double().square().sum(dim=1)
        (force,) = torch.autograd.grad(energy.sum(), markers)
        posed, ids = self._geometry.at(state), self._geometry.model.markers
        every = slice(0, len(state))
        along = posed.vertices_by_body(every, ids, force.double().cpu().numpy()[:, :, None])
        columns = BODY.stop - BODY.start
        flat = np.broadcast_to(0.0, (len(state), columns, columns))
        gradient = along.sum(axis=(1, 2))
        equations.add_blocks(self.name, BODY, flat, gradient, np.zeros(len(state)))

        def rows(frames: slice, index: np.ndarray) -> np.ndarray:
            count = frames.stop - frames.start
            axes = np.broadcast_to(np.eye(3), (count, len(index), 3, 3))
            return posed.vertices_by_body(frames, ids[index], axes)

        spread = self._encoder.spread.double().cpu().numpy().reshape(-1, 3)
        steepness = self._curvature / np.square(spread).min(axis=1)
        equations.add_rows(
            self.name,
            BODY,
            rows,
            np.tile(steepness, (len(state) - 2, 1)),
            np.zeros((len(state) - 2, len(ids), 3)),
            energy.detach().cpu().numpy(),
            stencil=ACCELERATION,
        )

    def _markers(self, state: State) -> Tensor:
        """(T, 81, 3), master frame, metres."""
        model = self._geometry.model
        with torch.no_grad():
            found = model(state.parameters(model), vertex_ids=model.markers).vertices
        return found.to(self._encoder.spread)

    def _steps(self, markers: Tensor) -> Tensor:
        """Steps (T - 1, 243) of the markers, in the first frame's body's frame, metres."""
        axes = torch.as_tensor(self._axes).to(markers)
        return torch.diff(markers @ axes.T, dim=0).flatten(1)


def _everyday(encoder: MotionEncoder) -> Tensor:
    """Steps (N, 243), metres, of a body that moves as one with random accelerations of
    ``BODY_ACCELERATION``, the same at every call."""
    generator = torch.Generator().manual_seed(0)
    change = torch.randn(PROBE_STEPS, 3, dtype=torch.float64, generator=generator)
    steps = torch.cumsum(change * BODY_ACCELERATION / lemo.FRAMES_PER_SECOND**2, dim=0)
    return steps.to(encoder.spread).repeat(1, lemo.COORDINATES // 3)


def _squared_norm(encoder: MotionEncoder, steps: Tensor) -> float:
    """Largest eigenvalue of K^T K, estimated from below, K the derivative of the latents by steps
    (N, 243) over their spread; by power iteration from a body that moves as one."""
    along = torch.ones_like(steps) / steps.numel() ** 0.5
    largest = 0.0
    for _ in range(SPECTRAL_ITERATIONS):
        turned = torch.func.jvp(encoder.latents, (steps,), (along * encoder.spread,))[1]
        at = steps.clone().requires_grad_()
        (back,) = torch.autograd.grad(encoder.latents(at), at, turned)
        along = back * encoder.spread
        largest = float(along.norm())
        along = along / largest
    return largest
