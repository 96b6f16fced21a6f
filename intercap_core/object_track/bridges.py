"""Where the object may be while it is lost: in the hand that held it, or on the straight way.

What is held is hidden most: by the hand, by the head that it is raised to, by the body. A hand that
carries the object from where it was seen last to where it is seen next held it in between.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from intercap_core.geometry.camera.transforms import apply_step, step_between
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.constants import (
    HELD_M,
    HELD_M_S,
    HELD_RAD,
    HELD_RAD_S,
)
from intercap_core.object_track.motion import hand_motions
from intercap_core.object_track.steps import FIRST_HAND, mode_log_ratios


@dataclass(frozen=True)
class Bridge:
    """One way that the object may have gone in lost frames: its ``poses`` (N, 4, 4) in the
    ``frames`` (N,), the equivalent pose ``end`` (4, 4) of the known frame after that it leads to,
    what speaks for it, nats, as a motion from the known frame before to that one, and what the
    hand's motion tells of the poses, the ``information`` (N, 6, 6) of (turn on the left, shift),
    zero where no hand carries it."""

    frames: np.ndarray
    poses: np.ndarray
    end: np.ndarray
    log_ratio: float
    information: np.ndarray


@dataclass(frozen=True)
class Gap:
    """Lost frames between the known frames ``before`` and ``after`` of a track of ``poses`` (T, 4,
    4) at ``times`` (T,), seconds; ``joints`` (T, K, 3) of the person, metres, NaN unknown."""

    mesh: ObjectMesh
    poses: np.ndarray
    times: np.ndarray
    joints: np.ndarray | None
    before: int
    after: int

    @property
    def seconds(self) -> float:
        """From the known frame before to the one after."""
        return float(self.times[self.after] - self.times[self.before])

    def bridges(self) -> list[Bridge]:
        """The straight way, at rest or free, and with each hand that may have held the object and
        is known in some of the frames."""
        a, b = self.before, self.after
        same = self.mesh.symmetry.nearest_equivalent_pose
        frames = np.arange(a + 1, b)
        hands = [] if self.joints is None else hand_motions(self.joints[[a, b]])
        ways = mode_log_ratios(self.mesh, self.poses[[a]], self.poses[[b]], self.seconds, hands)
        ratio = ways[:, 0, 0]
        end = same(self.poses[b], self.poses[a])
        direct = self._straight(end)
        nothing = np.zeros((len(frames), 6, 6))
        found = [Bridge(frames, direct, end, float(ratio[:FIRST_HAND].max()), nothing)]
        for number, (hand, own) in enumerate(zip(hands, ratio[FIRST_HAND:], strict=True)):
            if hand is None or not np.isfinite(own):
                continue
            end = same(self.poses[b], hand.carry(self.poses[a]))
            poses, information = direct.copy(), nothing.copy()
            for i, t in enumerate(frames):
                pose = self._in_hand(number, int(t), end)
                if pose is not None:
                    poses[i], information[i] = pose, self._hold(int(t))
            if information.any():
                found.append(Bridge(frames, poses, end, float(own), information))
        return found

    def _straight(self, end: np.ndarray) -> np.ndarray:
        """Poses (N, 4, 4) on the straight way to ``end`` (4, 4)."""
        poses = self.poses[self.before : self.after + 1].copy()
        poses[-1] = end
        known = np.zeros(len(poses), bool)
        known[[0, -1]] = True
        return straight(poses, known)[1:-1]

    def _in_hand(self, hand: int, t: int, end: np.ndarray) -> np.ndarray | None:
        """The pose (4, 4) of frame ``t`` as the hand carries it from both sides, to ``end`` (4, 4);
        None where the hand is unknown."""
        assert self.joints is not None
        carried = []
        for u, pose in ((self.before, self.poses[self.before]), (self.after, end)):
            motion = hand_motions(self.joints[[u, t]])[hand]
            if motion is None:
                return None
            carried.append(motion.carry(pose))
        share = (self.times[t] - self.times[self.before]) / self.seconds
        return apply_step(carried[0], share * step_between(*carried))

    def _hold(self, t: int) -> np.ndarray:
        """What a hold tells of frame ``t`` (6, 6): the less, the longer before and after it."""
        nearer = min(
            self.times[t] - self.times[self.before], self.times[self.after] - self.times[t]
        )
        turn, shift = np.hypot(HELD_RAD, HELD_RAD_S * nearer), np.hypot(HELD_M, HELD_M_S * nearer)
        return np.diag(np.repeat([turn, shift], 3) ** -2.0)


def straight(poses: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Poses (T, 4, 4) with the frames that are not ``known`` (T,) filled in: shortest turn and
    straight line between known neighbours, held at the ends."""
    at = np.flatnonzero(known)
    if not len(at) or len(at) == len(known):
        return poses.copy()
    frames = np.clip(np.arange(len(known)), at[0], at[-1])
    found = np.tile(np.eye(4), (len(known), 1, 1))
    found[:, :3, 3] = np.stack([np.interp(frames, at, poses[at, k, 3]) for k in range(3)], axis=1)
    found[:, :3, :3] = poses[at[0], :3, :3]
    if len(at) > 1:
        found[:, :3, :3] = Slerp(at, Rotation.from_matrix(poses[at, :3, :3]))(frames).as_matrix()
    found[at] = poses[at]
    return found
