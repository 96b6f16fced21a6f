"""Motion model of the tracked object: the predicted pose and its standard deviations."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.object_track.constants import (
    GROWTH_LOST_M,
    GROWTH_LOST_RAD,
    ONSET_M,
    ONSET_RAD,
    ONSET_STEP_SHARE,
    STILL_M,
    STILL_RAD,
)
from intercap_core.object_track.fit import MotionPrior


def extrapolated(before: np.ndarray, now: np.ndarray) -> np.ndarray:
    """The next pose at constant velocity; the last one where the object is at rest."""
    shift = now[:3, 3] - before[:3, 3]
    turn = Rotation.from_matrix(now[:3, :3] @ before[:3, :3].T)
    predicted = now.copy()
    if np.linalg.norm(shift) > STILL_M:
        predicted[:3, 3] += shift
    if turn.magnitude() > STILL_RAD:
        predicted[:3, :3] = turn.as_matrix() @ now[:3, :3]
    return predicted


def expected(
    before: np.ndarray, now: np.ndarray, predicted: np.ndarray, lost_for: int
) -> MotionPrior:
    """The prior around the prediction: the object may start to move, turn or stop.

    From rest, one frame of a hand's acceleration; in motion, half of the last step in addition;
    more for every frame since the object was last visible.
    """
    shift = float(np.linalg.norm(now[:3, 3] - before[:3, 3]))
    turn = float(Rotation.from_matrix(now[:3, :3] @ before[:3, :3].T).magnitude())
    return MotionPrior(
        predicted,
        ONSET_M + ONSET_STEP_SHARE * shift + lost_for * GROWTH_LOST_M,
        ONSET_RAD + ONSET_STEP_SHARE * turn + lost_for * GROWTH_LOST_RAD,
    )


def loose(prior: MotionPrior) -> np.ndarray:
    return np.diag(np.repeat([prior.sigma_rad**2, prior.sigma_m**2], 3))
