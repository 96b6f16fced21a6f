"""Smooth motion: E_S (body, A.1) and E_A (object, A.3) of equation 6.

Weighed by lambda_S and lambda_A (settings ``body_smoothness`` and ``object_smoothness``); what
differs from the paper is in :mod:`intercap_core.joint.smoothness`. Recordings of fewer than three
frames have no acceleration.
"""

from __future__ import annotations

import numpy as np

from intercap_core.body.joints import JOINT_INDEX, NUM_JOINTS
from intercap_core.joint import smoothness as smoothness
from intercap_core.joint.constants import (
    ACCELERATION_OUTLIER,
    BODY_ACCELERATION,
    FINGER_ACCELERATION,
    OBJECT_ACCELERATION,
)
from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.state import BODY, OBJECT, State
from intercap_core.joint.terms.term import Term

_FIRST_FINGER = JOINT_INDEX["left_index1"]  # joints from here on are the fingers'


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
        acceleration = smoothness.accelerations(joints, self._fps) / self._sigma[:, None]
        weight, energy = smoothness.robust(acceleration, ACCELERATION_OUTLIER)
        unit = self._fps**2 / self._sigma
        equations.add_rows(
            self.name,
            BODY,
            lambda at, some: jacobian[at, some] * unit[some, None, None],
            weight * self._weight,
            acceleration,
            energy * self._weight,
            stencil=smoothness.ACCELERATION,
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
        acceleration = smoothness.accelerations(points, self._fps) / OBJECT_ACCELERATION
        weight, energy = smoothness.robust(acceleration, ACCELERATION_OUTLIER)
        unit = self._fps**2 / OBJECT_ACCELERATION
        equations.add_rows(
            self.name,
            OBJECT,
            lambda at, some: jacobian[at, some] * unit,
            weight * self._weight,
            acceleration,
            energy * self._weight,
            stencil=smoothness.ACCELERATION,
        )
