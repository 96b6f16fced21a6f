"""Poses of the object that a person gave: what they say of their frames and of those around.

A given pose is an observation of its frame with the stated deviations. Where nothing is seen of the
object it is carried on from there, with a deviation that grows with the time since.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from intercap_core.geometry.camera.transforms import step_between
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.constants import (
    COMMON_ERROR_VARIANCE,
    COMMON_TURN_VARIANCE,
    GIVEN_SIGMAS,
    GROWTH_LOST_M_S,
    GROWTH_LOST_RAD_S,
    SAME_POSE_DEG,
    SAME_POSE_M,
    UNSEEN_S,
    VIEW_SHOWS_LOG_RATIO,
)
from intercap_core.object_track.fit import Fit, MotionPrior
from intercap_core.object_track.frame_result import FrameResult
from intercap_core.object_track.steps import apart

# Of the evidence's turns, whose covariance is stated less by this factor: see whole.py.
TURNS_LESS = np.repeat([np.sqrt(COMMON_TURN_VARIANCE / COMMON_ERROR_VARIANCE), 1.0], 3)


@dataclass(frozen=True, eq=False)
class GivenPose:
    """The object's ``pose`` (4, 4) in frame ``frame``, master_from_object, and the standard
    deviations of its centre's place, metres, and of its turn, radians, along and about each axis.
    """

    frame: int
    pose: np.ndarray
    sigma_m: float
    sigma_rad: float

    @property
    def prior(self) -> MotionPrior:
        """The same as a prior of a fit."""
        return MotionPrior(self.pose, self.sigma_m, self.sigma_rad)

    def squared(self, mesh: ObjectMesh, poses: np.ndarray) -> np.ndarray:
        """Squared distances (K,) of poses (K, 4, 4) from this one, in its deviations."""
        turn, shift = apart(mesh, self.pose[None], poses)
        return np.asarray((turn[0] / self.sigma_rad) ** 2 + (shift[0] / self.sigma_m) ** 2)

    def holds(self, mesh: ObjectMesh, pose: np.ndarray) -> bool:
        """Whether a pose (4, 4) is this one within its uncertainty."""
        turn, shift = self.away(mesh, pose)
        return (
            shift < GIVEN_SIGMAS * self.sigma_m + SAME_POSE_M
            and turn < GIVEN_SIGMAS * self.sigma_rad + np.radians(SAME_POSE_DEG)
        )

    def away(self, mesh: ObjectMesh, pose: np.ndarray) -> tuple[float, float]:
        """Turn, radians, and shift of the centre, metres, of a pose (4, 4) from this one."""
        turn, shift = apart(mesh, self.pose[None], pose[None])
        return float(turn[0, 0]), float(shift[0, 0])


@dataclass(frozen=True, eq=False)
class GivenEvidence:
    """What given poses say of T frames as quadratic forms of (turn on the left, shift) of the
    origin: the J'J ``information`` (T, 6, 6) about the poses ``about`` (T, 4, 4); ``reached`` (T,),
    the frames in which nothing is seen of the object, from one of the poses ``held`` on."""

    about: np.ndarray
    information: np.ndarray
    reached: np.ndarray
    held: Sequence[GivenPose] = ()

    @classmethod
    def none(cls, poses: np.ndarray) -> GivenEvidence:
        """Of nothing that was given, for T poses (T, 4, 4)."""
        count = len(poses)
        return cls(poses, np.zeros((count, 6, 6)), np.zeros(count, bool))

    @classmethod
    def of(
        cls,
        mesh: ObjectMesh,
        held: Sequence[GivenPose],
        poses: np.ndarray,
        unseen: np.ndarray,
        times: np.ndarray,
    ) -> GivenEvidence:
        """What the ``held`` poses say beside a track (T, 4, 4) in which the frames ``unseen`` (T,)
        show nothing.

        There the track's poses stand for it, with deviations that grow by the seconds ``times``
        (T,) since the nearest given one; all such frames of that one are as good as one
        observation, of how fast it moves.
        """
        found = cls.none(poses.copy())
        for given in held:
            t = given.frame
            found.about[t] = mesh.symmetry.nearest_equivalent_pose(given.pose, poses[t])
            found.information[t] = _information(
                mesh, found.about[t], given.sigma_m, given.sigma_rad
            )
        since = seconds_since([given.frame for given in held], unseen, times)
        found.reached[:] = unseen & np.isfinite(since)
        frames = np.flatnonzero(found.reached & (since > 0)).tolist()
        nearest = {t: min(held, key=lambda one: abs(times[one.frame] - times[t])) for t in frames}
        for t, given in nearest.items():
            found.information[t] = _information(
                mesh,
                poses[t],
                given.sigma_m + GROWTH_LOST_M_S * since[t],
                given.sigma_rad + GROWTH_LOST_RAD_S * since[t],
            ) / sum(other is given for other in nearest.values())
        return replace(found, held=tuple(held))

    def moving(self, mesh: ObjectMesh, poses: np.ndarray, segment: np.ndarray) -> np.ndarray:
        """Given and reached frames (T,) bool in which the object does not rest, of poses (T, 4, 4)
        whose rests ``segment`` (T,) numbers: in no other frame of the rest it is seen, or a given
        pose of it is another one."""
        found = np.zeros(len(segment), bool)
        stated = self.reached.copy()
        stated[[given.frame for given in self.held]] = True
        for number in set(segment[stated & (segment >= 0)].tolist()):
            rest = segment == number
            seen = np.flatnonzero(rest & ~stated)
            for given in self.held:
                if rest[given.frame] and len(seen):
                    nearest = seen[np.abs(seen - given.frame).argmin()]
                    seen = seen if given.holds(mesh, poses[nearest]) else seen[:0]
            if not len(seen):
                found |= rest & stated
        return found

    def gradient(self, looked: np.ndarray) -> np.ndarray:
        """J'r (T, 6) at the poses ``looked`` (T, 4, 4)."""
        return np.einsum("tij,tj->ti", self.information, step_between(self.about, looked))


def seconds_since(frames: Sequence[int], unseen: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Seconds (T,) to the nearest of the ``frames`` from which one comes through ``unseen`` (T,)
    frames alone, at ``times`` (T,); 0 at them, infinite where one comes from none."""
    found = np.full(len(unseen), np.inf)
    for frame in frames:
        found[frame] = 0.0
        for way in (range(frame + 1, len(unseen)), range(frame - 1, -1, -1)):
            for t in way:
                if not unseen[t]:
                    break
                found[t] = min(found[t], abs(times[t] - times[frame]))
    return found


def at_edges(
    fits: Sequence[Fit], unseen: np.ndarray, given: Sequence[int], times: np.ndarray
) -> np.ndarray:
    """Frames (T,) bool at ``times`` (T,), seconds, that a single view shows, near ``given`` frames
    and beside ``unseen`` ones (T,).

    What moves out of sight there does so fast, and how it moves until that view exposes is known
    from one side alone: of a swung racquet, a decimetre in 19 ms, which no deviation states.
    """
    since = np.abs(times[:, None] - times[list(given)]).min(1, initial=np.inf)
    padded = np.pad(unseen, 1)
    beside = padded[:-2] | padded[2:]
    few = [sum(view.log_ratio > VIEW_SHOWS_LOG_RATIO for view in fit.views) < 2 for fit in fits]
    return np.asarray((since > 0) & (since < UNSEEN_S) & beside & ~unseen & few)


def against(
    mesh: ObjectMesh, given: GivenPose, taken: GivenPose | None, frames: Sequence[FrameResult]
) -> str:
    """What the final ``frames`` (T) say against a given pose, in words; "" = nothing.

    ``taken``: as what it was taken, of its own frame or of one beside; None = it was not.
    """
    found = frames[given.frame]
    turn, shift = given.away(mesh, found.fit.pose)
    told = (
        f"annotated pose of frame {given.frame} (stated to {1e3 * given.sigma_m:.0f} mm and "
        f"{np.degrees(given.sigma_rad):.0f} degrees)"
    )
    if not found.lost and given.holds(mesh, found.fit.pose):
        return ""
    if taken is not None and taken.frame != given.frame:
        return f"{told}: the images show the object there in frame {taken.frame}; correct its frame"
    if found.lost:
        return f"{told}: the images contradict it, and show the object nowhere; correct it"
    return (
        f"{told}: the images show the object {1e3 * shift:.0f} mm and {np.degrees(turn):.0f} "
        "degrees from it; correct it"
    )


def _information(
    mesh: ObjectMesh, pose: np.ndarray, sigma_m: float, sigma_rad: float
) -> np.ndarray:
    """Information (6, 6) of (turn on the left, shift of the origin) of a pose (4, 4) whose centre
    and turn have these deviations."""
    arm = pose[:3, :3] @ mesh.centre_of_mass
    to_centre = np.eye(6)
    to_centre[3:, :3] = np.cross(np.eye(3), arm).T  # shift of the centre by a turn
    own = np.repeat([sigma_rad, sigma_m], 3) ** -2.0
    stated = to_centre.T @ (own[:, None] * to_centre)
    return np.asarray(stated * np.outer(TURNS_LESS, TURNS_LESS))
