"""Refinement of the decided track over all frames: rest, smoothness, covariance and flags.

1. Lost frames are filled in between known ones (:mod:`.bridges`).
2. The images are evaluated at the poses, as quadratic forms (:mod:`.evidence`); annotated poses are
   further quadratic forms (:mod:`.given_poses`).
3. Rest segments are found (:mod:`.rest`), and the most probable track is solved for
   (:mod:`.smooth`).
4. Each frame gets a status (:class:`FrameStatus`), the source of its pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from itertools import pairwise

import numpy as np

from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.solve.time_series import rigid_velocity
from intercap_core.object_track.bridges import FilledTrack, fill_lost
from intercap_core.object_track.decoder import pose_distances
from intercap_core.object_track.evidence import (
    COMMON_ERROR_VARIANCE,
    TURN_SCALE,
    UNKNOWN_SIGMA,
    FrameEvidence,
    ImageEvidence,
    free_turns,
    steps_about_point,
    views_noise,
    without_turns,
)
from intercap_core.object_track.fit import FittedPose
from intercap_core.object_track.given_poses import (
    GivenEvidence,
    GivenPose,
    flag_edges,
    seconds_since,
)
from intercap_core.object_track.likelihood import CONTRADICTED_LOG_RATIO, SEEN_LOG_RATIO
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.proposals import DENIED_LOG_RATIO
from intercap_core.object_track.rest import find_rests
from intercap_core.object_track.smooth import smooth
from intercap_core.object_track.turns import UNSURE_M, UNSURE_RAD


class FrameStatus(IntEnum):
    """Source of the pose of a frame."""

    SEEN = 0
    """The images of the frame."""
    BRIDGED = 1
    """The frames around: a hand carried the object, or it stayed in place for a moment."""
    CARRIED = 2
    """Annotated poses; the images do not show the object."""
    LOST = 3
    """None: no hypothesis is accepted, and the pose is interpolated."""
    GONE = 4
    """None: by the evidence of all frames the object has left the room."""


@dataclass(frozen=True)
class FrameResult:
    """One frame of the track."""

    fit: FittedPose
    """Pose, covariance and agreement with the views."""
    status: FrameStatus = FrameStatus.SEEN
    """Source of the pose."""
    ambiguous: bool = False
    """Whether a different pose may be the true one."""
    probability: float = 1.0
    """Probability of the pose's hypothesis given all frames."""
    spread: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    """(6, 6) covariance of (turn on the left, shift) that other hypotheses add to the fit's."""
    recovered: bool = False
    """Whether the frame is the first after lost ones."""
    resting: bool = False
    """Whether the object is at rest."""
    free_axis: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """(3,) axis, master frame, about which a turn was not observed; 0 = there is none."""

    @property
    def lost(self) -> bool:
        """Whether the pose has no source: the object is lost or gone."""
        return self.status >= FrameStatus.LOST

    @property
    def gone(self) -> bool:
        """Whether the object has left the room."""
        return self.status == FrameStatus.GONE

    @property
    def carried(self) -> bool:
        """Whether the pose follows from annotated ones alone."""
        return self.status == FrameStatus.CARRIED


def flag_frames(mesh: ObjectMesh, frames: list[FrameResult]) -> list[FrameResult]:
    """Flag the frames (T) of a refined track by their covariance.

    A frame is lost if the standard deviation of its position exceeds ``UNSURE_M``, and ambiguous if
    that of its turn exceeds ``UNSURE_RAD``. A carried frame is ambiguous in both cases, and lost
    only beyond 15 cm. The first frame after lost ones is recovered.
    """
    result: list[FrameResult] = []
    for frame in frames:
        # without the spread of rivals, which flag a frame by their probability instead
        shift, turn = _deviations(mesh, frame.fit.pose, frame.fit.covariance)
        lost = frame.lost or shift > (0.15 if frame.carried else UNSURE_M)
        unsure = frame.ambiguous or turn > UNSURE_RAD or shift > UNSURE_M
        result.append(
            replace(
                frame,
                status=FrameStatus.LOST if lost and not frame.gone else frame.status,
                ambiguous=unsure and not lost,
                recovered=bool(result) and result[-1].lost and not lost,
            )
        )
    return result


def _deviations(mesh: ObjectMesh, pose: np.ndarray, covariance: np.ndarray) -> tuple[float, float]:
    """Return the largest standard deviations of the centre, metres, and of the turn, radians.

    Turns about the axis of a continuous symmetry do not count.
    """
    arm = pose[:3, :3] @ mesh.centre_of_mass
    to_centre = steps_about_point(-arm[None])[0, 3:]
    shift = to_centre @ covariance @ to_centre.T
    turn = covariance[:3, :3]
    if mesh.symmetry.sphere:
        turn = np.zeros((3, 3))
    elif mesh.symmetry.axis is not None:
        axis = pose[:3, :3] @ mesh.symmetry.axis
        across = np.eye(3) - np.outer(axis, axis)
        turn = across @ turn @ across
    return _largest_deviation(shift), _largest_deviation(turn)


def _largest_deviation(covariance: np.ndarray) -> float:
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))


@dataclass(frozen=True)
class _SmoothedTrack:
    """The solution over all frames, before its status is decided."""

    fits: list[FittedPose]
    """Pose, covariance and agreement with the views of each frame."""
    segment: np.ndarray
    """(T,) number of the rest segment, -1 while the object moves."""
    free_axis: np.ndarray
    """(T, 3) axes about which a turn was not observed."""
    lost: np.ndarray
    """(T,) lost frames, and frames that end far from the pose that their images show."""
    in_hand: np.ndarray
    """(T,) lost frames through which a hand surely carried the object."""
    carried: np.ndarray
    """(T,) unseen frames that are connected to an annotated one by unseen frames."""


class WholeTrack:
    """Refines the track of the object that ``observer`` sees."""

    def __init__(self, observer: Observer) -> None:
        self._observer = observer
        self._mesh = observer.mesh
        self._times = observer.times

    def refine(
        self, frames: list[FrameResult], given: Sequence[GivenPose] = ()
    ) -> list[FrameResult]:
        """Refine poses and covariances by all frames and the annotated poses together.

        ``given`` are annotated poses that the decided frames agree with.

        Returns the frames with refined pose, covariance and status. Carried frames without an
        annotated pose are flagged as ambiguous. So are frames next to unseen ones, if only one view
        shows the object (:func:`.given_poses.flag_edges`).
        """
        fits = [frame.fit for frame in frames]
        lost = np.array([frame.lost for frame in frames])
        decided = np.array([fit.log_ratio for fit in fits])
        annotated = [pose.frame for pose in given]
        # Poses of unseen frames that were followed from annotated ones are not known: they are
        # filled in again, with the annotated poses as evidence.
        lost |= np.isfinite(seconds_since(annotated, decided < SEEN_LOG_RATIO, self._times))
        lost[annotated] = False
        gone = np.array([frame.gone for frame in frames])
        while True:
            smoothed = self._smooth(fits, lost, given)
            status = self._decide_status(smoothed, decided, gone)
            found = lost & (status == FrameStatus.SEEN)
            if not found.any():
                break
            # the images support poses that were filled in: the frames between can be filled better
            for t in np.flatnonzero(found).tolist():
                fits[t] = smoothed.fits[t]
                decided[t] = fits[t].log_ratio
            lost &= ~found
        ambiguous = status == FrameStatus.CARRIED
        ambiguous[annotated] = False
        unseen = status >= FrameStatus.CARRIED
        ambiguous |= flag_edges(smoothed.fits, unseen, annotated, self._times)
        return [
            replace(
                frame,
                fit=smoothed.fits[t],
                status=FrameStatus(status[t]),
                resting=bool(smoothed.segment[t] >= 0),
                free_axis=smoothed.free_axis[t],
                ambiguous=frame.ambiguous or bool(ambiguous[t]),
            )
            for t, frame in enumerate(frames)
        ]

    def _decide_status(
        self, smoothed: _SmoothedTrack, decided: np.ndarray, gone: np.ndarray
    ) -> np.ndarray:
        """Decide the status (T,) of each frame.

        Args:
            smoothed: the solution over all frames.
            decided: (T,) log-likelihood ratios of the poses before smoothing, nats.
            gone: (T,) frames in which the object has left by the decision; such a frame is GONE
                instead of LOST if nothing else determines its pose.
        """
        ratio = np.array([fit.log_ratio for fit in smoothed.fits])
        poses = np.array([fit.pose for fit in smoothed.fits])
        unseen = ratio < SEEN_LOG_RATIO
        carried = smoothed.carried & unseen
        # a decided pose that lost 10 nats by smoothing fitted its frame only by chance
        contradicted = (unseen & (ratio < decided - 10)) | (ratio < CONTRADICTED_LOG_RATIO)
        contradicted &= ~carried | (ratio < DENIED_LOG_RATIO)
        seen = ~contradicted & (~unseen | ~smoothed.lost)
        bridged = smoothed.in_hand | self._between_equal_poses(poses, ~seen)
        nothing = np.where(gone, FrameStatus.GONE, FrameStatus.LOST)
        return np.select(  # the first condition that holds
            [contradicted, carried, seen, bridged],
            [nothing, FrameStatus.CARRIED, FrameStatus.SEEN, FrameStatus.BRIDGED],
            nothing,
        )

    def _between_equal_poses(self, poses: np.ndarray, lost: np.ndarray) -> np.ndarray:
        """Find frames (T,) in gaps of less than 0.3 s between equal poses.

        There the object stayed in place. ``poses`` (T, 4, 4), ``lost`` (T,) frames of the gaps.
        """
        result = np.zeros(len(lost), bool)
        for a, b in pairwise(np.flatnonzero(~lost).tolist()):
            if b - a > 1 and self._times[b] - self._times[a] < 0.3:
                turn, shift = pose_distances(self._mesh, poses[[a]], poses[[b]])
                result[a + 1 : b] = shift[0, 0] < UNSURE_M and turn[0, 0] < UNSURE_RAD
        return result

    def _smooth(
        self, fits: list[FittedPose], lost: np.ndarray, given: Sequence[GivenPose]
    ) -> _SmoothedTrack:
        """Solve for the track, evaluate the images at the solution, and solve again.

        Args:
            fits: decided fit of each frame.
            lost: (T,) frames whose pose is filled in and whose images are no evidence.
            given: annotated poses.
        """
        count = len(fits)
        filled = fill_lost(self._observer, np.array([fit.pose for fit in fits]), lost)
        poses = filled.poses
        motion = rigid_velocity(poses, ~lost, self._times)
        hidden = lost.copy()  # frames whose images are no evidence
        for pose in given:
            hidden[pose.frame] |= fits[pose.frame].log_ratio < SEEN_LOG_RATIO
        evidence = [
            None if hidden[t] else self._observer.evidence(t, poses[t], motion[t])
            for t in range(count)
        ]
        unseen = np.array([own is None or own.log_ratio < SEEN_LOG_RATIO for own in evidence])
        stated = GivenEvidence.of(self._mesh, given, poses, unseen, self._times)
        evaluated = poses.copy()
        track, covariance, segment = self._solve(evaluated, evidence, filled, stated, poses)
        motion = rigid_velocity(track, np.ones(count, bool), self._times)
        motion[segment >= 0] = 0
        # in reverse, because the views of the last frames are still cached
        for t in reversed(self._frames_to_reevaluate(segment)):
            again = self._observer.evidence(t, track[t], motion[t])
            before = evidence[t]
            # the old evaluation stays if the new pose explains the images clearly worse
            least = SEEN_LOG_RATIO if before is None else before.log_ratio - 2.0
            if again.log_ratio > least:
                evidence[t], evaluated[t] = again, track[t]
        track, covariance, segment = self._solve(evaluated, evidence, filled, stated, track)
        covariance *= np.outer(TURN_SCALE, TURN_SCALE)
        free_axis = self._free_axes(track, covariance)
        pairs = [pose_distances(self._mesh, evaluated[[t]], track[[t]]) for t in range(count)]
        turn, shift = np.array(pairs).reshape(-1, 2).T
        known = np.array([own is not None for own in evidence])
        # the final pose is far from the evaluated one: compare the images again
        moved_off = known & ((shift > UNSURE_M) | (turn > UNSURE_RAD)) | hidden
        result = []
        for t, (fit, own) in enumerate(zip(fits, evidence, strict=True)):
            views = own.reports if own else fit.views
            if moved_off[t]:
                views = self._observer.assess(t, track[t], twist=motion[t]).views
            result.append(FittedPose(track[t], covariance[t], views, motion[t]))
        lost = lost | (known & (shift > UNSURE_M))
        return _SmoothedTrack(result, segment, free_axis, lost, filled.sure, stated.carried)

    def _solve(
        self,
        evaluated: np.ndarray,
        evidence: list[ImageEvidence | None],
        filled: FilledTrack,
        stated: GivenEvidence,
        start: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Solve for poses (T, 4, 4), covariances (T, 6, 6) and rest segments (T,).

        Filled-in and annotated poses do not count as evidence for a rest.

        Args:
            evaluated: (T, 4, 4) poses at which the evidence was evaluated.
            evidence: evidence of each frame, None in lost ones.
            filled: poses of lost frames.
            stated: evidence of annotated poses.
            start: (T, 4, 4) start of the solver.
        """
        count = len(evaluated)
        noise = COMMON_ERROR_VARIANCE * views_noise([own for own in evidence if own is not None])
        information, gradient = np.zeros((count, 6, 6)), np.zeros((count, 6))
        for t, own in enumerate(evidence):
            if own is not None:
                information[t] = own.information.sum(0) / noise
                gradient[t] = own.gradient.sum(0) / noise
        combined = self._without_symmetry(FrameEvidence(evaluated, information, gradient))
        centre = self._mesh.centre_of_mass
        segment = find_rests(combined, self._observer.share, centre)
        segment[stated.exclude_from_rests(self._mesh, evaluated, segment)] = -1
        same = (segment[1:] == segment[:-1]) & (segment[1:] >= 0)
        node = np.concatenate([[0], np.cumsum(~same)])
        unseen = [own is None for own in evidence]
        in_hand, pull = filled.evidence(self._observer.share, noise)
        information[unseen], gradient[unseen] = in_hand[unseen], pull[unseen]
        combined = self._without_symmetry(FrameEvidence(evaluated, information, gradient))
        given = self._without_symmetry(stated.at(evaluated))
        poses, covariance = smooth(combined, start, node, self._times, centre, given)
        return poses, covariance, segment

    def _frames_to_reevaluate(self, segment: np.ndarray) -> list[int]:
        """Return all moving frames, and 12 frames of each rest segment (T,), evenly spread."""
        frames = list(np.flatnonzero(segment < 0))
        for number in range(segment.max(initial=-1) + 1):
            rest = np.flatnonzero(segment == number)
            some = np.linspace(0, len(rest) - 1, min(12, len(rest)))
            frames += list(rest[some.round().astype(int)])
        return sorted(map(int, frames))

    def _without_symmetry(self, evidence: FrameEvidence) -> FrameEvidence:
        """Remove the information that a round mesh's facets cause on turns about its axis."""
        information, gradient = evidence.information.copy(), evidence.gradient.copy()
        for t, pose in enumerate(evidence.poses):
            steps = free_turns(self._mesh, pose)
            information[t], gradient[t] = without_turns(information[t], gradient[t], steps)
        return FrameEvidence(evidence.poses, information, gradient)

    def _free_axes(self, poses: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        """Return axes (T, 3) about which a turn was not observed, 0 = none.

        These are axes of a continuous symmetry, about which ``covariance`` (T, 6, 6) is widened in
        place, or the least certain axis if its standard deviation exceeds 25 degrees.
        """
        axes = np.zeros((len(poses), 3))
        for t, pose in enumerate(poses):
            steps = free_turns(self._mesh, pose)
            for step in steps:
                along = step[:3] @ covariance[t][:3, :3] @ step[:3]
                covariance[t] += np.outer(step, step) * max(UNKNOWN_SIGMA[0] ** 2 - along, 0)
            if len(steps):
                axes[t] = steps[0, :3]
                continue
            variance, vectors = np.linalg.eigh(covariance[t][:3, :3])
            if variance[-1] > np.radians(25) ** 2:
                axes[t] = vectors[:, -1]
        return axes
