"""Result of a calibration: the poses of a rig, their covariance, and the agreement of cameras."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from intercap_core.body.keypoints import KEYPOINT_INDEX
from intercap_core.calibrate.adjust import BoardTerm, JointTerm
from intercap_core.calibrate.evidence import CORNERS, JOINTS, Views
from intercap_core.calibrate.lenses import LensEstimate
from intercap_core.calibrate.placement import reference_points
from intercap_core.geometry.camera.rig import Rig, ring_centre
from intercap_core.scene.camera_verdicts import covariance_at

WEAK_M = 0.03  # estimated error from which a camera is called weak
CUBE_M = 2.0  # side of the cube whose points are displaced, as in the evaluation
_HIPS = [KEYPOINT_INDEX["left_hip"], KEYPOINT_INDEX["right_hip"]]


@dataclass(frozen=True, eq=False)
class Pair:
    """How well two cameras agree."""

    cameras: tuple[int, int]
    joints: int
    """Number of joints that both see at one time."""
    boards: int
    """Number of sets in which both see the board."""
    error_px: float
    """Median reprojection error of these joints in both, pixels of a 1080p image; NaN = none."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """Agreement of the images with the poses of a rig, and the person's way at these poses."""

    joint_px: np.ndarray
    """(C,) median reprojection error of joints, pixels of a 1080p image; NaN = none."""
    corner_px: np.ndarray
    """(C,) the same of the board's corners."""
    pairs: list[Pair]
    walk: np.ndarray
    """(T, 3) middle of the person's hips, master frame, metres; NaN = unknown."""


@dataclass(eq=False)
class FoundRig:
    """Poses of a rig and what they rest on."""

    rig: Rig
    """The cameras at their found poses, the master first."""
    covariance: np.ndarray
    """(C, 6, C, 6) of rotations about the cameras' centres, rad, and translations, metres."""
    residuals: Residuals
    joints: np.ndarray
    """(C,) number of joints seen together with another camera."""
    boards: np.ndarray
    """(C,) number of sets in which the camera sees the board."""
    lags: np.ndarray
    """(C,) sets by which the images of the first recording are late."""
    scale: str
    """What determines the scale."""
    by_background: dict[int, frozenset[int]] = field(default_factory=dict)
    """Cameras placed by the static background, with the cameras that agree on their poses."""
    notes: list[str] = field(default_factory=list)
    new_lenses: dict[str, LensEstimate] = field(default_factory=dict)
    """Estimated or refined lenses by camera."""

    def sigma_m(self, camera: int) -> float:
        """Root mean square displacement of a 2 m cube at the rig's centre as the camera sees it.

        Of a point x of the cube at c, the displacement by an error (w, v) of the pose with centre t
        is w x (x - t) + v. Its mean square is that at c plus |w|^2 times a sixth of the squared
        side.
        """
        pose = self.rig.master_from_colour[camera]
        block = self.covariance[camera, :, camera]
        variance = np.trace(covariance_at(block, pose, ring_centre(self.rig)))
        return float(np.sqrt(variance + CUBE_M**2 / 6 * np.trace(block[:3, :3])))


def count_shared_joints(views: Views) -> np.ndarray:
    """Number (C,) of joints that each camera sees together with another one."""
    seen = views.confidence[:, :, JOINTS] > 0
    return (seen & (seen.sum(1, keepdims=True) >= 2)).sum((0, 2))


def measure_residuals(
    rig: Rig, views: Views, joints: JointTerm, boards: BoardTerm | None
) -> Residuals:
    """Residuals at the poses of ``rig``, to which the points of both terms are first adapted."""
    poses, nothing = rig.master_from_colour, np.full(len(rig), np.nan)
    for term in (joints, boards):
        if term:
            term(poses, np.zeros(len(rig)))
    walk = reference_points(rig, views, list(range(len(rig))), None)[:, _HIPS].mean(1)
    return Residuals(
        joint_px=joints.errors_px(poses) if joints else nothing,
        corner_px=boards.errors_px(poses) if boards else nothing,
        pairs=_compare_pairs(rig, views, joints),
        walk=walk,
    )


def _compare_pairs(rig: Rig, views: Views, joints: JointTerm) -> list[Pair]:
    """Agreement of every pair of cameras with common joints or boards."""
    seen = np.isfinite(views.pixels[:, :, JOINTS, 0])
    boards = np.isfinite(views.pixels[:, :, CORNERS, 0]).any(2)
    sizes = joints.sizes_px(rig.master_from_colour)
    pairs = []
    for a, b in combinations(range(len(rig)), 2):
        own = sizes[:, [a, b]]
        own = own[np.isfinite(own).all(1)]
        error = float(np.median(own)) if len(own) else np.nan
        common = int((seen[:, a] & seen[:, b]).sum()), int((boards[:, a] & boards[:, b]).sum())
        if any(common):
            pairs.append(Pair((a, b), *common, error))
    return pairs
