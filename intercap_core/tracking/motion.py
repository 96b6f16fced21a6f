"""How the tracked object moves: where it is expected next, and what late cameras see of it."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.solve.velocity import limited_rate
from intercap_core.tracking.fit import MotionPrior

STILL_M, STILL_RAD = 0.004, np.radians(1.5)  # slower than this: no motion is predicted
ONSET_M, ONSET_RAD = 0.02, np.radians(5)  # in one frame, from rest
GROWTH_LOST_M, GROWTH_LOST_RAD = 0.04, np.radians(8)  # standard deviation added a lost frame

# A thrown or kicked object; what is faster is a track that jumps.
MAX_SPEED_M_S, MAX_TURN_RAD_S = 8.0, 20.0


def twists(poses: np.ndarray, known: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Turn (rad/s, from the left) and shift of the origin (m/s) in a second: (T, 6).

    ``poses`` (T, 4, 4) master_from_object, believed where ``known`` (T,); ``times`` (T,) seconds.
    Zero where nothing is known; a single jump moves no neighbour much.
    """
    if len(poses) < 2:
        return np.zeros((len(poses), 6))
    turns = Rotation.from_matrix(poses[1:, :3, :3] @ poses[:-1, :3, :3].transpose(0, 2, 1))
    turn = limited_rate(turns.as_rotvec(), times, max_speed=MAX_TURN_RAD_S, known=known)
    shifts = np.diff(poses[:, :3, 3], axis=0)
    shift = limited_rate(shifts, times, max_speed=MAX_SPEED_M_S, known=known)
    return np.concatenate([turn, shift], axis=1)


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
    """How far the object may be from the prediction: it may start to move, turn or stop.

    From rest one frame of a hand's acceleration, in motion half of the last step beside that, and
    more for every frame since it was last seen.
    """
    shift = float(np.linalg.norm(now[:3, 3] - before[:3, 3]))
    turn = float(Rotation.from_matrix(now[:3, :3] @ before[:3, :3].T).magnitude())
    return MotionPrior(
        predicted,
        ONSET_M + 0.5 * shift + lost_for * GROWTH_LOST_M,
        ONSET_RAD + 0.5 * turn + lost_for * GROWTH_LOST_RAD,
    )


def loose(prior: MotionPrior) -> np.ndarray:
    return np.diag(np.repeat([prior.sigma_rad**2, prior.sigma_m**2], 3))
