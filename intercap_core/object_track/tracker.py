"""The object's pose over time: hypotheses in every frame, one decision over all of them.

What a search finds in a few frames is followed both ways; a hidden Markov model says what is true
in every frame and how surely; where it is not sure, more is looked for and it decides again. The
continuous estimates follow from it: rest, smoothness, covariance (:mod:`.whole`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.config import ObjectTrackSettings
from intercap_core.geometry.camera.transforms import step_between
from intercap_core.geometry.rigid.mesh import ObjectMesh, Paint
from intercap_core.object_track.colour_decision import ColourDecision
from intercap_core.object_track.constants import (
    ABSENT_LOG_RATIO,
    AMBIGUOUS_PROBABILITY,
    APART_M,
    APART_RAD,
    DOUBTFUL_PROBABILITY,
    ERROR_LASTING_S,
    FREE_COST_S,
    GONE_PROBABILITY,
    LOST_PROBABILITY,
    MOTION_ROUNDS,
    NOTHING_LOG_RATIO,
    REACH_M,
    ROUNDS,
    SEEN_LOG_RATIO,
)
from intercap_core.object_track.decoder import NOT_SEEN, Decoded, decode
from intercap_core.object_track.fit import Fit
from intercap_core.object_track.frame_result import FrameResult, flagged
from intercap_core.object_track.given_poses import GivenPose, against
from intercap_core.object_track.hypotheses import Hypotheses
from intercap_core.object_track.mesh_check import mesh_doubts
from intercap_core.object_track.motion import HandMotion, hand_motions
from intercap_core.object_track.observer import Observer, Pictures
from intercap_core.object_track.prior import Prior, things
from intercap_core.object_track.proposals import NotFound, Proposals
from intercap_core.object_track.steps import excursions, step_costs, with_excursions
from intercap_core.object_track.view import View
from intercap_core.object_track.whole import WholeTrack


@dataclass(frozen=True)
class Track:
    """All frames (T), the frame that the track started from and how its pose was found:
    ``borne_out``, whether the track agrees with an annotated pose. ``evidence``: nats that the
    images of all believed frames say for it, as independent looks. ``doubts`` say in words what
    speaks against the mesh and against annotated poses."""

    frames: list[FrameResult]
    seed_frame: int
    annotated: bool
    evidence: float
    borne_out: bool = True
    doubts: tuple[str, ...] = ()

    @property
    def of_nothing(self) -> bool:
        """Whether the images say too little for there to be an object at all, which nobody who has
        annotated its pose is asked."""
        return not self.annotated and self.evidence < NOTHING_LOG_RATIO


class Tracker:
    """Tracks one object through one recording.

    ``load`` gives the views of frame t, one a camera; ``labels_by_view`` [T][C][candidates] the
    labels alone; ``times`` (T,) of the frames, seconds; ``labels`` the classes the object may be
    given; ``up`` (3,) the vertical; ``joints`` (T, 135, 3) of the person, who handles the object;
    ``pictures`` the views' colour images; ``paint`` the mesh's own colours.
    """

    def __init__(
        self,
        mesh: ObjectMesh,
        load: Callable[[int], list[View]],
        labels_by_view: list[list[list[str]]],
        settings: ObjectTrackSettings,
        *,
        times: np.ndarray,
        labels: tuple[str, ...],
        up: np.ndarray | None,
        joints: np.ndarray | None = None,
        pictures: Pictures | None = None,
        paint: Paint | None = None,
    ) -> None:
        self._observer = Observer(
            mesh, load, labels_by_view, settings, labels, up, joints, pictures, paint
        )
        self._mesh = mesh
        self._times = times
        self._hands = _hands(joints, len(times))
        step = float(np.median(np.diff(times))) if len(times) > 1 else ERROR_LASTING_S
        self._share = min(1.0, step / ERROR_LASTING_S)
        self._prior = Prior(self._observer, self._share)
        self._hypotheses = Hypotheses(self._observer, self._prior, self._share, times)
        self._proposals = Proposals(self._observer, self._hypotheses, self._prior, times, step)
        self._colours = ColourDecision(self._observer, self._hypotheses, self._share, step)
        self._emissions: list[np.ndarray] = []
        self._steps: list[np.ndarray] = []

    def run(self, given: Sequence[GivenPose] = ()) -> Track:
        """Track from ``given`` poses, or from what is searched for.

        Raises NotFound where no frame shows what could be the object.
        """
        annotated = [(one, self._proposals.annotated(one)) for one in given]
        placed = [taken for _, taken in annotated if taken is not None]
        seed = self._start([one.frame for one in placed])
        decoded = self._decode()
        decoded = self._look(decoded)
        if self._proposals.turn(decoded):
            decoded = self._decode()
        for _ in range(MOTION_ROUNDS):
            changed = self._hypotheses.see_moving(decoded)
            if not changed:
                break
            self._proposals.look_again(changed)
            decoded = self._look(self._decode())
        decoded = self._colours.decide(self._emissions, self._steps, decoded)
        if (decoded.path == NOT_SEEN).all():
            raise NotFound
        frames = self._results(decoded)
        held = [
            one
            for one, taken in annotated
            if taken is one and one.holds(self._mesh, frames[one.frame].fit.pose)
        ]
        refined = WholeTrack(self._observer, self._times, self._share).refine(frames, held)
        final = flagged(self._mesh, refined)
        # a recording that is shorter than one independent look is one all the same
        share = max(self._share, 1 / max(len(final), 1))
        evidence = share * sum(frame.fit.log_ratio for frame in final if not frame.lost)
        doubts = [
            told for one, taken in annotated if (told := against(self._mesh, one, taken, final))
        ]
        borne_out = not given or any(
            one.holds(self._mesh, final[one.frame].fit.pose) for one in placed
        )
        doubts += mesh_doubts(self._observer, final)
        return Track(final, seed, bool(given), evidence, borne_out, tuple(doubts))

    def _start(self, frames: list[int]) -> int:
        """The frame to start from: the first of the given ``frames`` that shows the object, else
        one that is searched for, else the first of them.

        Raises NotFound where there is none.
        """
        for t in frames:
            if self._hypotheses.shown(t):
                return t
        try:
            return self._proposals.start()
        except NotFound:
            if not frames:
                raise
            return frames[0]

    def _look(self, decoded: Decoded) -> Decoded:
        """Decide anew until nothing more is found in the frames in doubt."""
        for _ in range(ROUNDS):
            if not self._proposals.look(decoded):
                break
            decoded = self._decode()
        return decoded

    def _decode(self) -> Decoded:
        """Decide over all frames, and tell the places' prior where the object surely was."""
        fits = self._hypotheses.fits
        weights = [self._prior.weigh(t, own) for t, own in enumerate(fits)]
        poses = [np.array([fit.pose for fit in own]).reshape(-1, 4, 4) for own in fits]
        steps = self._step_costs(poses, np.full(len(poses) - 1, FREE_COST_S))
        self._emissions = [self._share * weight for weight in weights]
        absent = self._share * ABSENT_LOG_RATIO
        decoded = decode(self._emissions, steps, absent)
        # where somebody gave poses as it is out of sight, the usual motions explain nothing
        near = self._prior.near_given(self._times, decoded.path == NOT_SEEN)
        if near.any():
            free = np.where(near[1:] | near[:-1], 0.0, FREE_COST_S)
            steps = self._step_costs(poses, free)
            decoded = decode(self._emissions, steps, absent)
        sure = np.array(
            [k != NOT_SEEN and decoded.probability[t][k] > DOUBTFUL_PROBABILITY
             for t, k in enumerate(decoded.path)]
        )  # fmt: skip
        centres = [np.array([self._mesh.centre_at(p) for p in own]).reshape(-1, 3) for own in poses]
        away = excursions(centres, decoded.path, sure, self._times)
        self._steps = with_excursions(steps, away)
        decoded = decode(self._emissions, self._steps, absent)
        places = self._observer.places
        places.forget_clutter()
        for t, one in self._prior.given.items():
            self._tell_others(t, one, fits[t])
        for t, k in enumerate(decoded.path):
            if k != NOT_SEEN and decoded.probability[t][k] > DOUBTFUL_PROBABILITY:
                thing = things(fits[t])
                for other, fit in enumerate(fits[t]):
                    if thing[other] != thing[k] and fit.log_ratio > SEEN_LOG_RATIO:
                        places.seen_beside(t, centres[t][other], centres[t][k], fit.log_ratio)
        return decoded

    def _step_costs(self, poses: list[np.ndarray], free: np.ndarray) -> list[np.ndarray]:
        """Of the steps [T - 1] between the hypotheses' poses [T] (K, 4, 4), where free motion costs
        ``free`` (T - 1,) nats a second."""
        return [
            step_costs(
                self._mesh, poses[t], poses[t + 1], float(gap), self._hands[t], float(free[t])
            )
            for t, gap in enumerate(np.diff(self._times))
        ]

    def _tell_others(self, t: int, given: GivenPose, fits: list[Fit]) -> None:
        """Tell the places' prior what else the ``fits`` of frame t see than the object at the pose
        that is given of it."""
        centre = self._mesh.centre_at(given.pose)
        centres = np.array([self._mesh.centre_at(fit.pose) for fit in fits]).reshape(-1, 3)
        thing = things(fits)
        own = [thing[k] for k, fit in enumerate(fits) if given.holds(self._mesh, fit.pose)]
        far = np.linalg.norm(centres - centre, axis=1) > REACH_M + self._mesh.diameter
        for k, fit in enumerate(fits):
            if far[k] and thing[k] not in own and fit.log_ratio > SEEN_LOG_RATIO:
                self._observer.places.seen_beside_given(centres[k])

    # --- the outcome ---------------------------------------------------------------------------

    def _results(self, decoded: Decoded) -> list[FrameResult]:
        """The chosen hypotheses (T), what speaks against each and what the others add to its
        covariance."""
        result = []
        for t, (own, k) in enumerate(zip(self._hypotheses.fits, decoded.path, strict=True)):
            probability = decoded.probability[t]
            if k == NOT_SEEN:
                gone = bool(decoded.gone[t] > GONE_PROBABILITY)
                result.append(FrameResult(self._guess(t), True, gone=gone, probability=0.0))
                continue
            symmetry, pose = self._mesh.symmetry, own[k].pose
            poses = np.array([symmetry.nearest_equivalent_pose(fit.pose, pose) for fit in own])
            steps = step_between(np.broadcast_to(pose, poses.shape), poses)
            centres = np.array([self._mesh.centre_at(pose) for pose in poses])
            far = np.linalg.norm(steps[:, :3], axis=1) > APART_RAD
            far |= np.linalg.norm(centres - centres[k], axis=1) > APART_M
            other = float(probability[:-1][far].sum())
            overlap = own[k].mean_overlap
            lost = (
                probability[-1] > LOST_PROBABILITY
                or 0 < overlap < self._observer.settings.lost_overlap
            )
            rivals = np.where(far, probability[:-1], 0.0) * (other > AMBIGUOUS_PROBABILITY / 2)
            result.append(
                FrameResult(
                    own[k],
                    bool(lost),
                    ambiguous=other > AMBIGUOUS_PROBABILITY and not lost,
                    probability=float(probability[k]),
                    spread=np.einsum("k,ki,kj->ij", rivals, steps, steps),
                )
            )
        return result

    def _guess(self, t: int) -> Fit:
        """A frame in which nothing is believed: the nearest frame's pose, as it agrees here."""
        fits = self._hypotheses.fits
        u = min((u for u, own in enumerate(fits) if own), key=lambda u: abs(u - t))
        weights = self._prior.weigh(u, fits[u])
        found = self._observer.assess(t, fits[u][int(weights.argmax())].pose)
        return Fit(found.pose, np.eye(6), found.views)


def _hands(joints: np.ndarray | None, count: int) -> list[list[HandMotion | None]]:
    """How the hands move from each of the frames (T) to the next."""
    return [[] if joints is None else hand_motions(joints[[t, t + 1]]) for t in range(count - 1)]
