"""First poses of cameras: one camera after another is placed among the points that others know.

A *reference* point is known in 3D in the frame of the cameras placed so far: a corner of a board
whose pose a placed camera knows, a joint that two of them triangulate, or a joint that one of them
lifts by its depth. The pose of a further camera follows from its pixels of such points by RANSAC
(OpenCV's ``solvePnPRansac`` with SQPnP). The first camera needs depth or a board. Otherwise the
first two cameras are those whose essential matrix explains most pixels, and the scale stays
unknown.

Cameras may have started at different moments: all lags of whole sets are tried, and each camera
gets the lag of the least cost.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

from intercap_core.calibrate.evidence import CORNERS, JOINTS, NUM_JOINTS, Views
from intercap_core.formats.calibration.boards import Board
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply, invert, rigid
from intercap_core.geometry.camera.triangulation import triangulate
from intercap_core.scene.starts import shift_images

# Reprojection error of an inlier, pixels of a 1080p image. Lifted joints are 3 cm off, which is
# 12 px at 2.5 m from another side; twice that and the detector's error.
MAX_ERROR_PX = 30.0
MIN_POINTS = 60  # reference points of a camera, as body joints of more than two sets
MIN_GAIN = 0.02  # of the cost by which a lag is better than none; a set of a walk costs 0.1
MIN_SHARE = 0.5  # of inliers; wrong poses agree with two of five boards, or a quarter of the joints
MAX_COST = 0.3  # at a lag that cannot be compared with none, for lack of points at lag 0
FIRST_DISTANCE_M = 2.5  # assumed median distance of joints while the scale is unknown
_SOUGHT = 400  # reference points with which lags are searched


@dataclass(frozen=True, eq=False)
class Placement:
    """A camera's pose among the reference points."""

    camera: int
    colour_from_world: np.ndarray
    """(4, 4), metres."""
    lags: dict[int, int]
    """Sets by which its images are late, by recording."""
    share: float
    """Share of inliers."""
    points: int
    """Number of reference points that it sees."""

    @property
    def fits(self) -> bool:
        """Whether the pose is more than chance."""
        return self.points >= MIN_POINTS and self.share >= MIN_SHARE


def first_camera(views: Views) -> int | None:
    """The camera that knows most points by itself; None if none has depth or sees a board."""
    lifted = np.isfinite(views.distance[:, :, JOINTS]).sum((0, 2))
    corners = np.isfinite(views.pixels[:, :, CORNERS, 0]).sum((0, 2))
    known = lifted + corners
    return int(known.argmax()) if known.max() >= MIN_POINTS else None


def place(
    rig: Rig,
    views: Views,
    camera: int,
    placed: Sequence[int],
    reference: np.ndarray,
    max_lag: int,
) -> Placement | None:
    """Place one camera; None if it sees too few reference points or no pose fits any.

    Args:
        placed: the cameras that are placed.
        reference: (T, M, 3) points in their frame, metres; NaN = unknown.
        max_lag: largest lag that is tried, sets.
    """
    lags: dict[int, int] = {}
    unknown = []  # recordings without reference points
    for recording in np.unique(views.recording).tolist():
        rows = views.recording == recording
        known, pixels = reference[rows], views.pixels[rows, camera]
        costs = {}
        for lag in range(-max_lag, max_lag + 1) if max_lag else ():
            found = _solve(rig[camera], known, _shifted(pixels, lag), _SOUGHT)
            if found is not None and found[3] >= MIN_POINTS:
                costs[lag] = found[1]
        lags[recording] = _clearest(costs)
        unknown += [] if costs else [recording]
    for recording, lag in lags.items():
        views = views.late(camera, recording, lag) if lag else views
    found = _solve(rig[camera], reference, views.pixels[:, camera], None)
    if found is None:
        return None
    pose, _, share, points = found
    poses = rig.master_from_colour.copy()
    poses[camera] = invert(pose)
    for recording in unknown if max_lag else ():
        rows = views.recording == recording
        cameras = [*placed, camera]
        lags[recording] = _lag_of_rays(rig.moved(poses), views.subset(rows), cameras, max_lag)
    return Placement(camera, pose, lags, share, points)


def _lag_of_rays(rig: Rig, views: Views, cameras: Sequence[int], max_lag: int) -> int:
    """Lag of the last of the ``cameras`` at which its rays to joints meet those of the others."""
    limit, some = MAX_ERROR_PX, Rig(tuple(rig[c] for c in cameras))
    costs = {}
    for lag in range(-max_lag, max_lag + 1):
        moved = views.late(cameras[-1], int(views.recording[0]), lag)
        seen = (moved.confidence[:, cameras][:, :, JOINTS] > 0).all(1)
        t, k = np.nonzero(seen)
        if len(t) < MIN_POINTS:
            continue
        rows = np.linspace(0, len(t) - 1, min(_SOUGHT, len(t))).astype(int)
        t, k = t[rows], k[rows]
        pixels, weights = (v[t, :, k][:, cameras] for v in (moved.pixels, moved.confidence))
        points = triangulate(pixels, weights, some, max_error_px=limit)
        error = np.nan_to_num(points.error, nan=limit) / limit
        error[~points.inlier[:, -1]] = 1.0
        costs[lag] = float((np.minimum(error, 1.0) ** 2).mean())
    return _clearest(costs)


def _clearest(costs: dict[int, float]) -> int:
    """The lag of least cost, or 0 if its cost is hardly less than that of lag 0.

    A person who stands still fits at all lags. A lag at which a few points overlap fits by chance.
    """
    if not costs:
        return 0
    best = min(costs, key=lambda lag: (costs[lag], abs(lag)))
    return best if costs[best] < costs.get(0, MAX_COST) - MIN_GAIN else 0


def _shifted(values: np.ndarray, lag: int) -> np.ndarray:
    """Values (T, ...) of ``lag`` sets later; NaN outside."""
    return shift_images(values[:, None], np.array([lag]), np.nan)[:, 0]


def _solve(
    camera: Camera, reference: np.ndarray, pixels: np.ndarray, most: int | None
) -> tuple[np.ndarray, float, float, int] | None:
    """Pose (4, 4), truncated cost, share of inliers, number of points; None = no pose."""
    known = np.isfinite(reference[..., 0]) & np.isfinite(pixels[..., 0])
    points, seen = reference[known], pixels[known]
    if most is not None and len(points) > most:
        rows = np.linspace(0, len(points) - 1, most).astype(int)
        points, seen = points[rows], seen[rows]
    rays = camera.colour.unproject(seen)
    good = np.isfinite(rays).all(1)
    points, seen, rays = points[good], seen[good], np.ascontiguousarray(rays[good, :2])
    if len(points) < MIN_POINTS:
        return None
    limit = MAX_ERROR_PX * camera.colour.height / 1080
    found, turn, shift, rows = cv2.solvePnPRansac(
        points, rays, np.eye(3), None, iterationsCount=200,
        reprojectionError=limit / camera.colour.fx, confidence=0.999, flags=cv2.SOLVEPNP_SQPNP,
    )  # fmt: skip
    if not found or rows is None or len(rows) < MIN_POINTS // 4:
        return None
    rows = rows.ravel()
    turn, shift = cv2.solvePnPRefineLM(points[rows], rays[rows], np.eye(3), None, turn, shift)
    pose = rigid(cv2.Rodrigues(turn)[0], shift.ravel())
    in_camera = apply(pose, points)
    error = np.linalg.norm(camera.colour.project(in_camera) - seen, axis=1)
    error[~(in_camera[:, 2] > 0)] = np.inf
    cost = float((np.minimum(error / limit, 1.0) ** 2).mean())
    return pose, cost, float((error < limit).mean()), len(points)


def reference_points(
    rig: Rig, views: Views, placed: Sequence[int], board: Board | None
) -> np.ndarray:
    """Points (T, M, 3) that the ``placed`` cameras know, master frame, metres; NaN = unknown."""
    result = np.full((len(views.times), views.pixels.shape[2], 3), np.nan)
    result[:, JOINTS] = _joints(rig, views, placed)
    if board is not None:
        poses = board_poses(rig, views, placed, board)
        result[:, CORNERS] = np.einsum("tij,nj->tni", poses[:, :3, :3], board.corners)
        result[:, CORNERS] += poses[:, None, :3, 3]
    return result


def _joints(rig: Rig, views: Views, placed: Sequence[int]) -> np.ndarray:
    """Joints (T, K, 3): triangulated if two cameras agree, else the median of lifted points."""
    sets = len(views.times)
    lifted = np.full((len(placed), sets, NUM_JOINTS, 3), np.nan)
    for k, c in enumerate(placed):
        rays = rig[c].colour.unproject(views.pixels[:, c, JOINTS])
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        points = rays * views.distance[:, c, JOINTS, None]
        lifted[k] = apply(rig[c].master_from_colour, points.reshape(-1, 3)).reshape(points.shape)
    known = np.isfinite(lifted[..., 0])
    result = np.full((sets, NUM_JOINTS, 3), np.nan)
    some = known.any(0)
    result[some] = np.nanmedian(lifted[:, some], axis=0)
    if len(placed) > 1:
        pixels, weights = (
            np.swapaxes(values[:, placed][:, :, JOINTS], 1, 2)
            for values in (np.nan_to_num(views.pixels), views.confidence)
        )
        points = triangulate(
            pixels.reshape(-1, len(placed), 2), weights.reshape(-1, len(placed)),
            Rig(tuple(rig[c] for c in placed)), max_error_px=MAX_ERROR_PX,
        ).points.reshape(result.shape)  # fmt: skip
        agreed = np.isfinite(points[..., 0])
        result[agreed] = points[agreed]
    return result


def board_poses(rig: Rig, views: Views, placed: Sequence[int], board: Board) -> np.ndarray:
    """Poses (T, 4, 4) master_from_board by the camera that sees most corners; NaN = not seen."""
    result = np.full((len(views.times), 4, 4), np.nan)
    seen = np.isfinite(views.pixels[:, :, CORNERS, 0])
    count = seen.sum(2)
    for t in np.flatnonzero(count[:, placed].any(1)):
        c = max(placed, key=lambda c: count[t, c])
        pose = board_pose(rig[c], board, views.pixels[t, c, CORNERS])
        if pose is not None:
            result[t] = rig[c].master_from_colour @ pose
    return result


def board_pose(camera: Camera, board: Board, pixels: np.ndarray) -> np.ndarray | None:
    """Pose (4, 4) colour_from_board of corners at ``pixels`` (N, 2), NaN = not seen."""
    rays = camera.colour.unproject(pixels)
    known = np.isfinite(rays).all(1)
    found, turn, shift = cv2.solvePnP(
        board.corners[known], np.ascontiguousarray(rays[known, :2]), np.eye(3), None,
        flags=cv2.SOLVEPNP_IPPE,
    )  # fmt: skip
    return rigid(cv2.Rodrigues(turn)[0], shift.ravel()) if found else None


def first_pair(rig: Rig, views: Views, max_lag: int) -> tuple[int, Placement] | None:
    """First camera, and the placement of a second one by the essential matrix of body joints.

    The scale is arbitrary: joints are :data:`FIRST_DISTANCE_M` from the first camera. None if no
    two cameras see the person from different sides.
    """
    options = []
    for a, b in combinations(range(len(rig)), 2):
        rays = [rig[c].colour.unproject(views.pixels[:, c, JOINTS])[..., :2] for c in (a, b)]
        limit = MAX_ERROR_PX / 3 * rig[a].colour.height / 1080 / rig[a].colour.fx
        costs = {
            lag: 1 - found[2]
            for lag in range(-max_lag, max_lag + 1)
            if (found := _essential(rays[0], _shifted(rays[1], lag), limit, _SOUGHT))
        }
        lag = _clearest(costs)
        found = _essential(rays[0], _shifted(rays[1], lag), limit, None)
        if found is None:
            continue
        pose, parallax, share, points, distance = found
        pose[:3, 3] *= FIRST_DISTANCE_M / distance
        lags = dict.fromkeys(np.unique(views.recording).tolist(), lag)
        options.append((share * points * parallax, a, Placement(b, pose, lags, share, points)))
    if not options:
        return None
    _, first, second = max(options, key=lambda option: option[0])
    return (first, second) if second.fits else None


def _essential(
    first: np.ndarray, second: np.ndarray, limit: float, most: int | None
) -> tuple[np.ndarray, float, float, int, float] | None:
    """Relative pose with a baseline of 1 from rays (T, K, 2) of two cameras.

    Returns second_from_first (4, 4), the sine of the median parallax, share of inliers, number of
    points, and the median distance of points from the first camera, in baselines; None = no pose.
    """
    known = np.isfinite(first[..., 0]) & np.isfinite(second[..., 0])
    a, b = first[known], second[known]
    if most is not None and len(a) > most:
        rows = np.linspace(0, len(a) - 1, most).astype(int)
        a, b = a[rows], b[rows]
    if len(a) < MIN_POINTS:
        return None
    matrix, inlier = cv2.findEssentialMat(
        a, b, np.eye(3), method=cv2.USAC_MAGSAC, prob=0.999, threshold=limit
    )
    if matrix is None or matrix.shape != (3, 3):
        return None
    count, turn, shift, front, points = cv2.recoverPose(
        matrix, a, b, np.eye(3), distanceThresh=50.0, mask=inlier.copy()
    )
    good = front.ravel() > 0
    if count < MIN_POINTS // 4:
        return None
    place = (points[:3] / points[3]).T[good]
    to_second = place - (-turn.T @ shift).ravel()
    away = np.linalg.norm(place, axis=1)
    sine = np.linalg.norm(np.cross(place, to_second), axis=1)
    sine /= away * np.linalg.norm(to_second, axis=1)
    pose, far = rigid(turn, shift.ravel()), float(np.median(away))
    return pose, float(np.median(sine)), count / len(a), len(a), far


def place_all(
    rig: Rig,
    views: Views,
    board: Board | None,
    max_lag: int,
    improve: Callable[[Rig, Views, Sequence[int]], Rig],
) -> tuple[Rig, Views, list[int], list[Placement]]:
    """Place as many cameras as possible, the one with most inliers first.

    Args:
        improve: adjusts the poses of the placed cameras (its last argument) after each step.

    Returns:
        The rig in the frame of the first camera, the views with corrected lags, the placed cameras
        in their order, and the best attempt at each camera that could not be placed.
    """
    first = first_camera(views)
    rig = rig.moved(np.broadcast_to(np.eye(4), (len(rig), 4, 4)))
    if first is not None:
        placed = [first]
    else:
        pair = first_pair(rig, views, max_lag)
        if pair is None:
            return rig, views, [], []
        placed = [pair[0]]
        rig, views = _with(rig, views, pair[1])
        placed.append(pair[1].camera)
        rig = improve(rig, views, placed)
    while True:
        reference = reference_points(rig, views, placed, board)
        waiting = [c for c in range(len(rig)) if c not in placed]
        options = [o for c in waiting if (o := place(rig, views, c, placed, reference, max_lag))]
        fitting = [option for option in options if option.fits]
        if not fitting:
            return rig, views, placed, options
        best = max(fitting, key=lambda option: option.share * option.points)
        rig, views = _with(rig, views, best)
        placed.append(best.camera)
        rig = improve(rig, views, placed)


def _with(rig: Rig, views: Views, option: Placement) -> tuple[Rig, Views]:
    poses = rig.master_from_colour.copy()
    poses[option.camera] = invert(option.colour_from_world)
    for recording, lag in option.lags.items():
        views = views.late(option.camera, recording, lag) if lag else views
    return rig.moved(poses), views
