"""Each camera's own verdict: does its refined pose explain what did not take part better?

Every camera in turn gets its given pose back while the others stay refined; where that is not far
worse, the others are refined to suit it, too. What says which of the two is better: the held-out
points of each pair that it is in (background and moving surfaces apart), and keypoints of the half
of the time that a second refinement did not see.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.scene.constraints import MIN_BODY_POINTS, BodyConstraint, BodyViews
from intercap_core.scene.registration import (
    MOVING,
    STATIC,
    PairResiduals,
    Registration,
    RigEstimate,
)

MUST_IMPROVE = 0.98  # of the start's held-out cost, in one group at least; tuned on the studio
# By how many standard deviations a camera's refined pose has to be better than its given one; the
# least spread, of log ratios, that errors of units are taken to have. Tuned on the studio.
CHANCE_SIGMA, LEAST_UNIT_SPREAD = 2.0, 0.25
DOUBTFUL_RATIO = 0.5  # of refined over given errors: above it a camera gets a second look
WEAK_CAMERA_M = 0.010  # a camera that may slide by more is told


_KINDS = (("background", STATIC), ("moving surfaces", MOVING))
_LEAST = 1e-6  # of an error
_LEVEL, _STEEP, _ALONG = 0.5, 0.8, 0.8  # cosines by which a direction is named


@dataclass(frozen=True)
class PoseEvidence:
    """Of one ``kind`` for one camera: log ratios (N,) of errors, refined over given, of units that
    err independently: pairs of cameras, or a joint for half a second."""

    kind: str
    log_ratio: np.ndarray

    @classmethod
    def of(
        cls, kind: str, given: Mapping[Hashable, float], refined: Mapping[Hashable, float]
    ) -> PoseEvidence:
        """Of errors by unit, those units that both have."""
        both = [
            np.log(max(error, _LEAST) / max(given[unit], _LEAST))
            for unit, error in refined.items()
            if unit in given
        ]
        return cls(kind, np.array(both))

    @property
    def mean(self) -> float:
        """The mean log ratio, negative = better."""
        return float(self.log_ratio.mean())

    @property
    def sigma(self) -> float:
        """Its standard deviation; few units are taken to spread by a usual amount."""
        spread = max(float(self.log_ratio.std()), LEAST_UNIT_SPREAD)
        return spread / np.sqrt(len(self.log_ratio))

    def __str__(self) -> str:
        percent = 100 * np.expm1(self.mean)
        return f"{self.kind} {percent:+.0f} %"


@dataclass(frozen=True)
class PoseVerdict:
    """Whether a camera's refined pose is better beyond chance, and what says so."""

    refined: bool
    evidence: tuple[PoseEvidence, ...]

    @property
    def in_doubt(self) -> bool:
        """Whether the given pose is not far worse."""
        if not self.evidence:
            return False
        mean = np.mean([e.mean for e in self.evidence])
        return not self.refined or bool(mean > np.log(DOUBTFUL_RATIO))

    @classmethod
    def of(cls, evidence: Sequence[PoseEvidence]) -> PoseVerdict:
        """Every kind counts the same, however many units it has."""
        if not evidence:  # the rig as a whole is better refined
            return cls(True, ())
        mean = np.mean([e.mean for e in evidence])
        sigma = np.sqrt(sum(e.sigma**2 for e in evidence)) / len(evidence)
        better = mean <= np.log(MUST_IMPROVE) and mean <= -CHANCE_SIGMA * sigma
        return cls(bool(better), tuple(evidence))

    def __str__(self) -> str:
        if not self.evidence:
            return "refined with the rig: nothing that was held out shows this camera by itself"
        said = "refined" if self.refined else "as given, refined it is not better beyond chance"
        return f"{said} (held-out errors, {', '.join(map(str, self.evidence))})"


class PoseJudge:
    """Judges single cameras of a rig that was ``refined`` as a whole from ``held``, the given poses
    with the biases and offsets that suit them."""

    def __init__(
        self,
        registration: Registration,
        refine: Callable[[BodyViews | None, np.ndarray], RigEstimate],
        views: BodyViews | None,
        held: RigEstimate,
        refined: RigEstimate,
    ) -> None:
        """``refine`` (keypoints, None = all; which cameras (C,) may move) gives an estimate."""
        self._registration, self._refine = registration, refine
        self._held, self._refined = held, refined
        self._seen = self._halved = self._held_out = None
        if views is not None:
            seen, unseen = views.halves()
            if min(len(seen.points), len(unseen.points)) >= MIN_BODY_POINTS:
                self._seen = seen
                self._halved = refine(seen, np.ones(len(held.poses), bool))
                self._held_out = BodyConstraint(unseen, registration.rig)

    def verdicts(self, cameras: Sequence[int]) -> dict[int, PoseVerdict]:
        """Of each of the ``cameras``; those in doubt get a second look, the others of the rig
        refined to suit their given poses."""
        found = {}
        for c in cameras:
            apart = _with_camera_of(self._refined, self._held, c)
            halved = None if self._halved is None else _with_camera_of(self._halved, self._held, c)
            found[c] = self._compare(c, apart, halved)
        doubtful = [c for c, verdict in found.items() if verdict.in_doubt]
        if doubtful:
            free = np.ones(len(self._held.poses), bool)
            free[doubtful] = False
            apart = self._refine(None, free)
            halved = None if self._halved is None else self._refine(self._seen, free)
            found |= {c: self._compare(c, apart, halved) for c in doubtful}
        return found

    def _compare(self, camera: int, apart: RigEstimate, halved: RigEstimate | None) -> PoseVerdict:
        """``apart`` and ``halved``: the estimate with this camera as given, and that without the
        held-out keypoints."""
        evidence = []
        for name, kind in _KINDS:
            medians = (
                _by_pair(self._registration.residuals(at, kind, camera))
                for at in (apart, self._refined)
            )
            evidence.append(PoseEvidence.of(name, *medians))
        if halved is not None and self._halved is not None and self._held_out is not None:
            held_out = self._held_out
            errors = (
                held_out.unit_errors(at.poses, at.offset, camera) for at in (halved, self._halved)
            )
            evidence.append(PoseEvidence.of("keypoints", *errors))
        return PoseVerdict.of([e for e in evidence if len(e.log_ratio)])


def _by_pair(residuals: PairResiduals) -> dict[Hashable, float]:
    pairs = map(tuple, residuals.pairs.tolist())
    return dict(zip(pairs, residuals.median.tolist(), strict=True))


def _with_camera_of(at: RigEstimate, other: RigEstimate, camera: int) -> RigEstimate:
    """``at`` with one camera's pose, depth bias and time offset of ``other``."""
    mixed = RigEstimate(at.poses.copy(), at.bias.copy(), at.offset.copy())
    mixed.poses[camera] = other.poses[camera]
    mixed.bias[camera], mixed.offset[camera] = other.bias[camera], other.offset[camera]
    return mixed


def weakest_motion(
    covariance: np.ndarray, pose: np.ndarray, centre: np.ndarray
) -> tuple[float, np.ndarray]:
    """Standard deviation, metres, and unit direction (3,) in which the stated ``covariance``
    (7, 7) of a camera at ``pose`` (4, 4) lets the rig's ``centre`` (3,) slide most."""
    across = np.cross(np.eye(3), centre - pose[:3, 3])  # row i: the shift by a turn about axis i
    by_pose = np.concatenate([across.T, np.eye(3)], axis=1)
    values, vectors = np.linalg.eigh(by_pose @ covariance[:6, :6] @ by_pose.T)
    return float(np.sqrt(max(values[-1], 0.0))), vectors[:, -1]


def describe_direction(direction: np.ndarray, pose: np.ndarray, up: np.ndarray) -> str:
    """Name a unit ``direction`` (3,) as seen by a camera at ``pose`` (4, 4), ``up`` (3,) unit."""
    steep = abs(float(direction @ up))
    if steep > _STEEP:
        return "up and down"
    ahead = pose[:3, 2] - (pose[:3, 2] @ up) * up
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    level = direction - (direction @ up) * up
    along = abs(float(level @ ahead)) / np.linalg.norm(level)
    way = "aslant to its view"
    if along > _ALONG:
        way = "along its view"
    elif along < np.sqrt(1 - _ALONG**2):
        way = "across its view"
    return f"along the floor, {way}" if steep < _LEVEL else f"aslant to the floor, {way}"
