"""Poses of lost frames between known ones: in the hand that carries the object, or straight.

The object is often hidden by the hand that carries it, by the head or by the body. A hand may have
carried it if it leads from the last known pose to the next one. Of all possible paths, the one with
the highest likelihood of motion and images is used. Before the first and after the last known frame
the object stays in place or in a hand, as it does between the nearest two known frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from intercap_core.geometry.camera.transforms import apply_step, rigid, step_between
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.solve.time_series import rigid_velocity
from intercap_core.object_track.decoder import HELD_M_S, HELD_RAD_S, mode_log_ratios, pose_distances
from intercap_core.object_track.fit import FIT_ROUNDS, FittedPose, MotionPrior
from intercap_core.object_track.given_poses import UNSEEN_S
from intercap_core.object_track.likelihood import CONTRADICTED_LOG_RATIO
from intercap_core.object_track.motion import estimate_hand_motions, unwrap_symmetry
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.turns import SAME_POSE_M, SAME_POSE_RAD, UNSURE_M, UNSURE_RAD


@dataclass(frozen=True)
class Bridge:
    """One possible path of the object through N lost frames."""

    poses: np.ndarray
    """(N, 4, 4) poses in the lost frames."""
    end: np.ndarray
    """(4, 4) pose of the known frame after the gap, as the symmetric equivalent that is reached."""
    log_ratio: float
    """Log-probability of the motion from the known frame before to the one after, nats."""
    information: np.ndarray
    """(N, 6, 6) inverse covariance of the poses by the motion of the hand, zero without a hand."""


@dataclass(frozen=True)
class Gap:
    """Lost frames between two known frames of a track, or at an end of it."""

    observer: Observer
    """The recording."""
    poses: np.ndarray
    """(T, 4, 4) poses of the track."""
    frames: np.ndarray
    """(N,) the lost frames."""
    before: int
    """Known frame before the gap; at the start of the track that after it."""
    after: int
    """Known frame after the gap; at the end of the track that before it."""
    step: tuple[int, int]
    """Known frames whose motion shows how the object moved: those before and after the gap; at an
    end of the track the second nearest and the nearest."""

    @property
    def seconds(self) -> float:
        """Time from the first to the last of the lost and known frames."""
        return float(np.ptp(self.observer.times[[*self.frames[[0, -1]], self.before, self.after]]))

    def bridges(self) -> list[Bridge]:
        """Return the possible paths: straight, and with each hand that may have held the object."""
        (a, b), observer = self.step, self.observer
        hands = estimate_hand_motions(observer.joints[[a, b]])
        seconds = abs(float(observer.times[b] - observer.times[a]))
        modes = mode_log_ratios(observer.mesh, self.poses[[a]], self.poses[[b]], seconds, hands)
        rest, free, *in_hand = modes[:, 0, 0]
        end = self._end(self.poses[a])
        direct = self._straight(end)
        nothing = np.zeros((len(self.frames), 6, 6))
        result = [Bridge(direct, end, float(max(rest, free)), nothing)]
        for number, (hand, own) in enumerate(zip(hands, in_hand, strict=True)):
            if hand is None or not np.isfinite(own):
                continue
            end = self._end(hand.carry(self.poses[a]))
            poses, information = direct.copy(), nothing.copy()
            for i, t in enumerate(self.frames):
                found = self._in_hand(number, int(t), end)
                if found is not None:
                    poses[i], information[i] = found
            if information.any():
                result.append(Bridge(poses, end, float(own), information))
        return result

    def _end(self, expected: np.ndarray) -> np.ndarray:
        """Return the pose of the known frame after the gap, as equivalent nearest to another."""
        pose = self.poses[self.after]
        if self.before == self.after:
            return pose
        return self.observer.mesh.symmetry.nearest_equivalent_pose(pose, expected)

    def _straight(self, end: np.ndarray) -> np.ndarray:
        """Return poses (N, 4, 4) by the shortest turn and the straight line to ``end`` (4, 4)."""
        if self.before == self.after:
            return np.repeat(end[None], len(self.frames), axis=0)
        ends, known = np.stack([self.poses[self.before], end]), [self.before, self.after]
        turns = Slerp(known, Rotation.from_matrix(ends[:, :3, :3]))(self.frames).as_matrix()
        line = [np.interp(self.frames, known, ends[:, k, 3]) for k in range(3)]
        return rigid(turns, np.stack(line, axis=1))

    def _in_hand(self, hand: int, t: int, end: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the pose (4, 4) of frame ``t`` in this hand and its inverse covariance (6, 6).

        The hand carries the pose before the gap forwards, and ``end`` (4, 4), the pose after the
        gap, backwards. The result is interpolated between the two by time. Its standard deviations
        grow with the time to the nearer known frame, and with the distance from the wrist. None if
        the motion of the hand is unknown.
        """
        joints, times = self.observer.joints, self.observer.times
        forwards, backwards = (
            estimate_hand_motions(joints[[u, t]])[hand] for u in (self.before, self.after)
        )
        if forwards is None or backwards is None:
            return None
        carried = [forwards.carry(self.poses[self.before]), backwards.carry(end)]
        share = (times[t] - times[self.before]) / self.seconds
        pose = apply_step(carried[0], share * step_between(*carried))
        nearer = np.abs(times[[self.before, self.after]] - times[t]).min()
        turn = np.hypot(SAME_POSE_RAD, HELD_RAD_S * nearer)
        arm = np.linalg.norm(self.observer.mesh.centre_at(pose) - forwards.end)
        shift = np.linalg.norm([SAME_POSE_M, HELD_M_S * nearer, arm * turn])
        return pose, np.diag(np.repeat([turn, shift], 3) ** -2.0)

    def choose(self) -> tuple[Bridge, list[FittedPose], bool]:
        """Choose the path with the highest likelihood of motion and images.

        Returns:
            The path.
            The fits of its frames; none if there is only one path.
            Whether the path is sure: the odds against any different path are above seven to one (2
                nats), and the images do not contradict it.
        """
        paths = self.bridges()
        if len(paths) == 1:
            return paths[0], [], False
        fits = [self._fit(path) for path in paths]

        def log_ratio(pose: np.ndarray, information: np.ndarray, fit: FittedPose) -> float:
            """Images' log-likelihood ratio of a fit, less its deviation from the path."""
            step = step_between(pose, fit.pose)
            return fit.log_ratio - 0.5 * float(step @ information @ step)

        by_images = np.array(
            [
                self.observer.share * sum(map(log_ratio, path.poses, path.information, own))
                for path, own in zip(paths, fits, strict=True)
            ]
        )
        total = by_images + [path.log_ratio for path in paths]
        best = int(total.argmax())
        different = [_is_different(self.observer.mesh, paths[best], path) for path in paths]
        lead = total[best] - max(total[different], default=-np.inf)
        return (
            paths[best],
            fits[best],
            bool(lead > 2.0 and by_images[best] > CONTRADICTED_LOG_RATIO),
        )

    def _fit(self, path: Bridge) -> list[FittedPose]:
        """Compare a path with the images; poses in a hand are fitted, with the hand as prior."""
        count, observer = len(self.frames), self.observer
        motion = rigid_velocity(path.poses, np.ones(count, bool), observer.times[self.frames])
        result = []
        for t, pose, information, twist in zip(
            self.frames.tolist(), path.poses, path.information, motion, strict=True
        ):
            if information.any():
                turn, shift = information.diagonal()[[0, 3]] ** -0.5
                prior = MotionPrior(pose, sigma_m=float(shift), sigma_rad=float(turn))
                result.append(observer.fit(t, pose, prior, FIT_ROUNDS, twist=twist))
            else:
                result.append(observer.assess(t, pose, twist=twist))
        return result


@dataclass(frozen=True)
class FilledTrack:
    """A track whose lost frames are filled in. Matrices are zero in frames that no hand bridges."""

    poses: np.ndarray
    """(T, 4, 4) poses."""
    hand: np.ndarray
    """(T, 6, 6) J'J of the hand's motion, by steps of the pose."""
    images: np.ndarray
    """(T, 6, 6) J'J of the images in the same frames."""
    pull: np.ndarray
    """(T, 6) J'r of the hand. J'r of the images is the opposite, as the fit minimised both."""
    sure: np.ndarray
    """(T,) lost frames through which a hand surely carried the object."""

    def evidence(self, share: float, noise: float) -> tuple[np.ndarray, np.ndarray]:
        """Return J'J (T, 6, 6) and J'r (T, 6) of hand and images together.

        Args:
            share: independent observations per frame: the hand's evidence in successive frames is
                as good as one observation.
            noise: factor of the stated variance of the images.
        """
        hand = share * self.hand
        return hand + self.images / noise, self.pull * (share - 1 / noise)


def fill_lost(observer: Observer, poses: np.ndarray, lost: np.ndarray) -> FilledTrack:
    """Fill in the lost frames of a track by the likeliest path between known frames.

    Known poses are replaced by equivalent ones that follow each other.

    Args:
        observer: the recording.
        poses: (T, 4, 4) of the track.
        lost: (T,) bool.
    """
    count, symmetry, known = len(poses), observer.mesh.symmetry, ~lost
    track = unwrap_symmetry(symmetry, poses, known)
    hand, images = np.zeros((count, 6, 6)), np.zeros((count, 6, 6))
    pull, sure = np.zeros((count, 6)), np.zeros(count, bool)
    ends = np.flatnonzero(known).tolist()
    if ends:
        track[: ends[0]], track[ends[-1] + 1 :] = track[ends[0]], track[ends[-1]]
    for a, b in pairwise([-1, *ends, count] if len(ends) > 1 else []):
        if b == a + 1:
            continue
        frames = np.arange(a + 1, b)
        step = (a, b)
        if a < 0:
            step, a = (ends[1], b), b
        elif b == count:
            step, b = (ends[-2], a), a
        gap = Gap(observer, track, frames, a, b, step)
        path, fits, is_sure = gap.choose()
        track[frames] = [fit.pose for fit in fits] if fits else path.poses
        track[b] = path.end
        track[b:] = unwrap_symmetry(symmetry, track[b:], known[b:])
        in_hand = np.any(path.information, axis=(1, 2))
        for i, t in enumerate(frames):
            if in_hand[i]:
                hand[t] = path.information[i]
                images[t] = np.linalg.inv(fits[i].covariance) - path.information[i]
                pull[t] = path.information[i] @ step_between(path.poses[i], track[t])
        sure[frames] = in_hand & (is_sure and gap.seconds < UNSEEN_S)
    return FilledTrack(track, hand, images, pull, sure)


def _is_different(mesh: ObjectMesh, path: Bridge, other: Bridge) -> bool:
    """Return whether two paths lead to different poses in some frame."""
    pairs = [
        pose_distances(mesh, p[None], q[None]) for p, q in zip(path.poses, other.poses, strict=True)
    ]
    return any(turn[0, 0] > UNSURE_RAD or shift[0, 0] > UNSURE_M for turn, shift in pairs)
