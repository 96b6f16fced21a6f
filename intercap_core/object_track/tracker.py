"""Track of the object: hypotheses in every frame and one decision over all frames.

1. Poses that a search finds in a few frames, and annotated poses, are followed forwards and
   backwards through the frames.
2. A hidden Markov model (:mod:`.decoder`) decides which hypothesis is true in every frame.
3. Uncertain frames are searched, and the model decides again, until no hypothesis is new. It also
   decides again after poses that a near symmetry makes as likely are added, and after moving
   objects are fitted again. The last decision includes the evidence of colours.
4. :mod:`.whole` refines the decided poses: rest, smoothness and covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from intercap_core.geometry.camera.transforms import step_between
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.solve.time_series import nearest
from intercap_core.object_track.colour_decision import ColourDecision
from intercap_core.object_track.decoder import (
    FREE_COST_S,
    HIDDEN,
    Decoded,
    MarkovModel,
    step_log_ratios,
)
from intercap_core.object_track.fit import FittedPose
from intercap_core.object_track.given_poses import GivenPose
from intercap_core.object_track.hypotheses import ANNOTATED_REACH_M, Hypotheses, group_by_candidates
from intercap_core.object_track.likelihood import SEEN_LOG_RATIO
from intercap_core.object_track.mesh_check import mesh_doubts
from intercap_core.object_track.motion import estimate_hand_motions
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.proposals import DOUBTFUL_PROBABILITY, NotFound, Proposals
from intercap_core.object_track.whole import FrameResult, FrameStatus, WholeTrack, flag_frames

# Log-likelihood ratio, per independent observation, of an object that has left to one that is
# hidden from all cameras. It outweighs the costs of leaving and of coming back after about two
# seconds.
ABSENT_LOG_RATIO = 1.0  # nats; tuned
# A frame is ambiguous if the probability of all different poses together is above this. A wrong
# frame without a flag is taken to cost as much as four that are checked in vain: 1 / (1 + 4).
AMBIGUOUS_PROBABILITY = 0.2
# Threshold of ``Track.evidence``: below it, the recording shows no object. False detections reach 8
# nats; the least of real objects (a cup behind a hand without depth) is about 25.
NOTHING_LOG_RATIO = 12.0  # nats; between the two, which were measured on the studio


@dataclass(frozen=True)
class Track:
    """The track of one recording."""

    frames: list[FrameResult]
    """Result of each frame (T)."""
    seed_frame: int
    """Frame from which the track started."""
    annotated: bool
    """Whether poses were annotated."""
    evidence: float
    """Sum of the log-likelihood ratios of the frames that are not lost, each times the share of an
    independent observation that a frame is, nats."""
    agrees: bool = True
    """Whether the track agrees with at least one annotated pose; True if there is none."""
    doubts: tuple[str, ...] = ()
    """Warnings about the mesh and annotated poses."""

    @property
    def shows_nothing(self) -> bool:
        """Whether the images show no object at all; never if poses are annotated."""
        return not self.annotated and self.evidence < NOTHING_LOG_RATIO


class Tracker:
    """Tracks the object of ``observer`` through its recording."""

    def __init__(self, observer: Observer) -> None:
        self._observer = observer
        self._mesh = observer.mesh
        count = observer.count
        self._hands = [estimate_hand_motions(observer.joints[t : t + 2]) for t in range(count - 1)]
        self._hypotheses = Hypotheses(observer)
        self._prior = self._hypotheses.prior
        self._proposals = Proposals(observer, self._hypotheses)
        self._colours = ColourDecision(observer, self._hypotheses)

    def run(self, annotated: Sequence[GivenPose] = ()) -> Track:
        """Track the object from annotated poses; without any, it is searched for.

        Raises NotFound if no frame shows a possible object.
        """
        used = [given for given in annotated if self._proposals.add_annotated(given)]
        seed = self._start([given.frame for given in used])
        decoded = self._search()
        if self._proposals.add_near_symmetries(decoded):
            decoded = self._decode()
        for _ in range(3):
            changed = self._hypotheses.refit_moving(decoded)
            if not changed:
                break
            self._proposals.allow_search_near(changed)
            decoded = self._search()
        decoded = self._colours.decide(self._model, decoded)
        if (decoded.path == HIDDEN).all():
            raise NotFound
        frames = self._results(decoded)

        def agrees(given: GivenPose, frames: list[FrameResult]) -> bool:
            return given.holds(self._mesh, frames[given.frame].fit.pose)

        agreeing = [given for given in used if agrees(given, frames)]
        final = flag_frames(self._mesh, WholeTrack(self._observer).refine(frames, agreeing))
        doubts = [
            describe_contradiction(self._mesh, given, final[given.frame]) for given in annotated
        ]
        doubts += mesh_doubts(self._observer, final)
        return Track(
            final,
            seed,
            bool(annotated),
            self._evidence(final),
            not annotated or any(agrees(given, final) for given in used),
            tuple(filter(None, doubts)),
        )

    def _evidence(self, frames: list[FrameResult]) -> float:
        """Return the log-likelihood ratio of all frames that are not lost, nats."""
        # a recording shorter than one independent observation counts as one
        share = max(self._observer.share, 1 / max(len(frames), 1))
        return share * sum(frame.fit.log_ratio for frame in frames if not frame.lost)

    def _start(self, annotated: list[int]) -> int:
        """Return the frame to start from.

        The first of the ``annotated`` frames that shows the object, else the result of a search,
        else the first annotated frame. Raises NotFound if there is none.
        """
        for t in annotated:
            if any(fit.log_ratio > SEEN_LOG_RATIO for fit in self._hypotheses.fits[t]):
                return t
        try:
            return self._proposals.start()
        except NotFound:
            if not annotated:
                raise
            return annotated[0]

    def _search(self) -> Decoded:
        """Decide, search uncertain frames and decide again until no hypothesis is new."""
        decoded = self._decode()
        for _ in range(15):
            if not self._proposals.search_uncertain(decoded):
                break
            decoded = self._decode()
        return decoded

    def _decode(self) -> Decoded:
        """Decide between the hypotheses of all frames, and update the prior of places accordingly.

        If the object is hidden near an annotated pose, the model decides a second time, with free
        motion at no cost there.
        """
        fits = self._hypotheses.fits
        weights = [self._prior.weigh(t, own) for t, own in enumerate(fits)]
        poses = [np.array([fit.pose for fit in own]).reshape(-1, 4, 4) for own in fits]
        share = self._observer.share
        self._model = MarkovModel(
            [share * weight for weight in weights],
            self._step_log_ratios(poses, np.full(len(poses) - 1, FREE_COST_S)),
            share * ABSENT_LOG_RATIO,
        )
        decoded = self._model.decode()
        # near annotated poses of a hidden object any motion is possible
        near = self._prior.near_annotated(decoded.path == HIDDEN)
        if near.any():
            free = np.where(near[1:] | near[:-1], 0.0, FREE_COST_S)
            self._model = replace(self._model, steps=self._step_log_ratios(poses, free))
            decoded = self._model.decode()
        centres = [np.array([self._mesh.centre_at(p) for p in own]).reshape(-1, 3) for own in poses]
        self._update_places(decoded, centres)
        return decoded

    def _step_log_ratios(self, poses: list[np.ndarray], free: np.ndarray) -> list[np.ndarray]:
        """Return :func:`.decoder.step_log_ratios` [T - 1] between the hypotheses of all frames.

        ``poses`` [T] (K, 4, 4) are those of the hypotheses, ``free`` (T - 1,) is the cost of free
        motion, nats per second.
        """
        return [
            step_log_ratios(
                self._mesh, poses[t], poses[t + 1], float(gap), self._hands[t], float(free[t])
            )
            for t, gap in enumerate(np.diff(self._observer.times))
        ]

    def _update_places(self, decoded: Decoded, centres: list[np.ndarray]) -> None:
        """Record the other objects that are seen while the object is surely elsewhere."""
        fits, places = self._hypotheses.fits, self._observer.places
        places.clear_rivals()
        for t, given in self._prior.given.items():
            self._exclude_others(t, given, centres[t])
        for t in np.flatnonzero(decoded.certainty > DOUBTFUL_PROBABILITY).tolist():
            k, number = decoded.path[t], group_by_candidates(fits[t])
            for other, fit in enumerate(fits[t]):
                if number[other] != number[k] and fit.log_ratio > SEEN_LOG_RATIO:
                    places.add_rival(t, centres[t][other], centres[t][k], fit.log_ratio)

    def _exclude_others(self, t: int, given: GivenPose, centres: np.ndarray) -> None:
        """Exclude the places of other objects that frame t shows, by its annotated pose.

        ``centres`` (K, 3) are those of the hypotheses of frame t.
        """
        fits = self._hypotheses.fits[t]
        number = group_by_candidates(fits)
        own = [number[k] for k, fit in enumerate(fits) if given.holds(self._mesh, fit.pose)]
        centre = self._mesh.centre_at(given.pose)
        far = np.linalg.norm(centres - centre, axis=1) > ANNOTATED_REACH_M + self._mesh.diameter
        for k, fit in enumerate(fits):
            if far[k] and number[k] not in own and fit.log_ratio > SEEN_LOG_RATIO:
                self._observer.places.exclude(centres[k])

    def _results(self, decoded: Decoded) -> list[FrameResult]:
        """Return the chosen hypothesis of each frame, with the spread of its rivals.

        Rivals are hypotheses more than 20 degrees or 5 cm away. They add to the covariance if their
        probability exceeds half of ``AMBIGUOUS_PROBABILITY``.
        """
        result = []
        for t, (own, k) in enumerate(zip(self._hypotheses.fits, decoded.path, strict=True)):
            probability = decoded.probability[t]
            if k == HIDDEN:
                status = FrameStatus.GONE if decoded.gone[t] > 0.5 else FrameStatus.LOST
                result.append(FrameResult(self._guess(t), status, probability=0.0))
                continue
            symmetry, pose = self._mesh.symmetry, own[k].pose
            poses = np.array([symmetry.nearest_equivalent_pose(fit.pose, pose) for fit in own])
            steps = step_between(np.broadcast_to(pose, poses.shape), poses)
            centres = np.array([self._mesh.centre_at(pose) for pose in poses])
            # rivals
            far = np.linalg.norm(steps[:, :3], axis=1) > np.radians(20)
            far |= np.linalg.norm(centres - centres[k], axis=1) > 0.05
            other = float(probability[:-1][far].sum())
            # probability[-1]: no hypothesis is true
            overlap = own[k].mean_overlap
            lost = probability[-1] > 0.5 or 0 < overlap < self._observer.settings.lost_overlap
            rivals = np.where(far, probability[:-1], 0.0) * (other > AMBIGUOUS_PROBABILITY / 2)
            result.append(
                FrameResult(
                    own[k],
                    FrameStatus.LOST if lost else FrameStatus.SEEN,
                    ambiguous=other > AMBIGUOUS_PROBABILITY and not lost,
                    probability=float(probability[k]),
                    spread=np.einsum("k,ki,kj->ij", rivals, steps, steps),
                )
            )
        return result

    def _guess(self, t: int) -> FittedPose:
        """Return a pose for frame t, where no hypothesis is true, compared with its images.

        It is the likeliest hypothesis of the nearest frame that has any.
        """
        fits = self._hypotheses.fits
        (u,) = nearest([u for u, own in enumerate(fits) if own], [t]).tolist()
        weights = self._prior.weigh(u, fits[u])
        assessed = self._observer.assess(t, fits[u][int(weights.argmax())].pose)
        return FittedPose(assessed.pose, np.eye(6), assessed.views)


def describe_contradiction(mesh: ObjectMesh, given: GivenPose, frame: FrameResult) -> str:
    """Return a warning if the track contradicts an annotated pose, else an empty string.

    ``frame`` is the final result of the annotated frame.
    """
    turn, shift = given.distance(mesh, frame.fit.pose)
    subject = (
        f"annotated pose of frame {given.frame} (stated to {1e3 * given.sigma_m:.0f} mm and "
        f"{np.degrees(given.sigma_rad):.0f} degrees)"
    )
    if not frame.lost and given.holds(mesh, frame.fit.pose):
        return ""
    if frame.lost:
        return f"{subject}: the images contradict it, and show the object nowhere; correct it"
    return (
        f"{subject}: the images show the object {1e3 * shift:.0f} mm and {np.degrees(turn):.0f} "
        "degrees from it; correct it"
    )
