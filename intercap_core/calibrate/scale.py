"""Scale of a rig: by a measured distance or the subject's height; check of a board by depth."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.keypoints import KEYPOINT_INDEX
from intercap_core.body.loading import load_body_file
from intercap_core.calibrate.evidence import CORNERS, JOINTS, Views
from intercap_core.calibrate.found_rig import FoundRig
from intercap_core.calibrate.placement import board_pose, reference_points
from intercap_core.errors import UserError
from intercap_core.formats.calibration.boards import Board
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply_step

_SEGMENTS = [
    (f"{side}_{a}", f"{side}_{b}")
    for side in ("left", "right")
    for a, b in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
]
# Shoulders over ankles when the person is most upright, over its height in the body's T-pose. The
# relative error of the scale that remains: errors of the detector, and build. Both measured on
# recordings of the studio (config/rig) with a known height.
UPRIGHT, BUILD_SIGMA = 0.97, 0.025
HEIGHT_M, HEIGHT_SIGMA_M = 1.70, 0.095  # of adults of both sexes (NCD-RisC, eLife 2016), if unknown
STATED_SIGMA_M = 0.02  # of a stated height, as in the table of subjects

STATED_DISTANCE_M = 0.005  # standard deviation of a stated distance of two lenses
METRIC_SIGMA = 0.01  # relative, of the scale by depth or a board: a millimetre of a square of 0.1 m

SETS = 60  # of frames in which derivatives of the height are taken
MAX_BOARD_FACTOR = 0.05  # by which a board's size may contradict the depth


def scale_by_height(joints: np.ndarray, height_m: float | None) -> tuple[float, float]:
    """Metres for one unit of joints (T, K, 3), and the relative standard deviation.

    Two estimates are averaged, each by comparison with the open body scaled to the height: the
    median over the segments of the limbs, and the distance of the shoulders from the ankles.
    ``height_m`` None = unknown. NaN if no segment is known.
    """
    rest = _open_body_joints()

    def found(name: str) -> np.ndarray:
        return joints[:, KEYPOINT_INDEX[name]]

    def expected(name: str) -> np.ndarray:
        return rest[JOINT_INDEX[name]]

    ratios = []
    for a, b in _SEGMENTS:
        length = np.linalg.norm(found(a) - found(b), axis=1)
        if np.isfinite(length).any():
            ratios.append(np.linalg.norm(expected(a) - expected(b)) / np.nanmedian(length))
    ways = [float(np.median(ratios))] if ratios else []

    def trunk(of: Callable[[str], np.ndarray]) -> np.ndarray:
        both = ("left", "right")
        return sum(of(f"{side}_shoulder") - of(f"{side}_ankle") for side in both) / 2

    long = np.linalg.norm(trunk(found), axis=1)
    known: np.ndarray = long[np.isfinite(long)]
    if len(known) >= 20:  # sets; the most upright of fewer may be a bent one
        upright = UPRIGHT * np.linalg.norm(trunk(expected))
        ways.append(float(upright / np.quantile(known, 0.98)))
    height = height_m or HEIGHT_M
    sigma = STATED_SIGMA_M if height_m else HEIGHT_SIGMA_M
    scale = float(np.mean(ways)) * height if ways else float("nan")
    return scale, float(np.hypot(BUILD_SIGMA, sigma / height))


@cache  # a derivative of the scale needs many estimates
def _open_body_joints() -> np.ndarray:
    """Rest joints (J, 3) of the open body, in units of its stature."""
    body = load_body_file(None, num_betas=0, num_expression=0)
    joints = body.joint_regressor @ body.template / np.ptp(body.template[:, 1])
    joints.setflags(write=False)
    return joints


def rescale(
    found: FoundRig,
    views: Views,
    distance: tuple[str, str, float] | None,
    height_m: float | None,
) -> None:
    """Scale the rig by a stated distance or by the subject's height, in place."""
    rig, names = found.rig, found.rig.names
    if distance is not None:
        a, b = (names.index(name) for name in distance[:2])

        def length(poses: np.ndarray) -> float:
            return float(np.linalg.norm(poses[a, :3, 3] - poses[b, :3, 3]))

        scale, sigma = distance[2] / length(rig.master_from_colour), STATED_DISTANCE_M / distance[2]
        found.scale = f"the stated distance between {distance[0]} and {distance[1]}"
    else:
        some = views.subset(np.unique(np.linspace(0, len(views.times) - 1, SETS).astype(int)))

        def length(poses: np.ndarray) -> float:
            return 1 / _scale_by_height(rig.moved(poses), some, height_m)[0]

        scale, sigma = _scale_by_height(rig, views, height_m)
        if not np.isfinite(scale):
            raise UserError(
                "nothing determines the scale: the person's limbs are not seen; state the distance "
                "of two cameras (--distance k1:k2:METRES) or show a board"
            )
        stated = f"{height_m:.2f} m" if height_m else "unknown, taken as 1.70 m"
        found.scale = f"the subject's height ({stated})"
    poses = rig.master_from_colour.copy()
    poses[:, :3, 3] *= scale
    covariance = found.covariance.copy()
    covariance[:, 3:] *= scale
    covariance[:, :, :, 3:] *= scale
    found.rig, found.scale_sigma = rig.moved(poses), sigma
    found.covariance = add_scale_sigma(fix_scale(covariance, poses, length), poses, sigma)


def _scale_by_height(rig: Rig, views: Views, height_m: float | None) -> tuple[float, float]:
    joints = reference_points(rig, views, list(range(len(rig))), None)[:, JOINTS]
    return scale_by_height(joints, height_m)


def fix_scale(
    covariance: np.ndarray, poses: np.ndarray, length: Callable[[np.ndarray], float]
) -> np.ndarray:
    """Covariance (C, 6, C, 6) of poses that are scaled such that ``length`` has a given value.

    An error x of the poses that changes the length by g' x is followed by a change of the scale,
    by -g' x over the length: x - w g' x / (g' w), w the derivative of the poses by the scale's
    logarithm.
    """
    way, gradient = _by_scale(poses), np.zeros(6 * len(poses))
    for at in range(6, len(gradient)):  # the master does not move
        step = np.zeros((len(poses), 6))
        step.flat[at] = 1e-3
        gradient[at] = (length(apply_step(poses, step)) - length(apply_step(poses, -step))) / 2e-3
    fixed = np.eye(len(way)) - np.outer(way, gradient) / (gradient @ way)
    return (fixed @ covariance.reshape(len(way), -1) @ fixed.T).reshape(covariance.shape)


def add_scale_sigma(covariance: np.ndarray, poses: np.ndarray, sigma: float) -> np.ndarray:
    """Covariance (C, 6, C, 6) with an additional relative standard deviation of the scale."""
    way = _by_scale(poses)
    return covariance + sigma**2 * np.outer(way, way).reshape(covariance.shape)


def _by_scale(poses: np.ndarray) -> np.ndarray:
    """Steps (6 C,) of the poses by the logarithm of the scale."""
    steps = np.zeros((len(poses), 6))
    steps[:, 3:] = poses[:, :3, 3]
    return steps.ravel()


def compare_scales(
    found: FoundRig,
    views: Views,
    distance: tuple[str, str, float] | None,
    height_m: float | None,
) -> None:
    """Compare the scale by depth or a board with a stated distance and a stated height.

    Call it before :func:`rescale`. Contradictions become notes of ``found``. Raises UserError if
    the height contradicts a board that alone gives the scale.
    """
    sources = []
    if distance is not None:
        a, b = (found.rig.names.index(name) for name in distance[:2])
        poses = found.rig.master_from_colour
        length = float(np.linalg.norm(poses[a, :3, 3] - poses[b, :3, 3]))
        sigma = float(np.hypot(STATED_DISTANCE_M, found.pair_sigma_m(a, b))) / length
        sources.append(("the stated distance", distance[2] / length, sigma))
    if height_m is not None:
        sources.append(("the subject's height", *_scale_by_height(found.rig, views, height_m)))
    for name, ratio, sigma in sources:
        most = 3 * float(np.hypot(sigma, METRIC_SIGMA))
        if not abs(np.log(ratio)) > most:
            continue
        if found.scale == "board" and distance is None:
            raise UserError(
                f"by {name}, the board is {ratio:.2f} times as large as --board states, expected "
                f"within {100 * most:.0f} %. Measure a square on the printed board and correct "
                "--board, or correct the height in the table of subjects, or state the distance of "
                "two cameras (--distance). Nothing was written"
            )
        found.notes.append(
            f"by {name}, the rig is {ratio:.2f} times as large as by {found.scale}, expected "
            f"within {100 * most:.0f} %: measure again what is wrong"
        )


def check_board_size(rig: Rig, views: Views, board: Board) -> None:
    """Raise UserError if depth contradicts the board's size."""
    ratios = []
    for t, c in np.argwhere(np.isfinite(views.distance[:, :, CORNERS]).any(2)).tolist():
        pose = board_pose(rig[c], board, views.pixels[t, c, CORNERS])
        if pose is not None:
            away = np.linalg.norm(board.corners @ pose[:3, :3].T + pose[:3, 3], axis=1)
            ratios.append(np.nanmedian(views.distance[t, c, CORNERS] / away))
    if len(ratios) < 5:
        return
    ratio = float(np.median(ratios))
    if abs(ratio - 1) > MAX_BOARD_FACTOR:
        raise UserError(
            f"by the depth, the board is {ratio:.2f} times as large as --board states (or the "
            "depth's unit is wrong); measure a square on the printed board and correct --board"
        )
