"""Camera poses that the stage ``scene`` of another sequence estimated, as prior of this one.

The cameras of one day stand still between recordings. What one recording determined about their
poses and depth biases therefore holds for the others, up to its covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.errors import UserError
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.solve.robust import OUTLIER_SIGMAS
from intercap_core.scene.registration import (
    BIAS,
    PRIOR_ROTATION_RAD,
    PRIOR_TRANSLATION_M,
    RigEstimate,
    pose_differences,
)
from intercap_core.schemas import SCENE

# Mahalanobis distance from which a camera counts as moved: chance exceeds it once in a million (chi
# distribution of six degrees of freedom).
MOVED_DISTANCE = 6.2


@dataclass(frozen=True, eq=False)
class RigPrior:
    """Gaussian prior of the cameras' poses and depth biases."""

    sequence: str
    """Sequence that it was estimated from."""
    poses: np.ndarray
    """(C, 4, 4) mean of master_from_colour."""
    bias: np.ndarray
    """(C,) mean of the metres to subtract from depth."""
    covariance: np.ndarray
    """(C, 7, C, 7) of rotation about the camera's centre, rad, translation, metres, and depth
    bias, metres; 0 for the master's pose."""

    @classmethod
    def read(cls, path: Path, sequence: str, rig: Rig, master: str) -> RigPrior:
        """Read the cameras of a scene artefact, in the order of ``rig``.

        Raises UserError if the artefact lacks a camera, has another master, or if its calibration
        places a camera elsewhere.

        Args:
            path: scene artefact of another sequence.
            sequence: this sequence, for messages.
            rig: this sequence's cameras as given.
            master: name of this sequence's master camera.
        """
        with artefacts.read(path, SCENE) as scene:
            names, other = scene.text("camera_names"), str(scene.attributes["sequence"])
            place = f"{path}: sequence {sequence!r} has rig_from {other!r}, but"
            advice = f"name a sequence of the same cameras in the row of {sequence!r}, or clear it"
            lacking = sorted(set(rig.names) - set(names))
            if lacking:
                raise UserError(
                    f"{place} {other!r} has no camera {', '.join(lacking)} (it has "
                    f"{', '.join(names)}); {advice}"
                )
            if scene.attributes["master"] != master:
                raise UserError(
                    f"{place} the master camera of {other!r} is {scene.attributes['master']!r}, "
                    f"that of {sequence!r} is {master!r}; {advice}"
                )
            rows = [list(names).index(name) for name in rig.names]
            given = scene["master_from_colour_start"][rows]
            prior = cls(
                other,
                scene["master_from_colour"][rows],
                scene["depth_bias"][rows],
                scene["camera_covariance"][rows][:, :, rows],
            )
        # two careful calibrations of a camera that stands still
        away = np.abs(pose_differences(rig.master_from_colour, given))
        limit = np.sqrt(2) * OUTLIER_SIGMAS * _calibration_sigma()
        for name, own in zip(rig.names, away, strict=True):
            if (own > limit).any():
                raise UserError(
                    f"{place} their calibrations place camera {name} "
                    f"{1e3 * np.linalg.norm(own[3:]):.0f} mm and "
                    f"{np.degrees(np.linalg.norm(own[:3])):.1f} degrees apart, expected the same "
                    f"place; {advice}"
                )
        return prior

    def start(self, offset: np.ndarray) -> RigEstimate:
        """First estimate and mean of the prior, with time offsets (C,), seconds."""
        return RigEstimate(self.poses.copy(), self.bias.copy(), offset.copy())

    def precision(self, scale: float) -> np.ndarray:
        """Inverse (C, 7, C, 7) of the covariance over ``scale``; 0 for the master's pose."""
        count = len(self.poses)
        flat = self.covariance.reshape(count * 7, -1) / scale
        known = np.flatnonzero(np.diagonal(flat) > 0)
        result = np.zeros_like(flat)
        result[np.ix_(known, known)] = np.linalg.inv(flat[np.ix_(known, known)])
        return result.reshape(self.covariance.shape)

    def moved(self, poses: np.ndarray, covariance: np.ndarray) -> list[int]:
        """Cameras whose poses contradict the prior.

        Args:
            poses: (C, 4, 4) estimated without the prior.
            covariance: (C, 7, C, 7) of that estimate.
        """
        contradicting = []
        for c, away in enumerate(pose_differences(poses, self.poses)):
            both = (self.covariance + covariance)[c, :BIAS, c, :BIAS]
            if both.any() and away @ np.linalg.solve(both, away) > MOVED_DISTANCE**2:
                contradicting.append(c)
        return contradicting

    def without(self, cameras: list[int]) -> RigPrior:
        """The prior with the standard deviation of a calibration for the poses of ``cameras``."""
        covariance = self.covariance.copy()
        for c in cameras:
            covariance[c, :BIAS] = 0.0
            covariance[:, :, c, :BIAS] = 0.0
            covariance[c, :BIAS, c, :BIAS] = np.diag(_calibration_sigma() ** 2)
        return replace(self, covariance=covariance)


def _calibration_sigma() -> np.ndarray:
    """Standard deviations (6,) of the pose that a careful calibration gives."""
    return np.repeat([PRIOR_ROTATION_RAD, PRIOR_TRANSLATION_M], 3)
