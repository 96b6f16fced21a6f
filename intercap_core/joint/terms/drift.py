"""Drift (beyond the paper): corrections of the sequential fits change slowly.

    E = sum over frames t, points i of |c_i(t+1) - c_i(t)|^2 / (2 sigma^2),  c = X - X_sequential

A sequential fit's errors last: calibration, clothing and a mask's errors are the same in the next
frame. sigma^2 is that of a random walk over one frame plus the sequential fit's own jitter.
Without it contact that comes and goes would shake a fit that was steady. While the object rests
(``object_still``) its corrections are the same in all frames. Weighed by ``drift_weight``, but for
what rests.
"""

from __future__ import annotations

import numpy as np
import torch

from intercap_core.geometry.solve.robust import SIGMA_PER_MAD
from intercap_core.joint.equations import RATE, NormalEquations
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.state import BODY, OBJECT, State
from intercap_core.joint.terms.term import Term

# How fast they change: a random walk, metres in one second. Tuned on the studio.
BODY_DRIFT = 0.010
OBJECT_DRIFT = 0.004
# Points of the body or the object whose corrections are one measurement: neighbouring points move
# as one. Tuned on the studio.
DRIFT_POINTS_PER_MEASUREMENT = 2.0
# Distance that an object at rest moves between frames, metres: practically none. Tuned on the
# studio.
RESTING_SIGMA = 2e-5

_FOURTH = (1.0, -4.0, 6.0, -4.0, 1.0)


def jitter(points: np.ndarray, valid: np.ndarray) -> float:
    """Standard deviation, in metres, of noise that is independent from frame to frame in points
    (T, N, 3), from the median size of fourth differences: motion itself hardly has any. Only runs
    of ``valid`` (T,) frames count; 0 where there is none of five."""
    count = len(points) - len(_FOURTH) + 1
    if count < 1:
        return 0.0
    whole = np.all([valid[k : k + count] for k in range(len(_FOURTH))], axis=0)
    if not whole.any():
        return 0.0
    fourth = np.sum([f * points[k : k + count] for k, f in enumerate(_FOURTH)], axis=0)
    return float(
        SIGMA_PER_MAD * np.median(np.abs(fourth[whole])) / np.sqrt(np.square(_FOURTH).sum())
    )


class BodyDrift(Term):
    """Drift of the 55 joints between frames in which the body fit is ``trusted`` (T,)."""

    name = "body_drift"

    def __init__(
        self,
        geometry: Geometry,
        sequential: State,
        fps: float,
        trusted: np.ndarray,
        weight: float,
    ) -> None:
        self._geometry = geometry
        model = geometry.model
        with torch.no_grad():
            body = model(sequential.parameters(model), vertex_ids=np.array([0]))
        self._sequential = body.joints.double().cpu().numpy()
        self._sigma = _sigma(self._sequential, trusted, BODY_DRIFT, fps)
        self._weights = weight * (trusted[1:] & trusted[:-1])

    def add(self, state: State, equations: NormalEquations) -> None:
        """Add the drift at ``state``."""
        if len(state) < 3:
            return
        joints, jacobian = self._geometry.at(state).joints
        correction = joints - self._sequential
        _add_pairs(self.name, BODY, correction, jacobian, self._weights, self._sigma, equations)


class ObjectDrift(Term):
    """Drift of the object's points between frames in which the track is ``trusted`` (T,);
    none over the steps ``still`` (T-1,) in which the object rests."""

    name = "object_drift"

    def __init__(
        self,
        geometry: Geometry,
        sequential: State,
        fps: float,
        trusted: np.ndarray,
        still: np.ndarray,
        weight: float,
    ) -> None:
        self._geometry = geometry
        self._sequential, _ = geometry.at(sequential).moments
        self._sigma = _sigma(self._sequential, trusted, OBJECT_DRIFT, fps)
        self._weights = weight * (trusted[1:] & trusted[:-1] & ~still)
        self._still = still.astype(float)

    def add(self, state: State, equations: NormalEquations) -> None:
        """Add the drift at ``state``."""
        if len(state) < 3:
            return
        points, jacobian = self._geometry.at(state).moments
        correction = points - self._sequential
        _add_pairs(self.name, OBJECT, correction, jacobian, self._weights, self._sigma, equations)
        _add_pairs(
            self.name,
            OBJECT,
            correction,
            jacobian,
            self._still,
            RESTING_SIGMA,
            equations,
            stiff=True,
        )


def _sigma(points: np.ndarray, trusted: np.ndarray, drift: float, fps: float) -> float:
    """Standard deviation, in metres, of the change of corrections from frame to frame."""
    noise = jitter(points, trusted)
    return np.sqrt(drift**2 / fps + 2 * noise**2)


def _add_pairs(
    name: str,
    columns: slice,
    correction: np.ndarray,
    jacobian: np.ndarray,
    weights: np.ndarray,
    sigma: float,
    equations: NormalEquations,
    *,
    stiff: bool = False,
) -> None:
    """Add the changes of ``correction`` (T, N, 3) over each step, by ``weights`` (T-1,), with the
    points' ``jacobian`` (T, N, 3, m) over ``columns`` and standard deviation ``sigma``, metres."""
    change = np.diff(correction, axis=0)
    weight = np.repeat(weights[:, None] / sigma**2, change.shape[1], axis=1)
    equations.add_rows(
        name,
        columns,
        lambda at, some: jacobian[at, some],
        weight / DRIFT_POINTS_PER_MEASUREMENT,
        change,
        stencil=RATE,
        stiff=stiff,
    )
