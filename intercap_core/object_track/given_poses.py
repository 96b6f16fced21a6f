"""Annotated poses of the object as evidence on their frames and on the frames around.

An annotated pose is an observation of its frame with the stated standard deviations. In the frames
before and after in which no image shows the object (unseen frames), the pose of the track is
carried: it counts as an observation whose standard deviations grow with time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.geometry.camera.transforms import step_between
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.decoder import pose_distances
from intercap_core.object_track.evidence import TURN_SCALE, FrameEvidence, steps_about_point
from intercap_core.object_track.fit import FittedPose
from intercap_core.object_track.likelihood import SEEN_LOG_RATIO
from intercap_core.object_track.motion import GROWTH_LOST_M_S, GROWTH_LOST_RAD_S
from intercap_core.object_track.turns import SAME_POSE_M, SAME_POSE_RAD

UNSEEN_S = 0.8  # time that an object is followed without being seen, seconds; tuned on the studio


@dataclass(frozen=True, eq=False)
class GivenPose:
    """An annotated pose of the object."""

    frame: int
    """Frame of the pose."""
    pose: np.ndarray
    """(4, 4) master_from_object."""
    sigma_m: float
    """Standard deviation of the centre along each axis, metres."""
    sigma_rad: float
    """Standard deviation of the turn about each axis, radians."""

    def holds(self, mesh: ObjectMesh, pose: np.ndarray) -> bool:
        """Return whether a pose (4, 4) agrees with this one.

        Three standard deviations plus the tolerance of equal poses (``SAME_POSE_M``) are allowed.
        """
        turn, shift = self.distance(mesh, pose)
        return (
            shift < 3.0 * self.sigma_m + SAME_POSE_M and turn < 3.0 * self.sigma_rad + SAME_POSE_RAD
        )

    def distance(self, mesh: ObjectMesh, pose: np.ndarray) -> tuple[float, float]:
        """Return turn, radians, and shift of the centre, metres, of a pose (4, 4) from this one."""
        turn, shift = pose_distances(mesh, self.pose[None], pose[None])
        return float(turn[0, 0]), float(shift[0, 0])


@dataclass(frozen=True, eq=False)
class GivenEvidence:
    """Annotated poses as quadratic forms of (turn on the left, shift of the origin) of T frames."""

    reference: np.ndarray
    """(T, 4, 4) poses at which the quadratic forms are minimal."""
    information: np.ndarray
    """(T, 6, 6) J'J, zero in frames without evidence."""
    carried: np.ndarray
    """(T,) bool, unseen frames that are connected to an annotated one by unseen frames."""
    given: Sequence[GivenPose]
    """The annotated poses; without any, all information is zero."""

    @classmethod
    def of(
        cls,
        mesh: ObjectMesh,
        given: Sequence[GivenPose],
        poses: np.ndarray,
        unseen: np.ndarray,
        times: np.ndarray,
    ) -> GivenEvidence:
        """Return the evidence of annotated poses on a track.

        In an annotated frame the annotated pose is the observation, in a carried frame the pose of
        the track. The standard deviations of the latter grow with the time since the nearest
        annotated frame. All carried frames of one annotated pose together count as one observation,
        since they depend on one unknown velocity.

        Args:
            mesh: the object.
            given: annotated poses.
            poses: (T, 4, 4) of the track.
            unseen: (T,) frames whose images do not show the object.
            times: (T,) seconds.
        """
        reference, information = poses.copy(), np.zeros((len(poses), 6, 6))
        annotated = {pose.frame: pose for pose in given}
        for t, pose in annotated.items():
            reference[t] = mesh.symmetry.nearest_equivalent_pose(pose.pose, poses[t])
        since = seconds_since(list(annotated), unseen, times)
        nearest = {
            t: annotated.get(t) or min(given, key=lambda pose: abs(times[pose.frame] - times[t]))
            for t in np.flatnonzero(np.isfinite(since)).tolist()
        }
        carried_from = Counter(pose for t, pose in nearest.items() if since[t] > 0)
        for t, pose in nearest.items():
            sigma_m = pose.sigma_m + GROWTH_LOST_M_S * since[t]
            sigma_rad = pose.sigma_rad + GROWTH_LOST_RAD_S * since[t]
            information[t] = _information(mesh, reference[t], sigma_m, sigma_rad)
            if since[t] > 0:
                information[t] /= carried_from[pose]
        return cls(reference, information, unseen & np.isfinite(since), given)

    def exclude_from_rests(
        self, mesh: ObjectMesh, poses: np.ndarray, segment: np.ndarray
    ) -> np.ndarray:
        """Find annotated and carried frames (T,) that must not be merged into a rest segment.

        These are the frames of segments that no other frame sees, and of segments in which an
        annotated pose disagrees with the nearest observed pose.

        Args:
            mesh: the object.
            poses: (T, 4, 4) of the track.
            segment: (T,) number of the rest segment, -1 while the object moves.
        """
        result = np.zeros(len(segment), bool)
        stated = self.carried.copy()
        stated[[pose.frame for pose in self.given]] = True
        for number in set(segment[stated & (segment >= 0)].tolist()):
            rest = segment == number
            seen = np.flatnonzero(rest & ~stated)
            agree = all(
                pose.holds(mesh, poses[seen[np.abs(seen - pose.frame).argmin()]])
                for pose in self.given
                if rest[pose.frame] and len(seen)
            )
            if not (len(seen) and agree):
                result |= rest & stated
        return result

    def at(self, poses: np.ndarray) -> FrameEvidence:
        """Return the quadratic forms about ``poses`` (T, 4, 4)."""
        away = step_between(self.reference, poses)
        gradient = np.einsum("tij,tj->ti", self.information, away)
        return FrameEvidence(poses, self.information, gradient)


def seconds_since(frames: Sequence[int], unseen: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return the seconds (T,) to the nearest of ``frames`` that is connected by unseen frames.

    It is 0 in ``frames`` themselves, and infinite if no frame is connected.

    Args:
        frames: frames of annotated poses.
        unseen: (T,) bool.
        times: (T,) seconds.
    """
    result = np.full(len(unseen), np.inf)
    for frame in frames:
        result[frame] = 0.0
        for way in (range(frame + 1, len(unseen)), range(frame - 1, -1, -1)):
            for t in way:
                if not unseen[t]:
                    break
                result[t] = min(result[t], abs(times[t] - times[frame]))
    return result


def flag_edges(
    fits: Sequence[FittedPose], unseen: np.ndarray, frames: Sequence[int], times: np.ndarray
) -> np.ndarray:
    """Find visible frames (T,) next to unseen ones, near annotated ``frames``, with one view only.

    An object that moves out of sight there moves fast: a swung racquet moves by a decimetre in
    19 ms, a possible time offset of a view. The unseen side does not constrain its velocity, so
    that the pose at the frame's time is less certain than the covariance states.

    Args:
        fits: fit of each frame.
        unseen: (T,) bool.
        frames: frames of annotated poses.
        times: (T,) seconds.
    """
    since = np.abs(times[:, None] - times[list(frames)]).min(1, initial=np.inf)
    padded = np.pad(unseen, 1)
    at_edge = ~unseen & (padded[:-2] | padded[2:])
    in_one_view = [
        sum(view.log_ratio > SEEN_LOG_RATIO / 2 for view in fit.views) < 2 for fit in fits
    ]
    return np.asarray((since > 0) & (since < UNSEEN_S) & at_edge & in_one_view)


def _information(
    mesh: ObjectMesh, pose: np.ndarray, sigma_m: float, sigma_rad: float
) -> np.ndarray:
    """Return the information (6, 6) on (turn on the left, shift of the origin) of a pose (4, 4).

    ``sigma_m`` and ``sigma_rad`` are the deviations of its centre and its turn.
    """
    arm = pose[:3, :3] @ mesh.centre_of_mass
    to_centre = steps_about_point(-arm[None])[0]
    own = np.repeat([sigma_rad, sigma_m], 3) ** -2.0
    stated = to_centre.T @ (own[:, None] * to_centre)
    return np.asarray(stated * np.outer(TURN_SCALE, TURN_SCALE))
