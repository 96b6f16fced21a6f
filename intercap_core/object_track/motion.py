"""Motion of the tracked object: at constant velocity, or with the hand that holds it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.geometry.rigid.symmetry import SymmetryGroup
from intercap_core.object_track.constants import (
    GROWTH_LOST_M_S,
    GROWTH_LOST_RAD_S,
    HOLDING_REACH_M,
    ONSET_M_S,
    ONSET_RAD_S,
    ONSET_STEP_SHARE,
    PALM_MIN_SINE,
    STILL_M,
    STILL_RAD,
)
from intercap_core.object_track.fit import MotionPrior

# Elbow, wrist, and the knuckles of the index and the little finger, right and left.
_HANDS = [
    [KEYPOINT_NAMES.index(f"{side}_{name}") for name in ("elbow", "wrist", "index1", "pinky1")]
    for side in ("right", "left")
]


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


@dataclass(frozen=True)
class HandMotion:
    """A hand's motion between two frames: by ``turn`` (3, 3) about the wrist, which goes from
    ``start`` (3,) to ``end`` (3,), metres."""

    turn: np.ndarray
    start: np.ndarray
    end: np.ndarray

    def reaches(self, centres: np.ndarray, radius: float) -> np.ndarray:
        """Whether the hand may hold, before the motion, what is at ``centres`` (..., 3) and as
        large as ``radius``, metres."""
        return np.linalg.norm(centres - self.start, axis=-1) < radius + HOLDING_REACH_M

    def carry(self, poses: np.ndarray) -> np.ndarray:
        """Poses (..., 4, 4) of what is held, after the motion."""
        found = poses.copy()
        found[..., :3, :3] = self.turn @ poses[..., :3, :3]
        found[..., :3, 3] = (poses[..., :3, 3] - self.start) @ self.turn.T + self.end
        return found


def hand_motions(joints: np.ndarray) -> list[HandMotion | None]:
    """The motions of the right and of the left hand between two frames, None where it is unknown.

    ``joints`` (2, K, 3) of the person in both, NaN unknown. A hand turns as its palm does, or,
    where that is not seen in both frames, as the forearm.
    """
    found: list[HandMotion | None] = []
    for elbow, wrist, index, pinky in _HANDS:
        start, end = joints[:, wrist]
        if not (np.isfinite(start).all() and np.isfinite(end).all()):
            found.append(None)
            continue
        palms = [_palm(own[index] - own[wrist], own[pinky] - own[wrist]) for own in joints]
        if palms[0] is None or palms[1] is None:
            turn = _between(start - joints[0, elbow], end - joints[1, elbow])
        else:
            turn = palms[1] @ palms[0].T
        found.append(HandMotion(turn, start, end))
    return found


def unwrapped(symmetry: SymmetryGroup, poses: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Equivalent poses (T, 4, 4) of which the ``known`` (T,) follow each other as closely as the
    symmetry allows."""
    result = poses.copy()
    if not symmetry.trivial:
        for s, t in pairwise(np.flatnonzero(known)):
            result[t] = symmetry.nearest_equivalent_pose(poses[t], result[s])
    return result


def about(twist: np.ndarray, point: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The same motion (6,), of which ``twist`` states the shift of ``point`` (3,), with that of
    ``other`` (3,)."""
    return np.append(twist[:3], twist[3:] + np.cross(twist[:3], other - point))


def carried(joints: np.ndarray, now: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """Poses (N, 4, 4) of an object in each hand that may hold it, in the next frame.

    ``joints`` (2, K, 3) of the person in the pose's frame and the next, NaN unknown; ``now`` (4, 4)
    the pose, ``centre`` (3,) of the object there and its ``radius``, metres.
    """
    found = [
        hand.carry(now)
        for hand in hand_motions(joints)
        if hand is not None and hand.reaches(centre, radius)
    ]
    return np.array(found).reshape(-1, 4, 4)


def _palm(index: np.ndarray, pinky: np.ndarray) -> np.ndarray | None:
    """Axes (3, 3), in columns, of a palm with these directions (3,) from the wrist to the knuckles;
    None where they are unknown or one line."""
    normal = np.cross(index, pinky)
    size = float(np.linalg.norm(normal))
    if not size > PALM_MIN_SINE * float(np.linalg.norm(index) * np.linalg.norm(pinky)):
        return None
    along, normal = index / np.linalg.norm(index), normal / size
    return np.stack([along, np.cross(normal, along), normal], axis=1)


def _between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The smallest rotation (3, 3) from direction ``a`` to ``b`` (3,); none where one is NaN."""
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return np.eye(3)
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis = np.cross(a, b)
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, float(a @ b))
    return Rotation.from_rotvec(angle * axis / max(sine, 1e-9)).as_matrix()
