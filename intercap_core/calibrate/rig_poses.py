"""Poses of all cameras of a rig from everything that its recordings show."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from intercap_core.calibrate.adjust import BoardTerm, JointTerm, adjust
from intercap_core.calibrate.evidence import (
    CORNERS,
    JOINTS,
    MIN_SEEN,
    Nobody,
    Views,
    find_views,
)
from intercap_core.calibrate.lenses import LensEstimate, describe_coverage, estimate_lens
from intercap_core.calibrate.placement import (
    Placement,
    board_pose,
    board_poses,
    first_camera,
    place_all,
    reference_points,
)
from intercap_core.calibrate.refine import refine_on_surfaces
from intercap_core.calibrate.scale import scale_by_height
from intercap_core.errors import UserError
from intercap_core.formats.calibration.boards import Board
from intercap_core.formats.detections.read import Detections, PeopleOfImages
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig, ring_centre
from intercap_core.geometry.camera.transforms import invert
from intercap_core.scene.camera_verdicts import weakest_motion
from intercap_core.scene.registration import Constraint
from intercap_core.scene.start_times import MAX_DELAY_S

log = logging.getLogger(__name__)

MIN_WALK_M = 0.4  # extent of the person's way; less moves every joint within its detector's errors
WEAK_M = 0.03  # standard deviation at the rig's centre from which a camera is called weak
MAX_GRAVITY_DEG = 5.0  # between gravity sensors; one of a Kinect is within a degree
# Relative error of the scale that depth cameras share: the systematic error of an Azure Kinect is
# at most 11 mm + 0.1 % of the depth (data sheet), taken as two standard deviations; mean of six
# cameras at 2.5 m.
DEPTH_SCALE_SIGMA = 0.0015
MAX_BOARD_FACTOR = 0.05  # by which a board's size may contradict the depth


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


@dataclass(eq=False)
class FoundRig:
    """Poses of a rig and what they rest on."""

    rig: Rig
    """The cameras at their found poses, the master first."""
    covariance: np.ndarray
    """(C, 6, C, 6) of rotations about the cameras' centres, rad, and translations, metres."""
    joint_error_px: np.ndarray
    """(C,) median reprojection error of joints, pixels of a 1080p image; NaN = none."""
    corner_error_px: np.ndarray
    """(C,) the same of the board's corners."""
    joints: np.ndarray
    """(C,) number of joints seen together with another camera."""
    boards: np.ndarray
    """(C,) number of sets in which the camera sees the board."""
    lags: np.ndarray
    """(C,) sets by which the images of the first recording are late."""
    pairs: list[Pair]
    walk: np.ndarray
    """(T, 3) middle of the person's hips, master frame, metres; NaN = unknown."""
    scale: str
    """What determines the scale."""
    notes: list[str] = field(default_factory=list)
    new_lenses: dict[str, LensEstimate] = field(default_factory=dict)
    """Estimated or refined lenses by camera."""

    def sigma_m(self, camera: int) -> float:
        """Standard deviation of the rig's centre as the camera sees it, in its worst direction."""
        pose = self.rig.master_from_colour[camera]
        block = self.covariance[camera, :, camera]
        return weakest_motion(block, pose, ring_centre(self.rig))[0]


def find_poses(
    recordings: Sequence[tuple[Path, Path | None]],
    *,
    board: Board | None,
    height_m: float | None,
    distance: tuple[str, str, float] | None,
    without_lens: frozenset[str] = frozenset(),
    keep_lenses: bool = True,
) -> FoundRig:
    """Find the poses of all cameras; the first camera is the master.

    Raises UserError, with what to record instead, if the recordings do not determine all poses.

    Args:
        recordings: frames and detections artefacts of recordings of the rig, None = nobody is
            detected; the first is used for surfaces.
        height_m: height of the subject, None = unknown; used if nothing else gives the scale.
        distance: two cameras and the metres between their lenses; overrides all other scales.
        without_lens: cameras whose lens is a guess, to be estimated from the board.
        keep_lenses: do not replace stated lenses (those in a Kinect's recording cannot be).
    """
    with ExitStack() as stack:
        opened = [stack.enter_context(Frames.open(frames)) for frames, _ in recordings]
        people: list[PeopleOfImages] = [
            Nobody(frames.num_sets) if path is None else Detections.load(path)
            for frames, (_, path) in zip(opened, recordings, strict=True)
        ]
        rig = opened[0].rig
        _require_images(opened)
        log.info("looking for people%s", " and the board" if board else "")
        views = Views.joined(
            [find_views(f, p, rig, board) for f, p in zip(opened, people, strict=True)]
        )
        _require_evidence(rig, views, board)
        notes: list[str] = []
        rig, new_lenses = _lenses(rig, views, board, without_lens, keep_lenses, notes)
        if board is not None:
            _check_board_size(rig, views, board)
        found = _place(rig, views, board, max(1, round(MAX_DELAY_S * opened[0].fps)))
        found.notes += notes
        found.new_lenses = new_lenses
        _add_lens_errors(found)
        metric = first_camera(views) is not None
        found.scale = "depth" if metric else ""
        if metric and board is not None and found.boards.any():
            found.scale = "board" if not _has_depth(views) else "board and depth"
        if distance is not None or not metric:
            _rescale(found, views, distance, height_m)
        _check_walk(found)
        _refine(found, opened[0], people[0], board)
        _check_gravity(found.rig, opened[0].gravity)
        return found


def _has_depth(views: Views) -> bool:
    return bool(np.isfinite(views.distance[:, :, JOINTS]).any())


def _require_images(opened: Sequence[Frames]) -> None:
    names = opened[0].rig.names
    for frames in opened:
        if frames.rig.names != names:
            raise UserError(
                f"recording {frames.sequence!r} has cameras {', '.join(frames.rig.names)}, the "
                f"first has {', '.join(names)}; record all with the same rig and names"
            )
    absent = [n for c, n in enumerate(names) if not any(f.available[:, c].any() for f in opened)]
    if absent:
        raise UserError(
            f"camera {absent[0]!r} has no image in any frame set; `intercap check` says why"
        )


def _require_evidence(rig: Rig, views: Views, board: Board | None) -> None:
    """Raise UserError if neither a person nor the board is seen by two cameras."""
    joints = (views.confidence[:, :, JOINTS] > 0).sum(2) >= MIN_SEEN
    corners = (views.confidence[:, :, CORNERS] > 0).any(2)
    people, boards = int(joints.any(0).sum()), int(corners.any(0).sum())
    if board is not None and boards < 2:
        names = [rig.names[c] for c in np.flatnonzero(corners.any(0))]
        raise UserError(
            f"the board is visible to {f'camera {names[0]} only' if names else 'no camera'}: check "
            "the numbers of --board (columns, rows, dictionary), and hold the board still, close "
            "and facing each camera, so that two cameras at a time see it"
        )
    if people < 2 and boards < 2:
        raise UserError(
            f"a person is detected by {people} of {len(rig)} cameras; name the folder of keypoints "
            "in the table of sequences (or a keypoint model in the settings), let somebody walk "
            "through the views, or show a board (--board)"
        )


def _lenses(
    rig: Rig,
    views: Views,
    board: Board | None,
    without: frozenset[str],
    keep: bool,
    notes: list[str],
) -> tuple[Rig, dict[str, LensEstimate]]:
    """The rig with lenses estimated from the board, and those that are new."""
    cameras, new = list(rig), {}
    for c, camera in enumerate(rig):
        stated = camera.name not in without
        size = (camera.colour.width, camera.colour.height)
        lacks = "there is no board" if board is None else describe_coverage(views, c, size)
        if not stated and lacks:
            raise UserError(
                f"camera {camera.name!r} has no lens in the calibration, and {lacks}; add "
                "camera_matrix and distortion_coefficients, or show the board to it "
                "from 12 or more sides and in all parts of its image"
            )
        if board is None or lacks or (stated and keep):
            continue
        estimate = estimate_lens(views, c, board, camera.colour, stated=stated)
        notes += [f"{camera.name}: {estimate.note}"] if estimate.note else []
        if estimate.lens is not camera.colour:
            new[camera.name] = estimate
            depth = estimate.lens if camera.aligned else camera.depth
            cameras[c] = replace(camera, colour=estimate.lens, depth=depth)
    return Rig(tuple(cameras)), new


def _add_lens_errors(found: FoundRig) -> None:
    """Add the errors of estimated lenses to the covariance, in place.

    A wrong focal length moves the camera along its view, a wrong principal point turns it. The
    master's errors move all others.
    """
    centre = ring_centre(found.rig)
    for c, camera in enumerate(found.rig):
        lens = found.new_lenses.get(camera.name)
        if lens is None:
            continue
        pose = camera.master_from_colour
        along = lens.focal_sigma * float(np.linalg.norm(centre - pose[:3, 3]))
        own = np.zeros((6, 6))
        own[:3, :3] = lens.centre_sigma**2 * np.eye(3)
        own[3:, 3:] = along**2 * np.outer(pose[:3, 2], pose[:3, 2])
        for other in range(1, len(found.rig)) if c == 0 else (c,):
            found.covariance[other, :, other] += own


def _check_board_size(rig: Rig, views: Views, board: Board) -> None:
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


def _terms(
    rig: Rig, views: Views, placed: Sequence[int], board: Board | None
) -> tuple[JointTerm, BoardTerm | None]:
    """The terms of the adjustment with the ``placed`` cameras only."""
    hidden = [c for c in range(len(rig)) if c not in placed]
    pixels, confidence = views.pixels.copy(), views.confidence.copy()
    pixels[:, hidden], confidence[:, hidden] = np.nan, 0.0
    views = replace(views, pixels=pixels, confidence=confidence)
    joints = JointTerm(rig, views, reference_points(rig, views, placed, None)[:, JOINTS])
    if board is None:
        return joints, None
    return joints, BoardTerm(rig, views, board, board_poses(rig, views, placed, board))


def _in_use(terms: tuple[JointTerm, BoardTerm | None]) -> list[Constraint]:
    return [term for term in terms if term is not None and len(term)]


def _place(rig: Rig, views: Views, board: Board | None, max_lag: int) -> FoundRig:
    """Place and adjust all cameras, relative to the first of the rig."""

    def improve(at: Rig, seen: Views, placed: Sequence[int]) -> Rig:
        terms = _in_use(_terms(at, seen, placed, board))
        return at.moved(adjust(terms, at.master_from_colour, placed[1:], steps=8)[0])

    log.info("placing %d cameras", len(rig))
    before = views
    rig, views, placed, left = place_all(rig, views, board, max_lag, improve)
    if len(placed) < len(rig):
        raise UserError(_describe_unplaced(rig, placed, left))
    rig = rig.moved(invert(rig[0].master_from_colour) @ rig.master_from_colour)
    everyone = list(range(len(rig)))
    terms = _terms(rig, views, everyone, board)
    poses, covariance, _ = adjust(_in_use(terms), rig.master_from_colour, everyone[1:])
    # errors that sets share do not show in the residuals: compare the halves of the recording
    factor = _half_factor(rig.moved(poses), views, board, poses, covariance)
    rig = rig.moved(poses)
    joints, boards = terms
    walk = reference_points(rig, views, everyone, None)[:, 8]  # middle of the hips
    nothing = np.full(len(rig), np.nan)
    return FoundRig(
        rig=rig,
        covariance=factor * covariance,
        joint_error_px=joints.errors_px(poses) if len(joints) else nothing,
        corner_error_px=boards.errors_px(poses) if boards is not None and len(boards) else nothing,
        joints=_shared_joints(views),
        boards=(views.confidence[:, :, CORNERS] > 0).any(2).sum(0),
        lags=_lags(before, views),
        pairs=_pairs(rig, views, joints),
        walk=walk,
        scale="",
    )


def _half_factor(
    rig: Rig, views: Views, board: Board | None, poses: np.ndarray, covariance: np.ndarray
) -> float:
    """Factor on the covariance by which poses from even and from odd seconds differ; 1 or more."""
    everyone = list(range(len(rig)))
    even = np.floor(views.times).astype(int) % 2 == 0
    halves = []
    for rows in (even, ~even):
        if rows.sum() < 3:
            return 1.0
        terms = _in_use(_terms(rig, views.subset(rows), everyone, board))
        if not terms:
            return 1.0
        halves.append(adjust(terms, poses, everyone[1:], steps=10)[0])
    apart = np.linalg.norm((halves[0] - halves[1])[1:, :3, 3], axis=1)
    expected = [np.trace(covariance[c, 3:, c, 3:]) for c in everyone[1:]]
    # the difference of two halves has four times the variance of the whole
    return max(1.0, float(np.mean(apart**2 / np.maximum(expected, 1e-12))) / 4)


def _describe_unplaced(rig: Rig, placed: Sequence[int], left: Sequence[Placement]) -> str:
    """Message on the cameras that share too little with the others."""
    names = rig.names
    tried = {option.camera: option for option in left}
    reasons = []
    for c in range(len(rig)):
        if c in placed:
            continue
        option = tried.get(c)
        if option is None:
            reasons.append(f"{names[c]} sees too few points that others know at the same time")
        else:
            reasons.append(
                f"{names[c]}: {100 * option.share:.0f} % of {option.points} points agree"
            )
    known = ", ".join(names[c] for c in placed) or "none"
    return (
        f"not all cameras could be placed (placed: {known}; {'; '.join(reasons)}). Walk to and fro "
        "where these cameras and a placed one see you at the same time, for ten seconds or more, "
        "or show both a board; then calibrate again. Nothing was written"
    )


def _shared_joints(views: Views) -> np.ndarray:
    """Number (C,) of joints that each camera sees together with another one."""
    seen = views.confidence[:, :, JOINTS] > 0
    return (seen & (seen.sum(1, keepdims=True) >= 2)).sum((0, 2))


def _lags(before: Views, after: Views) -> np.ndarray:
    """Sets (C,) by which images of the first recording were moved."""
    lags = np.zeros(before.confidence.shape[1], int)
    rows = before.recording == 0
    sets = int(rows.sum())
    for c in range(len(lags)):
        old, new = (v.confidence[rows, c] for v in (before, after))
        agree = {
            lag: np.array_equal(old[lag:], new[: sets - lag])
            if lag >= 0
            else np.array_equal(old[:lag], new[-lag:])
            for lag in sorted(range(-sets + 1, sets), key=abs)
        }
        lags[c] = next((lag for lag, same in agree.items() if same), 0)
    return lags


def _pairs(rig: Rig, views: Views, joints: JointTerm) -> list[Pair]:
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


def _rescale(
    found: FoundRig,
    views: Views,
    distance: tuple[str, str, float] | None,
    height_m: float | None,
) -> None:
    """Scale the rig by a stated distance or by the subject's height, in place."""
    rig, names = found.rig, found.rig.names
    if distance is not None:
        for name in distance[:2]:
            if name not in names:
                known = ", ".join(names)
                raise UserError(f"--distance names camera {name!r}; expected one of {known}")
        a, b = (rig.master_from_colour[names.index(name), :3, 3] for name in distance[:2])
        scale, sigma = distance[2] / float(np.linalg.norm(a - b)), 0.005 / distance[2]  # 5 mm
        found.scale = f"the stated distance between {distance[0]} and {distance[1]}"
    else:
        joints = reference_points(rig, views, list(range(len(rig))), None)[:, JOINTS]
        scale, sigma = scale_by_height(joints, height_m)
        if not np.isfinite(scale):
            raise UserError(
                "nothing determines the scale: the person's limbs are not seen; state the distance "
                "of two cameras (--distance k1:k2:METRES) or show a board"
            )
        stated = f"{height_m:.2f} m" if height_m else "unknown, taken as 1.70 m"
        found.scale = f"the subject's height ({stated})"
        if not height_m:
            found.notes.append(
                f"the scale is known to {100 * sigma:.0f} % only: state the subject's height in "
                "the table of subjects, or the distance of two cameras (--distance)"
            )
    poses = rig.master_from_colour.copy()
    poses[:, :3, 3] *= scale
    covariance = found.covariance.copy()
    covariance[:, 3:] *= scale
    covariance[:, :, :, 3:] *= scale
    found.rig, found.walk = rig.moved(poses), scale * found.walk
    found.covariance = _with_scale_sigma(covariance, poses, sigma, replaced=True)


def _with_scale_sigma(
    covariance: np.ndarray, poses: np.ndarray, sigma: float, *, replaced: bool
) -> np.ndarray:
    """Covariance (C, 6, C, 6) with a relative standard deviation of the scale.

    ``replaced``: the scale's own variance is first removed, as if it were known exactly.
    """
    steps = np.zeros((len(poses), 6))
    steps[:, 3:] = poses[:, :3, 3]
    way, flat = steps.ravel(), covariance.reshape(6 * len(poses), -1)
    if replaced:
        coupled = flat @ way
        flat = flat - np.outer(coupled, coupled) / max(float(way @ coupled), 1e-12)
    return (flat + sigma**2 * np.outer(way, way)).reshape(covariance.shape)


def _check_walk(found: FoundRig) -> None:
    """Raise UserError if the poses rest on a person who stands still."""
    known: np.ndarray = found.walk[np.isfinite(found.walk[:, 0])]
    if found.boards.any() or len(known) < 2:
        return
    low, high = np.quantile(known, (0.02, 0.98), axis=0)
    extent = float(np.linalg.norm(high - low))
    if extent < MIN_WALK_M:
        raise UserError(
            f"the person moves by {extent:.2f} m only, expected at least {MIN_WALK_M:g} m: let the "
            "person walk through the whole area that the cameras share, or show a board. Nothing "
            "was written"
        )


def _refine(found: FoundRig, frames: Frames, people: PeopleOfImages, board: Board | None) -> None:
    """Refine the poses on depth surfaces, in place."""
    if sum(camera.depth is not None for camera in found.rig) < 2:
        return
    log.info("registering surfaces")
    for _ in range(2):  # the second time, people and backgrounds are found at better poses
        refined = refine_on_surfaces(frames.at(found.rig), people, 0, [])
        if refined is None:
            return
        found.rig = found.rig.moved(refined.poses)
        poses, sigma = found.rig.master_from_colour, DEPTH_SCALE_SIGMA
        found.covariance = _with_scale_sigma(refined.covariance, poses, sigma, replaced=False)
        before, after = refined.surfaces_mm
        log.info("surfaces: %.1f to %.1f mm apart", before, after)


def _check_gravity(rig: Rig, gravity: np.ndarray) -> None:
    """Raise UserError if the gravity sensors contradict the rotations of the cameras."""
    measured = np.flatnonzero(np.isfinite(gravity).all(1))
    if len(measured) < 2:
        return
    down = np.einsum("cij,cj->ci", rig.master_from_colour[measured, :3, :3], gravity[measured])
    middle = np.median(down, axis=0)
    off = np.degrees(np.arccos(np.clip(down @ (middle / np.linalg.norm(middle)), -1, 1)))
    worst = int(off.argmax())
    if off[worst] > MAX_GRAVITY_DEG:
        raise UserError(
            f"camera {rig.names[measured[worst]]}: its gravity sensor contradicts its found pose "
            f"by {off[worst]:.0f} degrees, expected at most {MAX_GRAVITY_DEG:g}; record a longer "
            "walk in the common view, or show a board. Nothing was written"
        )
