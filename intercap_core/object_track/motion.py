"""Motion of the tracked object: at constant velocity, or with the hand that holds it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.geometry.rigid.symmetry import SymmetryGroup
from intercap_core.object_track.fit import MotionPrior

# Standard deviation of the change of velocity from one frame to the next.
ONSET_M_S = 0.6  # m/s; tuned
ONSET_RAD_S = np.radians(60)  # rad/s; tuned
# Growth of a pose's standard deviation while the object is not observed.
GROWTH_LOST_M_S = 1.2  # m/s; tuned
GROWTH_LOST_RAD_S = np.radians(240)  # rad/s; tuned
HOLDING_REACH_M = 0.20  # from a wrist to the surface of a held object: a hand's length (anatomy)

_HANDS = [
    [KEYPOINT_NAMES.index(f"{side}_{name}") for name in ("elbow", "wrist", "index1", "pinky1")]
    for side in ("right", "left")
]
"""Elbow, wrist, and knuckles of index and little finger, right and left."""


def extrapolate(before: np.ndarray, now: np.ndarray) -> np.ndarray:
    """Predict the next pose (4, 4) at constant velocity from the last two.

    Shifts of at most 4 mm and turns of at most 1.5 degrees are jitter of fits and not continued.
    """
    shift = now[:3, 3] - before[:3, 3]
    turn = Rotation.from_matrix(now[:3, :3] @ before[:3, :3].T)
    predicted = now.copy()
    if np.linalg.norm(shift) > 0.004:
        predicted[:3, 3] += shift
    if turn.magnitude() > np.radians(1.5):
        predicted[:3, :3] = turn.as_matrix() @ now[:3, :3]
    return predicted


def predict_prior(
    before: np.ndarray, now: np.ndarray, predicted: np.ndarray, step_s: float, unseen_s: float = 0.0
) -> MotionPrior:
    """Return the prior around a prediction: the object may start to move, turn or stop.

    Its standard deviations are the sum of three parts: an onset of motion from rest, half of the
    last step (the motion may stop or double), and a growth with the time without observation.

    Args:
        before, now: last two poses (4, 4).
        predicted: (4, 4) mean of the prior.
        step_s: seconds between frames.
        unseen_s: seconds since the object was seen.
    """
    shift = float(np.linalg.norm(now[:3, 3] - before[:3, 3]))
    turn = float(Rotation.from_matrix(now[:3, :3] @ before[:3, :3].T).magnitude())
    return MotionPrior(
        predicted,
        ONSET_M_S * step_s + 0.5 * shift + unseen_s * GROWTH_LOST_M_S,
        ONSET_RAD_S * step_s + 0.5 * turn + unseen_s * GROWTH_LOST_RAD_S,
    )


@dataclass(frozen=True)
class HandMotion:
    """Motion of a hand between two frames."""

    turn: np.ndarray
    """(3, 3) rotation about the wrist, master frame."""
    start: np.ndarray
    """(3,) position of the wrist before, metres."""
    end: np.ndarray
    """(3,) position of the wrist after."""

    def reaches(self, centres: np.ndarray, radius: float) -> np.ndarray:
        """Return whether the hand is near enough to hold an object before the motion, (...) bool.

        ``centres`` (..., 3) and ``radius`` are those of the object, metres.
        """
        return np.linalg.norm(centres - self.start, axis=-1) < radius + HOLDING_REACH_M

    def carry(self, poses: np.ndarray) -> np.ndarray:
        """Return the poses (..., 4, 4) of a held object after the motion."""
        result = poses.copy()
        result[..., :3, :3] = self.turn @ poses[..., :3, :3]
        result[..., :3, 3] = (poses[..., :3, 3] - self.start) @ self.turn.T + self.end
        return result


def estimate_hand_motions(joints: np.ndarray) -> list[HandMotion | None]:
    """Estimate the motions of the right and the left hand between two frames, None if unknown.

    A hand turns like its palm, or like the forearm if the palm is not seen in both frames.
    ``joints`` (2, K, 3) are those of the person, NaN where unknown.
    """
    motions: list[HandMotion | None] = []
    for elbow, wrist, index, pinky in _HANDS:
        start, end = joints[:, wrist]
        if not (np.isfinite(start).all() and np.isfinite(end).all()):
            motions.append(None)
            continue
        palms = [_palm(own[index] - own[wrist], own[pinky] - own[wrist]) for own in joints]
        if palms[0] is None or palms[1] is None:
            turn = _between(start - joints[0, elbow], end - joints[1, elbow])
        else:
            turn = palms[1] @ palms[0].T
        motions.append(HandMotion(turn, start, end))
    return motions


def unwrap_symmetry(symmetry: SymmetryGroup, poses: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Replace known poses (T, 4, 4) by symmetric equivalents, each closest to the known one before.

    Args:
        symmetry: of the object.
        poses: (T, 4, 4).
        known: (T,) bool.
    """
    result = poses.copy()
    if not symmetry.trivial:
        for s, t in pairwise(np.flatnonzero(known)):
            result[t] = symmetry.nearest_equivalent_pose(poses[t], result[s])
    return result


def shift_twist(twist: np.ndarray, point: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Express a motion (turn, shift per second) about another point of the body.

    ``twist`` (6,) contains the shift of ``point`` (3,), the result that of ``other`` (3,).
    """
    return np.append(twist[:3], twist[3:] + np.cross(twist[:3], other - point))


def _palm(index: np.ndarray, pinky: np.ndarray) -> np.ndarray | None:
    """Return the axes (3, 3), in columns, of a palm from the directions (3,) to its knuckles.

    None if the directions are unknown or nearly parallel: the sine of their angle is below 0.1,
    usually it is 0.3.
    """
    normal = np.cross(index, pinky)
    size = float(np.linalg.norm(normal))
    if not size > 0.1 * float(np.linalg.norm(index) * np.linalg.norm(pinky)):
        return None
    along, normal = index / np.linalg.norm(index), normal / size
    return np.stack([along, np.cross(normal, along), normal], axis=1)


def _between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the smallest rotation (3, 3) from direction ``a`` to ``b`` (3,); identity if NaN."""
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return np.eye(3)
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis = np.cross(a, b)
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, float(a @ b))
    return Rotation.from_rotvec(angle * axis / max(sine, 1e-9)).as_matrix()
