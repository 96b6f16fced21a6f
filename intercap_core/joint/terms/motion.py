"""Smooth motion: E_S (body, A.1) and E_A (object, A.3) of equation 6.

    E_A = 1 / (T - 2) sum over t of || W'_(t-1) + W'_(t+1) - 2 W'_t ||^2  over object vertices W'
    E_S = 1 / (Q (T - 2)) sum over t of || z_(t+1) - z_t ||^2  over latents z of LEMO's network

with T frames, the latent vectors z of A.2, and Q, the number of LEMO's virtual markers. E_S is
:class:`LearnedMotion` if the user supplies LEMO's weights; otherwise :class:`BodyMotion`, which has
E_A's form over the body's joints. For a rigid body E_A depends on the vertices only through their
mean and covariance, so that six points with the same moments give the same energy.

Beyond the paper E_A and :class:`BodyMotion` are robust, since a start, a stop or an impact is an
outlier of smooth motion. They are weighed by lambda_S and lambda_A (settings ``body_smoothness``
and ``object_smoothness``). Recordings of fewer than three frames have no acceleration.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from intercap_core.body import lemo
from intercap_core.body.joints import JOINT_INDEX, NUM_JOINTS
from intercap_core.body.lemo import MotionEncoder
from intercap_core.joint.equations import ACCELERATION, BandedEquations, Rows
from intercap_core.joint.state import BODY, OBJECT, State
from intercap_core.joint.terms.term import Data, Equation, JointTerm, TermContext

# Standard deviations of accelerations in everyday motion. Tuned on the studio: without E_S and E_A
# the body's acceleration errs by 0.75 mm a frame^2, with them by 0.71 (bench/RESULTS.md, commit
# 86d72be).
BODY_ACCELERATION = 6.0  # m/s^2, of body and carried objects
ACCELERATION_OUTLIER = 2.0  # standard deviations: a start, a stop, an impact; tuned on the studio

_HIPS = [JOINT_INDEX["left_hip"], JOINT_INDEX["right_hip"]]


def accelerations(points: np.ndarray, fps: float) -> np.ndarray:
    """Second differences (T-2, N, 3) of points (T, N, 3), in units per second squared."""
    return (points[:-2] - 2 * points[1:-1] + points[2:]) * fps**2


class _Smoothness(JointTerm):
    """Robust squared accelerations of points."""

    def __init__(self, context: TermContext) -> None:
        super().__init__(context)
        self._fps, self._settings = context.fps, context.settings

    def _add_accelerations(
        self,
        columns: slice,
        points: np.ndarray,
        rows: Rows,
        factor: float,
        equations: BandedEquations,
    ) -> None:
        """Add the accelerations of points (T, N, 3), if there are three frames or more.

        Args:
            rows: derivatives of the points by the unknowns ``columns``.
            factor: weight of the term.
        """
        if len(points) < 3:
            return
        acceleration = accelerations(points, self._fps) / BODY_ACCELERATION
        # pseudo-Huber: quadratic below ACCELERATION_OUTLIER, linear above
        root = np.sqrt(1.0 + np.square(acceleration / ACCELERATION_OUTLIER).sum(axis=2))
        energy = ACCELERATION_OUTLIER**2 * (root - 1.0).sum(axis=1)
        unit = self._fps**2 / BODY_ACCELERATION
        equations.add_rows(
            self.name,
            columns,
            lambda at, some: rows(at, some) * unit,
            1.0 / root * factor,
            acceleration,
            energy * factor,
            stencil=ACCELERATION,
        )


class BodyMotion(_Smoothness):
    """E_S without LEMO: small accelerations of the 55 joints."""

    name = "body_motion"
    equation = Equation(
        symbol="E_S",
        source="6, A.1",
        formula="robust squared accelerations of the joints",
        settings=("body_smoothness",),
    )

    @classmethod
    def applies(cls, context: TermContext) -> bool:
        """Whether the settings name no learned E_S."""
        return context.encoder is None

    def add(self, state: State, equations: BandedEquations) -> None:
        posed, factor = self.geometry.at(state), self._settings.body_smoothness
        self._add_accelerations(
            BODY, posed.joints, lambda at, some: posed.joints_by_body[at, some], factor, equations
        )


class ObjectMotion(_Smoothness):
    """E_A: small accelerations of the object's points."""

    name = "object_motion"
    equation = Equation(
        symbol="E_A",
        source="6, A.3",
        formula="robust \\|\\|W'(t-1) + W'(t+1) - 2 W'(t)\\|\\|^2",
        settings=("object_smoothness",),
    )
    needs = frozenset({Data.OBJECT})

    def add(self, state: State, equations: BandedEquations) -> None:
        points, jacobian = self.geometry.at(state).moments
        factor = self._settings.object_smoothness
        self._add_accelerations(
            OBJECT, points, lambda at, some: jacobian[at, some], factor, equations
        )


class LearnedMotion(JointTerm):
    """E_S in the latent space of LEMO's marker encoder (A.1, A.2).

        E_S = k / 2 sum over t of || z(t+1) - z(t) ||^2,  Z = F_S(steps of the markers)

    F_S is :class:`intercap_core.body.lemo.MotionEncoder`. The factor k, which includes the setting,
    replaces 1 / Q(T - 2). It is chosen on an "everyday motion", a body that translates with random
    accelerations of ``BODY_ACCELERATION``: E_S costs as much there as plain squares of all joints'
    accelerations over ``BODY_ACCELERATION`` (:class:`BodyMotion` without robustness).

    Energy and gradient are exact: automatic differentiation up to the markers, then the body's
    Jacobian. The exact curvature couples 22 frames, but the bands of the equations hold only three,
    so that an upper bound replaces it:

    - Let K be the encoder's derivative by steps over their spread, and da a change of the markers'
      accelerations (second differences over spread).
    - If all leaky ReLUs keep their signs, the encoder commutes with a shift in time. Then
      z(t+1) - z(t) changes by K da, and the energy's second-order part is at most
      k |K|^2 |da|^2 / 2 with the spectral norm |K|.

    |K| is computed at the everyday motion. Where ReLUs have other signs, the bound may not hold; a
    step that raises the energy is then refused and damped.
    """

    name = "body_motion"
    equation = Equation(
        symbol="E_S with LEMO's encoder",
        source="6, A.1, A.2",
        formula="k \\|\\|z(t+1) - z(t)\\|\\|^2 of the encoder's latents z",
        settings=("body_smoothness", "lemo"),
    )

    def __init__(self, context: TermContext) -> None:
        super().__init__(context)
        encoder = context.encoder
        assert encoder is not None and context.up is not None, "the term needs encoder and floor"
        self._encoder, self._up = encoder, context.up
        everyday = _everyday(encoder)
        with torch.no_grad():
            jumps = torch.diff(encoder.latents(everyday), dim=0).double()
        weight, size = context.settings.body_smoothness, jumps.shape[1]
        self._scale = weight * 3 * NUM_JOINTS / (size * float(jumps.square().mean()))
        self._curvature = self._scale * _squared_norm(encoder, everyday)
        self._axes = np.eye(3)

    @classmethod
    def applies(cls, context: TermContext) -> bool:
        """Whether the settings name LEMO's weights."""
        return context.encoder is not None

    def refresh(self, state: State) -> None:
        """Set the encoder's axes to the heading of the body in the first frame."""
        left, right = self.geometry.at(state).joints[0, _HIPS]
        across = right - left - self._up * (self._up @ (right - left))
        across /= np.linalg.norm(across)
        self._axes = np.stack([across, np.cross(self._up, across), self._up])

    def add(self, state: State, equations: BandedEquations) -> None:
        """Add E_S at ``state`` with the heading of the last :meth:`refresh`."""
        markers = self._markers(state).requires_grad_()
        jumps = torch.diff(self._encoder.latents(self._steps(markers)), dim=0)
        energy = 0.5 * self._scale * jumps.double().square().sum(dim=1)
        (force,) = torch.autograd.grad(energy.sum(), markers)
        posed, ids = self.geometry.at(state), self.geometry.model.markers
        every = slice(0, len(state))
        along = posed.vertices_by_body(every, ids, force.double().numpy()[:, :, None])
        # exact energy and gradient without curvature; then the bound of the curvature, as rows
        # without residuals
        columns = BODY.stop - BODY.start
        flat = np.broadcast_to(0.0, (len(state), columns, columns))
        gradient = along.sum(axis=(1, 2))
        equations.add_blocks(self.name, BODY, flat, gradient, np.zeros(len(state)))

        def rows(frames: slice, index: np.ndarray) -> np.ndarray:
            count = frames.stop - frames.start
            axes = np.broadcast_to(np.eye(3), (count, len(index), 3, 3))
            return posed.vertices_by_body(frames, ids[index], axes)

        spread = self._encoder.spread.double().numpy().reshape(-1, 3)
        steepness = self._curvature / np.square(spread).min(axis=1)
        equations.add_rows(
            self.name,
            BODY,
            rows,
            np.tile(steepness, (len(state) - 2, 1)),
            np.zeros((len(state) - 2, len(ids), 3)),
            energy.detach().numpy(),
            stencil=ACCELERATION,
        )

    def _markers(self, state: State) -> Tensor:
        """Markers (T, 81, 3), master frame, metres."""
        model = self.geometry.model
        with torch.no_grad():
            vertices = model(state.parameters(model), vertex_ids=model.markers).vertices
        return vertices.to(self._encoder.spread)

    def _steps(self, markers: Tensor) -> Tensor:
        """Steps (T - 1, 243) of the markers along the axes of the first body, metres."""
        axes = torch.as_tensor(self._axes).to(markers)
        return torch.diff(markers @ axes.T, dim=0).flatten(1)


def _everyday(encoder: MotionEncoder) -> Tensor:
    """Steps (16, 243), metres, of a body that translates with random accelerations (seeded)."""
    generator = torch.Generator().manual_seed(0)
    change = torch.randn(16, 3, dtype=torch.float64, generator=generator)
    steps = torch.cumsum(change * BODY_ACCELERATION / lemo.FRAMES_PER_SECOND**2, dim=0)
    return steps.to(encoder.spread).repeat(1, lemo.COORDINATES // 3)


def _squared_norm(encoder: MotionEncoder, steps: Tensor) -> float:
    """Largest eigenvalue of K^T K by power iteration, an estimate from below.

    K is the derivative of the latents by ``steps`` (N, 243) over their spread.
    """
    along = torch.ones_like(steps) / steps.numel() ** 0.5
    largest = 0.0
    for _ in range(5):
        turned = torch.func.jvp(encoder.latents, (steps,), (along * encoder.spread,))[1]
        at = steps.clone().requires_grad_()
        (back,) = torch.autograd.grad(encoder.latents(at), at, turned)
        along = back * encoder.spread
        largest = float(along.norm())
        along = along / largest
    return largest
