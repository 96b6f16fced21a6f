"""The decided track over all frames together: rest, smoothness, uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from intercap_core.geometry.solve.time_series import rigid_velocity
from intercap_core.object_track.constants import (
    BASIN,
    BRIDGED_S,
    COMMON_ERROR_VARIANCE,
    CONTRADICTED_LOG_RATIO,
    DENIED_LOG_RATIO,
    FREE_AXIS_SIGMA_RAD,
    RELOOK_LOG_RATIO,
    REST_FRAMES_SEEN_AGAIN,
    SEEN_LOG_RATIO,
    UNDONE_LOG_RATIO,
    UNKNOWN_SIGMA,
    UNSURE_M,
    UNSURE_RAD,
)
from intercap_core.object_track.evidence import PoseEvidence, views_noise
from intercap_core.object_track.filled import Filled, fill
from intercap_core.object_track.fit import Fit
from intercap_core.object_track.frame_result import FrameResult
from intercap_core.object_track.free_turns import free_turns, without_turns
from intercap_core.object_track.given_poses import (
    TURNS_LESS,
    GivenEvidence,
    GivenPose,
    at_edges,
    seconds_since,
)
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.rest import resting
from intercap_core.object_track.smooth import FrameEvidence, smooth
from intercap_core.object_track.steps import apart


class WholeTrack:
    """Refines the track of the object that ``observer`` sees; ``times`` (T,) seconds, ``share`` of
    an independent observation that a frame is."""

    def __init__(self, observer: Observer, times: np.ndarray, share: float) -> None:
        self._observer = observer
        self._mesh = observer.mesh
        self._times = times
        self._share = share

    def refine(
        self, frames: list[FrameResult], held: Sequence[GivenPose] = ()
    ) -> list[FrameResult]:
        """The frames with the poses, covariances, rests and free axes that all together show, and
        that the given poses say that are ``held``.

        A lost frame is found again where the likeliest way from the frames before to those after
        leads to a pose that the images support, where a hand surely carried it and they do not
        contradict, or where those around for a moment are at like poses. A frame that smoothing
        moves far from its own fit becomes lost, unless they support the smoothed pose, and so does
        one whose final pose they contradict. Where they show nothing, from a given pose on, it is
        carried from there, and in doubt in all frames but those that poses are given of; and so is
        what comes into sight or leaves it there in a single view.
        """
        lost = np.array([frame.lost for frame in frames])
        fits = [frame.fit for frame in frames]
        decided = np.array([fit.log_ratio for fit in fits])
        # what was followed without being seen is left to the given poses
        at = [given.frame for given in held]
        lost |= np.isfinite(seconds_since(at, decided < SEEN_LOG_RATIO, self._times))
        lost[at] = False
        fits, segment, free_axis, pulled, in_hand, reached = self._smoothed(fits, lost, held)
        ratio = np.array([fit.log_ratio for fit in fits])
        reached &= ratio < SEEN_LOG_RATIO
        # what was decided may have fitted one moment and not the motion through it
        undone = (ratio < SEEN_LOG_RATIO) & (ratio < decided - UNDONE_LOG_RATIO)
        contradicted = undone | (ratio < CONTRADICTED_LOG_RATIO)
        contradicted &= ~reached | (ratio < DENIED_LOG_RATIO)
        lost = ((lost | pulled) & (ratio < SEEN_LOG_RATIO)) | contradicted
        doubtful = reached.copy()
        doubtful[at] = False
        poses = np.array([fit.pose for fit in fits])
        lost &= contradicted | ~(in_hand | reached | self._nowhere(poses, lost))
        doubtful |= at_edges(fits, lost | reached, at, self._times)
        return [
            replace(
                frame,
                fit=fit,
                lost=bool(unseen),
                gone=frame.gone and bool(unseen),
                resting=bool(number >= 0),
                free_axis=axis,
                ambiguous=frame.ambiguous or bool(doubt),
                carried=bool(nothing),
            )
            for frame, fit, number, axis, unseen, nothing, doubt in zip(
                frames, fits, segment, free_axis, lost, reached, doubtful, strict=True
            )
        ]

    def _nowhere(self, poses: np.ndarray, lost: np.ndarray) -> np.ndarray:
        """Lost frames (T,) bool that are few, between two at like poses: it went nowhere."""
        found = np.zeros(len(lost), bool)
        for a, b in pairwise(np.flatnonzero(~lost).tolist()):
            if b - a > 1 and self._times[b] - self._times[a] < BRIDGED_S:
                turn, shift = apart(self._mesh, poses[[a]], poses[[b]])
                found[a + 1 : b] = shift[0, 0] < UNSURE_M and turn[0, 0] < UNSURE_RAD
        return found

    # --- all frames together -------------------------------------------------------------------

    def _smoothed(
        self, fits: list[Fit], lost: np.ndarray, held: Sequence[GivenPose]
    ) -> tuple[list[Fit], np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The fits, the number (T,) of the rest that each frame belongs to (-1: none), the axes
        (T, 3) about which nothing was seen, and which frames (T,) end far from what they show, in
        which lost ones a hand surely carries it, and which are reached from the poses ``held``."""
        poses = np.array([fit.pose for fit in fits])
        filled = fill(self._observer, poses, lost, self._times, self._share)
        poses = filled.poses
        motion = rigid_velocity(poses, ~lost, self._times)
        blind = lost.copy()
        for given in held:
            blind[given.frame] |= fits[given.frame].log_ratio < SEEN_LOG_RATIO
        found = [
            None if blind[t] else self._observer.evidence(t, poses[t], motion[t])
            for t in range(len(fits))
        ]
        stated = self._stated(held, poses, found)
        looked = poses.copy()
        track, covariance, segment = self._solved(looked, found, filled, stated, poses)
        motion = rigid_velocity(track, np.ones(len(fits), bool), self._times)
        motion[segment >= 0] = 0
        for t in reversed(
            self._worth_a_look(segment)
        ):  # the images read last are still in the cache
            again = self._observer.evidence(t, track[t], motion[t])
            before = found[t]
            least = SEEN_LOG_RATIO if before is None else _ratio(before) - RELOOK_LOG_RATIO
            if _ratio(again) > least:
                found[t], looked[t] = again, track[t]
        track, covariance, segment = self._solved(looked, found, filled, stated, track)
        covariance *= np.outer(TURNS_LESS, TURNS_LESS)
        free = self._free_axes(track, covariance)
        result = [
            Fit(pose, own, seen.reports if seen else fit.views, twist)
            for fit, pose, own, seen, twist in zip(
                fits, track, covariance, found, motion, strict=True
            )
        ]
        turn, shift = self._between(looked, track)
        known = np.array([seen is not None for seen in found])
        pulled = (shift > UNSURE_M) & known
        differs = known & ((shift > BASIN[0]) | (turn > np.radians(BASIN[1])))
        for t in map(int, np.flatnonzero(differs | blind)):
            seen = self._observer.assess(t, track[t], twist=motion[t])
            result[t] = replace(result[t], views=seen.views)
        return result, segment, free, pulled, filled.sure, stated.reached

    def _stated(
        self, held: Sequence[GivenPose], poses: np.ndarray, found: list[PoseEvidence | None]
    ) -> GivenEvidence:
        """What the given poses ``held`` say beside the ``poses`` (T, 4, 4), at which this was
        ``found``."""
        if not held:
            return GivenEvidence.none(poses)
        unseen = np.array([seen is None or _ratio(seen) < SEEN_LOG_RATIO for seen in found])
        return GivenEvidence.of(self._mesh, held, poses, unseen, self._times)

    def _between(self, one: np.ndarray, two: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far (T,) two tracks' poses (T, 4, 4) are turned, radians, and their centres apart,
        metres."""
        pairs = [apart(self._mesh, one[[t]], two[[t]]) for t in range(len(one))]
        turn, shift = np.array(pairs).reshape(-1, 2).T
        return turn, shift

    def _solved(
        self,
        looked: np.ndarray,
        found: list[PoseEvidence | None],
        filled: Filled,
        stated: GivenEvidence,
        start: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Poses and covariances of all frames from the evidence at ``looked`` (T, 4, 4), and the
        rests, for which what is ``filled`` in or ``stated`` does not count."""
        count = len(looked)
        noise = COMMON_ERROR_VARIANCE * views_noise([e for e in found if e is not None])
        information, gradient = np.zeros((count, 6, 6)), np.zeros((count, 6))
        for t, evidence in enumerate(found):
            if evidence is not None:
                information[t] = evidence.information.sum(0) / noise
                gradient[t] = evidence.gradient.sum(0) / noise
        combined = self._without_symmetry(FrameEvidence(looked, information, gradient))
        centre = self._mesh.centre_of_mass
        segment = resting(combined, self._times, centre)
        segment[stated.moving(self._mesh, looked, segment)] = -1
        same = (segment[1:] == segment[:-1]) & (segment[1:] >= 0)
        node = np.concatenate([[0], np.cumsum(~same)])
        unseen = [evidence is None for evidence in found]
        # what a hand tells of frames that follow each other is as good as one observation
        hand = self._share * filled.hand
        information[unseen] = (hand + filled.images / noise)[unseen]
        gradient[unseen] = filled.pull[unseen] * (self._share - 1 / noise)
        combined = self._without_symmetry(FrameEvidence(looked, information, gradient))
        told = None
        if stated.held:
            told = self._without_symmetry(
                FrameEvidence(looked, stated.information, stated.gradient(looked))
            )
        poses, covariance = smooth(combined, start, node, self._times, centre, told)
        return poses, covariance, segment

    def _worth_a_look(self, segment: np.ndarray) -> list[int]:
        """All moving frames and a few of each rest."""
        frames = list(np.flatnonzero(segment < 0))
        for number in range(segment.max(initial=-1) + 1):
            rest = np.flatnonzero(segment == number)
            some = (
                np.linspace(0, len(rest) - 1, min(REST_FRAMES_SEEN_AGAIN, len(rest)))
                .round()
                .astype(int)
            )
            frames += list(rest[some])
        return sorted(map(int, frames))

    def _without_symmetry(self, evidence: FrameEvidence) -> FrameEvidence:
        """The evidence without the spurious information of a round mesh's facets about its spin."""
        information, gradient = evidence.information.copy(), evidence.gradient.copy()
        for t, pose in enumerate(evidence.poses):
            steps = free_turns(self._mesh, pose)
            information[t], gradient[t] = without_turns(information[t], gradient[t], steps)
        return FrameEvidence(evidence.poses, information, gradient)

    def _free_axes(self, poses: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        """Axes (T, 3) about which a turn shows nothing; ``covariance`` becomes wide about them."""
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
            if variance[-1] > FREE_AXIS_SIGMA_RAD**2:
                axes[t] = vectors[:, -1]
        return axes


def _ratio(evidence: PoseEvidence) -> float:
    return sum(view.log_ratio for view in evidence.reports)
