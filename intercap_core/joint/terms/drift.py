"""Drift (beyond the paper): corrections of the sequential fits change slowly.

    E = 1/2 sum over t, i of |c_i(t+1) - c_i(t)|^2 / (2 sigma^2),  c = X - X_sequential

Errors of a sequential fit last: those of calibration, clothing and masks are the same in the next
frame. sigma^2 is the variance of a random walk over one frame plus twice that of the sequential
fit's jitter. X are joints i of the body or points i of the object in frame t; neighbouring points
err alike, which the factor 1/2 accounts for. Without these terms contact that comes and
goes would shake a steady fit. While the object rests, its corrections are the same in all frames.
Weighed by the setting ``drift_weight``, except for the object at rest.
"""

from __future__ import annotations

import numpy as np
import torch

from intercap_core.geometry.solve.robust import SIGMA_PER_MAD
from intercap_core.joint.equations import RATE, BandedEquations, Rows
from intercap_core.joint.state import BODY, OBJECT, State
from intercap_core.joint.terms.term import Data, Equation, JointTerm, TermContext

# Change of a sequential fit's lasting errors: a random walk, m in one second. Tuned on the studio:
# without both terms the object's error has a 95th percentile of 8.0 mm, with them 4.9
# (bench/RESULTS.md, commit 86d72be).
BODY_DRIFT, OBJECT_DRIFT = 0.010, 0.004


def jitter(points: np.ndarray, valid: np.ndarray) -> float:
    """Standard deviation of the frame-to-frame noise in points (T, N, 3), metres.

    From the median size of fourth differences, which motion itself hardly has. Only runs of five
    ``valid`` (T,) frames count; 0 if there is none.
    """
    stencil = (1.0, -4.0, 6.0, -4.0, 1.0)
    count = len(points) - len(stencil) + 1
    if count < 1:
        return 0.0
    whole = np.all([valid[k : k + count] for k in range(len(stencil))], axis=0)
    if not whole.any():
        return 0.0
    fourth = np.sum([f * points[k : k + count] for k, f in enumerate(stencil)], axis=0)
    return float(
        SIGMA_PER_MAD * np.median(np.abs(fourth[whole])) / np.sqrt(np.square(stencil).sum())
    )


class _Drift(JointTerm):
    """A term of changes of corrections from frame to frame."""

    def _sigma(self, points: np.ndarray, trusted: np.ndarray, drift: float, fps: float) -> float:
        """Standard deviation of the change of a correction between frames, metres."""
        noise = jitter(points, trusted)
        return np.sqrt(drift**2 / fps + 2 * noise**2)

    def _add_changes(
        self,
        columns: slice,
        correction: np.ndarray,
        rows: Rows,
        weights: np.ndarray,
        equations: BandedEquations,
        *,
        stiff: bool = False,
    ) -> None:
        """Add the changes of ``correction`` (T, N, 3), metres.

        Args:
            rows: derivatives of the points by the unknowns ``columns``.
            weights: (T - 1,) weight of each step, 1/m^2.
            stiff: leave these rows out of the damping.
        """
        change = np.diff(correction, axis=0)
        weight = np.repeat(weights[:, None], change.shape[1], axis=1)
        equations.add_rows(
            self.name,
            columns,
            rows,
            weight / 2.0,  # neighbouring points move as one: two are one measurement (tuned)
            change,
            stencil=RATE,
            stiff=stiff,
        )


class BodyDrift(_Drift):
    """Drift of the 55 joints between frames in which the body fit is trusted."""

    name = "body_drift"
    equation = Equation(
        symbol="drift of the body",
        source="beyond",
        formula="\\|\\|c(t+1) - c(t)\\|\\|^2 / (4 sigma^2), c the correction of a joint of the "
        "sequential fit, sigma its change in a frame",
        settings=("drift_weight",),
    )

    def __init__(self, context: TermContext) -> None:
        super().__init__(context)
        model, trusted = self.geometry.model, context.trust.body
        with torch.no_grad():
            body = model(context.start.parameters(model), vertex_ids=np.array([0]))
        self._sequential = body.joints.double().numpy()
        sigma = self._sigma(self._sequential, trusted, BODY_DRIFT, context.fps)
        self._weights = context.settings.drift_weight * (trusted[1:] & trusted[:-1]) / sigma**2

    def add(self, state: State, equations: BandedEquations) -> None:
        if len(state) < 3:
            return
        posed = self.geometry.at(state)
        self._add_changes(
            BODY,
            posed.joints - self._sequential,
            lambda at, some: posed.joints_by_body[at, some],
            self._weights,
            equations,
        )


class ObjectDrift(_Drift):
    """Drift of the object's points between frames in which the track is trusted.

    Over steps in which the object rests, its corrections are the same instead.
    """

    name = "object_drift"
    equation = Equation(
        symbol="drift of the object",
        source="beyond",
        formula="the same of the object's points; an object at rest stays at rest",
        settings=("drift_weight",),
    )
    needs = frozenset({Data.OBJECT})

    def __init__(self, context: TermContext) -> None:
        super().__init__(context)
        trusted, resting = context.trust.object_, context.trust.still
        self._sequential, _ = self.geometry.at(context.start).moments
        sigma = self._sigma(self._sequential, trusted, OBJECT_DRIFT, context.fps)
        moving = trusted[1:] & trusted[:-1] & ~resting
        self._weights = context.settings.drift_weight * moving / sigma**2
        # an object at rest moves 0.02 mm between frames: practically not (tuned on the studio)
        self._resting = resting.astype(float) / 2e-5**2

    def add(self, state: State, equations: BandedEquations) -> None:
        if len(state) < 3:
            return
        points, jacobian = self.geometry.at(state).moments
        correction = points - self._sequential

        def rows(at: slice, some: np.ndarray) -> np.ndarray:
            return jacobian[at, some]

        self._add_changes(OBJECT, correction, rows, self._weights, equations)
        self._add_changes(OBJECT, correction, rows, self._resting, equations, stiff=True)
