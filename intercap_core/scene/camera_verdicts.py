"""Compares the refined pose of each camera with its given pose on held-out data.

For each camera, the refined rig is compared with the same rig in which this camera has its given
pose. The comparison uses data that the refinement did not use:

- held-out surface points of each pair with this camera, background and moving surfaces separately;
- keypoints of half of the recording, with a second refinement that used only the other half.

If the given pose is not far worse, the other cameras are refined again with this camera fixed. The
comparison is then repeated with that rig.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from intercap_core.scene.constraints import BodyConstraint, BodyViews
from intercap_core.scene.registration import MOVING, STATIC, Registration, RigEstimate

# Ratio of refined over given error above which the given pose is not far worse and the camera is
# compared again. Tuned on the studio.
DOUBTFUL_RATIO = 0.5

Unit = TypeVar("Unit", bound=Hashable)
_KINDS = (("background", STATIC), ("moving surfaces", MOVING))


@dataclass(frozen=True)
class HeldOutComparison:
    """Held-out errors of one camera, refined against given pose."""

    kind: str
    """Name of the kind of data."""
    log_ratio: np.ndarray
    """(N,) natural logarithm of refined over given error, one for each independent unit. A unit is
    a pair of cameras, or one joint during half a second."""

    @classmethod
    def of(
        cls, kind: str, given: Mapping[Unit, float], refined: Mapping[Unit, float]
    ) -> HeldOutComparison:
        """Compare the errors of those units that occur in both ``given`` and ``refined``."""
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
        """Standard deviation of the mean."""
        # the scatter is at least 0.25, because few units may agree by chance; tuned on the studio
        spread = max(float(self.log_ratio.std()), 0.25)
        return spread / np.sqrt(len(self.log_ratio))

    def __str__(self) -> str:
        percent = 100 * np.expm1(self.mean)
        return f"{self.kind} {percent:+.0f} %"


@dataclass(frozen=True)
class PoseVerdict:
    """Decision between a camera's refined and given pose."""

    refined: bool
    """True: the refined pose is significantly better and is kept."""
    evidence: tuple[HeldOutComparison, ...]
    """Comparison by kind of data; empty = no held-out data show this camera."""

    @property
    def doubtful(self) -> bool:
        """Whether the given pose may be right: it was chosen, or is not far worse."""
        if not self.evidence:
            return False
        mean = np.mean([e.mean for e in self.evidence])
        return not self.refined or bool(mean > np.log(DOUBTFUL_RATIO))

    @classmethod
    def of(cls, evidence: Sequence[HeldOutComparison]) -> PoseVerdict:
        """Decide from the evidence; every kind of data has the same weight."""
        if not evidence:  # verdicts are only computed if the refined rig as a whole is better
            return cls(True, ())
        mean = np.mean([e.mean for e in evidence])
        sigma = np.sqrt(sum(e.sigma**2 for e in evidence)) / len(evidence)
        # by two standard deviations, and by 2 %, which decides in long recordings; tuned
        return cls(bool(mean <= min(-2.0 * sigma, np.log(0.98))), tuple(evidence))

    def __str__(self) -> str:
        if not self.evidence:
            return "refined with the rig: no held-out data show this camera"
        pose = (
            "refined" if self.refined else "as given: the refined pose is not significantly better"
        )
        return f"{pose} (held-out errors, {', '.join(map(str, self.evidence))})"


def judge_poses(
    registration: Registration,
    refine: Callable[[BodyViews | None, np.ndarray], RigEstimate],
    views: BodyViews | None,
    given: RigEstimate,
    refined: RigEstimate,
    cameras: Sequence[int],
) -> dict[int, PoseVerdict]:
    """Judge the poses of single ``cameras`` of a rig that was refined as a whole.

    Doubtful cameras are compared a second time. All of them then have their given poses, and the
    other cameras are refined again with these fixed.

    Args:
        registration: gives the residuals of held-out surface points.
        refine: estimates the rig. Its arguments are the keypoints to use (None = all) and a mask
            (C,) of the cameras whose poses are estimated.
        views: keypoints of the subject; None = too few.
        given: given poses, with biases and offsets estimated for them.
        refined: all poses refined.
    """
    free = np.ones(len(given.poses), bool)
    # half of the keypoints, the rig refined with them, and the other half for evaluation
    seen, unseen = views.halves() if views is not None else (None, None)
    halved = held_out = None
    if seen and unseen and seen.suffice and unseen.suffice:
        halved, held_out = refine(seen, free), BodyConstraint(unseen, registration.rig)

    def compare(c: int, apart: RigEstimate, apart_halved: RigEstimate | None) -> PoseVerdict:
        """Compare camera c's poses with those of estimates in which it has its given pose.

        ``apart_halved`` is estimated without the held-out keypoints; None = too few keypoints.
        """
        evidence = []
        for name, kind in _KINDS:
            medians = (registration.median_residuals(at, kind, c) for at in (apart, refined))
            evidence.append(HeldOutComparison.of(name, *medians))
        if apart_halved is not None and halved is not None and held_out is not None:
            errors = (held_out.unit_errors(at.poses, at.offset, c) for at in (apart_halved, halved))
            evidence.append(HeldOutComparison.of("keypoints", *errors))
        return PoseVerdict.of([e for e in evidence if len(e.log_ratio)])

    verdicts = {}
    for c in cameras:
        mixed = None if halved is None else _with_camera_of(halved, given, c)
        verdicts[c] = compare(c, _with_camera_of(refined, given, c), mixed)
    doubtful = [c for c, verdict in verdicts.items() if verdict.doubtful]
    if doubtful:
        free[doubtful] = False
        apart = refine(None, free)
        mixed = None if halved is None else refine(seen, free)
        verdicts |= {c: compare(c, apart, mixed) for c in doubtful}
    return verdicts


def _with_camera_of(at: RigEstimate, other: RigEstimate, camera: int) -> RigEstimate:
    """``at`` with one camera's pose, depth bias and time offset of ``other``."""
    mixed = RigEstimate(at.poses.copy(), at.bias.copy(), at.offset.copy())
    mixed.poses[camera] = other.poses[camera]
    mixed.bias[camera], mixed.offset[camera] = other.bias[camera], other.offset[camera]
    return mixed


def covariance_at(covariance: np.ndarray, pose: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Covariance (3, 3) of a point as one camera sees it, square metres.

    Arguments as in :func:`weakest_motion`; ``point`` (3,) in the master frame, metres.
    """
    by_pose = shift_by_pose(pose, point)
    return np.asarray(by_pose @ covariance[:6, :6] @ by_pose.T)


def shift_by_pose(pose: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Displacement (3, 6) of a ``point`` (3,) by a rotation about the camera and a translation."""
    across = np.cross(np.eye(3), point - pose[:3, 3])  # row i: the shift by a turn about axis i
    return np.concatenate([across.T, np.eye(3)], axis=1)


def weakest_motion(
    covariance: np.ndarray, pose: np.ndarray, centre: np.ndarray
) -> tuple[float, np.ndarray]:
    """Direction in which one camera sees the rig's centre least accurately.

    The pose's covariance is propagated to the position of the centre. The result is the largest
    principal axis of that covariance (3, 3).

    Args:
        covariance: (7, 7) of the camera: rotation about its centre, rad, translation, depth bias.
        pose: (4, 4) master from camera.
        centre: (3,) of the rig, master frame, metres.

    Returns:
        Standard deviation, metres, and unit direction (3,), master frame.
    """
    values, vectors = np.linalg.eigh(covariance_at(covariance, pose, centre))
    return float(np.sqrt(max(values[-1], 0.0))), vectors[:, -1]


def describe_direction(direction: np.ndarray, pose: np.ndarray, up: np.ndarray) -> str:
    """Describe a unit ``direction`` (3,) relative to the view of a camera and to the floor.

    ``pose``: (4, 4) master from camera. ``up``: (3,) unit, master frame.
    """
    steep = abs(float(direction @ up))
    if steep > 0.8:  # cosine: within 37 degrees
        return "up and down"
    ahead = pose[:3, 2] - (pose[:3, 2] @ up) * up
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    level = direction - (direction @ up) * up
    along = abs(float(level @ ahead)) / np.linalg.norm(level)
    way = "oblique to its view"
    if along > 0.8:
        way = "along its view"
    elif along < np.sqrt(1 - 0.8**2):  # within 37 degrees of perpendicular
        way = "across its view"
    return f"along the floor, {way}" if steep < 0.5 else f"oblique to the floor, {way}"
