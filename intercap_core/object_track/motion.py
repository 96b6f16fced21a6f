"""Motion of the tracked object: at constant velocity, or with the hand that holds it."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.object_track.constants import (
    GROWTH_LOST_M_S,
    GROWTH_LOST_RAD_S,
    HOLDING_REACH_M,
    ONSET_M_S,
    ONSET_RAD_S,
    ONSET_STEP_SHARE,
    STILL_M,
    STILL_RAD,
)
from intercap_core.object_track.fit import MotionPrior

FOREARMS = ((3, 4), (6, 7))  # elbow and wrist of BODY_25, right and left


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
    before: np.ndarray,
    now: np.ndarray,
    predicted: np.ndarray,
    step_s: float,
    unseen_s: float = 0.0,
) -> MotionPrior:
    """The prior around the prediction: the object may start to move, turn or stop.

    From rest, one frame's share of a hand's acceleration; in motion, half of the last step in
    addition; more for every second since the object was last seen. ``step_s`` between frames.
    """
    shift = float(np.linalg.norm(now[:3, 3] - before[:3, 3]))
    turn = float(Rotation.from_matrix(now[:3, :3] @ before[:3, :3].T).magnitude())
    return MotionPrior(
        predicted,
        ONSET_M_S * step_s + ONSET_STEP_SHARE * shift + unseen_s * GROWTH_LOST_M_S,
        ONSET_RAD_S * step_s + ONSET_STEP_SHARE * turn + unseen_s * GROWTH_LOST_RAD_S,
    )


def carried(joints: np.ndarray, now: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """Poses (N, 4, 4) of an object in each hand that may hold it, in the next frame.

    ``joints`` (2, K, 3) of the person in the pose's frame and the next, NaN unknown; ``now`` (4, 4)
    the pose, ``centre`` (3,) of the object there and its ``radius``, metres. What a hand holds
    moves with the wrist and turns as the forearm does.
    """
    found = []
    for elbow, wrist in FOREARMS:
        (e0, e1), (w0, w1) = joints[:, elbow], joints[:, wrist]
        if np.linalg.norm(centre - w0) < radius + HOLDING_REACH_M and np.isfinite(w1).all():
            turn = _between(w0 - e0, w1 - e1)
            pose = now.copy()
            pose[:3, :3] = turn @ now[:3, :3]
            pose[:3, 3] = turn @ (now[:3, 3] - w0) + w1
            found.append(pose)
    return np.array(found).reshape(-1, 4, 4)


def _between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The smallest rotation (3, 3) from direction ``a`` to ``b`` (3,); none where one is NaN."""
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return np.eye(3)
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis = np.cross(a, b)
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, float(a @ b))
    return Rotation.from_rotvec(angle * axis / max(sine, 1e-9)).as_matrix()
