"""Result of a calibration: the poses of a rig, their covariance, and the agreement of cameras."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from intercap_core.body.keypoints import KEYPOINT_INDEX
from intercap_core.calibrate.adjust import BoardTerm, JointTerm
from intercap_core.calibrate.evidence import CORNERS, JOINTS, Views
from intercap_core.calibrate.lenses import LensEstimate
from intercap_core.calibrate.placement import reference_points
from intercap_core.geometry.camera.rig import Rig, ring_centre
from intercap_core.scene.camera_verdicts import shift_by_pose

WEAK_M = 0.03  # estimated error from which a camera is called weak
CUBE_M = 2.0  # side of the cube whose points are displaced, as in the evaluation
_HIPS = [KEYPOINT_INDEX["left_hip"], KEYPOINT_INDEX["right_hip"]]


@dataclass(frozen=True, eq=False)
class Pair:
    """How well two cameras agree, by kind of evidence."""

    cameras: tuple[int, int]
    joints: int
    """Number of joints that both see at one time."""
    boards: int
    """Number of sets in which both see the board."""
    joint_px: float
    """Median reprojection error of these joints in both, pixels of a 1080p image; NaN = none."""
    corner_px: float
    """The same of the board's corners."""
    background_m: float
    """Median distance of held-out points of the background's surface, metres; NaN = none."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """Agreement of the images with the poses of a rig, and the person's way at these poses."""

    joint_px: np.ndarray
    """(C,) median reprojection error of joints, pixels of a 1080p image; NaN = none."""
    corner_px: np.ndarray
    """(C,) the same of the board's corners."""
    pairs: list[Pair]
    body: np.ndarray
    """(T, 25, 3) joints of the person, master frame, metres; NaN = unknown."""

    @property
    def walk(self) -> np.ndarray:
        """(T, 3) middle of the person's hips, master frame, metres; NaN = unknown."""
        return np.asarray(self.body[:, _HIPS].mean(1))


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
    scale_sigma: float = 0.0
    """Relative standard deviation of the scale, as far as it is common to all poses."""
    by_background: dict[int, frozenset[int]] = field(default_factory=dict)
    """Cameras placed by the static background, with the cameras that agree on their poses."""
    notes: list[str] = field(default_factory=list)
    new_lenses: dict[str, LensEstimate] = field(default_factory=dict)
    """Estimated or refined lenses by camera."""

    def sigma_m(self, camera: int) -> float:
        """Standard deviation of a camera relative to the master, see :meth:`pair_sigma_m`."""
        return self.pair_sigma_m(0, camera)

    def pair_sigma_m(self, a: int, b: int) -> float:
        """Root mean square displacement of a 2 m cube as camera a sees it from camera b's view.

        The cube is at the rig's centre c. An error (w, v) of a pose with centre t displaces a point
        x by w x (x - t) + v. The difference of both cameras' displacements has the mean square of
        that at c, plus |w_a - w_b|^2 times a sixth of the squared side.
        """
        poses, centre = self.rig.master_from_colour, ring_centre(self.rig)
        shift = [shift_by_pose(poses[c], centre) for c in (a, b)]
        turn = np.eye(3, 6)
        by_errors = np.concatenate(
            [
                np.concatenate([shift[0], -shift[1]], 1),
                np.sqrt(CUBE_M**2 / 6) * np.concatenate([turn, -turn], 1),
            ]
        )
        block = self.covariance[[a, b]][:, :, [a, b]].reshape(12, 12)
        return float(np.sqrt(np.trace(by_errors @ block @ by_errors.T)))


def count_shared_joints(views: Views) -> np.ndarray:
    """Number (C,) of joints that each camera sees together with another one."""
    seen = views.confidence[:, :, JOINTS] > 0
    return (seen & (seen.sum(1, keepdims=True) >= 2)).sum((0, 2))


def measure_residuals(
    rig: Rig,
    views: Views,
    joints: JointTerm,
    boards: BoardTerm | None,
    background_m: Mapping[tuple[int, int], float] | None = None,
) -> Residuals:
    """Residuals at the poses of ``rig``, to which the points of both terms are first adapted.

    Args:
        background_m: median distances of the background's surface by pair; None = unknown.
    """
    poses, nothing = rig.master_from_colour, np.full(len(rig), np.nan)
    for term in (joints, boards):
        if term:
            term(poses, np.zeros(len(rig)))
    body = reference_points(rig, views, list(range(len(rig))), None)[:, JOINTS]
    seen = np.isfinite(views.pixels[:, :, JOINTS, 0])
    with_board = np.isfinite(views.pixels[:, :, CORNERS, 0]).any(2)
    pairs = [
        Pair(
            (a, b),
            joints=int((seen[:, a] & seen[:, b]).sum()),
            boards=int((with_board[:, a] & with_board[:, b]).sum()),
            joint_px=_median_in_both(joints.sizes_px(poses)[:, [a, b]]),
            corner_px=_median_in_both(boards.sizes_px(poses)[:, [a, b]]) if boards else np.nan,
            background_m=(background_m or {}).get((a, b), np.nan),
        )
        for a, b in combinations(range(len(rig)), 2)
    ]
    return Residuals(
        joint_px=joints.errors_px(poses) if joints else nothing,
        corner_px=boards.errors_px(poses) if boards else nothing,
        pairs=pairs,
        body=body,
    )


def _median_in_both(sizes: np.ndarray) -> float:
    """Median of errors (N, 2) of points that both cameras see; NaN = none."""
    both = sizes[np.isfinite(sizes).all(1)]
    return float(np.median(both)) if len(both) else np.nan
