"""Compares the refined pose of each camera with its given pose on held-out data.

Each camera in turn gets its given pose back while the others stay refined. If that is not far
worse, the others are also refined with this camera fixed. The two are compared on the held-out
points of each pair with this camera (background and moving surfaces separately), and on keypoints
of the half of the recording that a second refinement did not use.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from intercap_core.scene.constraints import MIN_BODY_POINTS, BodyConstraint, BodyViews
from intercap_core.scene.registration import MOVING, STATIC, Registration, RigEstimate

MUST_IMPROVE = 0.98  # of the start's held-out cost, in one group at least; tuned on the studio
DOUBTFUL_RATIO = 0.5  # refined over given error from which a camera is judged again; tuned

Unit = TypeVar("Unit", bound=Hashable)
_KINDS = (("background", STATIC), ("moving surfaces", MOVING))


@dataclass(frozen=True)
class HeldOutComparison:
    """Held-out errors of one camera, refined against given pose."""

    kind: str
    """Name of the kind of data."""
    log_ratio: np.ndarray
    """(N,) log of refined over given error, by independent unit: a pair of cameras, or a joint for
    half a second."""

    @classmethod
    def of(
        cls, kind: str, given: Mapping[Unit, float], refined: Mapping[Unit, float]
    ) -> HeldOutComparison:
        """Compare errors by unit, over the units that both have."""
        both = [
            np.log(max(error, 1e-6) / max(given[unit], 1e-6))
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
        """Standard deviation of the mean; of few units at least the usual one."""
        # few units may agree by chance; tuned on the studio
        spread = max(float(self.log_ratio.std()), 0.25)
        return spread / np.sqrt(len(self.log_ratio))

    def __str__(self) -> str:
        percent = 100 * np.expm1(self.mean)
        return f"{self.kind} {percent:+.0f} %"


@dataclass(frozen=True)
class PoseVerdict:
    """Whether a camera's refined pose is significantly better."""

    refined: bool
    """The refined pose is kept."""
    evidence: tuple[HeldOutComparison, ...]
    """Comparison by kind of data."""

    @property
    def doubtful(self) -> bool:
        """Whether the given pose is not far worse."""
        if not self.evidence:
            return False
        mean = np.mean([e.mean for e in self.evidence])
        return not self.refined or bool(mean > np.log(DOUBTFUL_RATIO))

    @classmethod
    def of(cls, evidence: Sequence[HeldOutComparison]) -> PoseVerdict:
        """Decide from the evidence; every kind has the same weight."""
        if not evidence:  # the rig as a whole is better refined
            return cls(True, ())
        mean = np.mean([e.mean for e in evidence])
        sigma = np.sqrt(sum(e.sigma**2 for e in evidence)) / len(evidence)
        # by two standard deviations; tuned on the studio
        better = mean <= np.log(MUST_IMPROVE) and mean <= -2.0 * sigma
        return cls(bool(better), tuple(evidence))

    def __str__(self) -> str:
        if not self.evidence:
            return "refined with the rig: nothing that was held out shows this camera by itself"
        pose = "refined" if self.refined else "as given, refined it is not better beyond chance"
        return f"{pose} (held-out errors, {', '.join(map(str, self.evidence))})"


class PoseJudge:
    """Judges single cameras of a rig that was refined as a whole."""

    def __init__(
        self,
        registration: Registration,
        refine: Callable[[BodyViews | None, np.ndarray], RigEstimate],
        views: BodyViews | None,
        given: RigEstimate,
        refined: RigEstimate,
    ) -> None:
        """
        Args:
            refine: estimates the rig from keypoints (None = all) and free cameras (C,).
            views: keypoints of the subject; None = too few.
            given: given poses, with biases and offsets estimated for them.
            refined: all poses refined.
        """
        self._registration, self._refine = registration, refine
        self._given, self._refined = given, refined
        self._seen = self._halved = self._held_out = None
        if views is not None:
            seen, unseen = views.halves()
            if min(len(seen.points), len(unseen.points)) >= MIN_BODY_POINTS:
                self._seen = seen
                self._halved = refine(seen, np.ones(len(given.poses), bool))
                self._held_out = BodyConstraint(unseen, registration.rig)

    def verdicts(self, cameras: Sequence[int]) -> dict[int, PoseVerdict]:
        """Verdict of each of the ``cameras``.

        Doubtful cameras are judged again, with the rest of the rig refined for their given poses.
        """
        verdicts = {}
        for c in cameras:
            apart = _with_camera_of(self._refined, self._given, c)
            halved = None if self._halved is None else _with_camera_of(self._halved, self._given, c)
            verdicts[c] = self._compare(c, apart, halved)
        doubtful = [c for c, verdict in verdicts.items() if verdict.doubtful]
        if doubtful:
            free = np.ones(len(self._given.poses), bool)
            free[doubtful] = False
            apart = self._refine(None, free)
            halved = None if self._halved is None else self._refine(self._seen, free)
            verdicts |= {c: self._compare(c, apart, halved) for c in doubtful}
        return verdicts

    def _compare(self, camera: int, apart: RigEstimate, halved: RigEstimate | None) -> PoseVerdict:
        """Compare one camera's poses.

        ``apart``: estimate with this camera as given. ``halved``: the same without the held-out
        keypoints.
        """
        evidence = []
        for name, kind in _KINDS:
            medians = (
                self._registration.median_residuals(at, kind, camera)
                for at in (apart, self._refined)
            )
            evidence.append(HeldOutComparison.of(name, *medians))
        if halved is not None and self._halved is not None and self._held_out is not None:
            held_out = self._held_out
            errors = (
                held_out.unit_errors(at.poses, at.offset, camera) for at in (halved, self._halved)
            )
            evidence.append(HeldOutComparison.of("keypoints", *errors))
        return PoseVerdict.of([e for e in evidence if len(e.log_ratio)])


def _with_camera_of(at: RigEstimate, other: RigEstimate, camera: int) -> RigEstimate:
    """``at`` with one camera's pose, depth bias and time offset of ``other``."""
    mixed = RigEstimate(at.poses.copy(), at.bias.copy(), at.offset.copy())
    mixed.poses[camera] = other.poses[camera]
    mixed.bias[camera], mixed.offset[camera] = other.bias[camera], other.offset[camera]
    return mixed


def weakest_motion(
    covariance: np.ndarray, pose: np.ndarray, centre: np.ndarray
) -> tuple[float, np.ndarray]:
    """Largest standard deviation of the rig's centre due to one camera's pose, and its direction.

    Args:
        covariance: (7, 7) of the camera.
        pose: (4, 4) master from camera.
        centre: (3,) of the rig.

    Returns:
        Standard deviation, metres, and unit direction (3,).
    """
    across = np.cross(np.eye(3), centre - pose[:3, 3])  # row i: the shift by a turn about axis i
    by_pose = np.concatenate([across.T, np.eye(3)], axis=1)
    values, vectors = np.linalg.eigh(by_pose @ covariance[:6, :6] @ by_pose.T)
    return float(np.sqrt(max(values[-1], 0.0))), vectors[:, -1]


def describe_direction(direction: np.ndarray, pose: np.ndarray, up: np.ndarray) -> str:
    """Name a unit ``direction`` (3,) as seen by a camera at ``pose`` (4, 4), ``up`` (3,) unit."""
    steep = abs(float(direction @ up))
    if steep > 0.8:  # cosine
        return "up and down"
    ahead = pose[:3, 2] - (pose[:3, 2] @ up) * up
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    level = direction - (direction @ up) * up
    along = abs(float(level @ ahead)) / np.linalg.norm(level)
    way = "aslant to its view"
    if along > 0.8:
        way = "along its view"
    elif along < np.sqrt(1 - 0.8**2):
        way = "across its view"
    return f"along the floor, {way}" if steep < 0.5 else f"aslant to the floor, {way}"
