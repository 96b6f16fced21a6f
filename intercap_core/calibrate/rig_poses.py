"""Poses of all cameras of a rig from everything that its recordings show."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from intercap_core.body.keypoints import NUM_KEYPOINTS
from intercap_core.calibrate.adjust import BoardTerm, JointTerm, adjust, jackknife_covariance
from intercap_core.calibrate.background import confirm_by_joints, place_by_background
from intercap_core.calibrate.checks import (
    check_agreement,
    check_gravity,
    check_walk,
    describe_unplaced,
    require_evidence,
    require_images,
)
from intercap_core.calibrate.evidence import (
    CORNERS,
    JOINTS,
    NUM_JOINTS,
    Nobody,
    Views,
    find_views,
)
from intercap_core.calibrate.found_rig import FoundRig, count_shared_joints, measure_residuals
from intercap_core.calibrate.lenses import LensEstimate, describe_coverage, estimate_lens
from intercap_core.calibrate.placement import (
    Placement,
    board_poses,
    first_camera,
    place_all,
    reference_points,
)
from intercap_core.calibrate.refine import refine_on_surfaces
from intercap_core.calibrate.scale import add_scale_sigma, check_board_size, compare_scales, rescale
from intercap_core.errors import UserError
from intercap_core.formats.calibration.boards import Board
from intercap_core.formats.detections.read import Detections, PeopleOfImages
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig, ring_centre
from intercap_core.geometry.camera.transforms import invert
from intercap_core.scene.background import camera_background
from intercap_core.scene.camera_verdicts import shift_by_pose
from intercap_core.scene.registration import Constraint
from intercap_core.scene.start_times import MAX_DELAY_S

log = logging.getLogger(__name__)

# Relative error of the scale that depth cameras share: the systematic error of an Azure Kinect is
# at most 11 mm + 0.1 % of the depth (data sheet), taken as two standard deviations; mean of six
# cameras at 2.5 m.
DEPTH_SCALE_SIGMA = 0.0015
# Groups of a jackknife; length of blocks of time, seconds: errors of detectors last for half a
# second (KEYPOINT_ERROR_TIME_S), those of occluded joints longer.
JACKKNIFE, BLOCK_S = 8, (0.5, 1.0)


def find_poses(
    recordings: Sequence[tuple[Path, Path | None]],
    *,
    board: Board | None,
    height_m: float | None,
    distance: tuple[str, str, float] | None,
    without_lens: frozenset[str] = frozenset(),
    keep_lenses: bool = True,
    background: bool = False,
) -> FoundRig:
    """Find the poses of all cameras; the first camera is the master.

    Raises UserError, with what to record instead, if the recordings do not determine all poses.

    Args:
        recordings: frames and detections artefacts of recordings of the rig (None = without
            detections); the first is used for surfaces.
        height_m: height of the subject, None = unknown; used if nothing else gives the scale.
        distance: two cameras and the metres between their lenses; overrides all other scales.
        without_lens: cameras whose lens is a guess, to be estimated from the board.
        keep_lenses: do not replace stated lenses (those in a Kinect's recording cannot be).
        background: place all cameras by the static background instead of joints and boards.
    """
    with ExitStack() as stack:
        opened = [stack.enter_context(Frames.open(frames)) for frames, _ in recordings]
        people: list[PeopleOfImages] = [
            Nobody(frames.num_sets) if path is None else Detections.load(path)
            for frames, (_, path) in zip(opened, recordings, strict=True)
        ]
        rig = opened[0].rig
        require_images(opened)
        log.info("looking for people%s", " and the board" if board else "")
        views = Views.joined(
            [find_views(f, p, rig, board) for f, p in zip(opened, people, strict=True)]
        )
        require_evidence(rig, views, board)
        notes: list[str] = []
        rig, new_lenses = _lenses(rig, views, board, without_lens, keep_lenses, notes)
        if board is not None:
            check_board_size(rig, views, board)
        max_lag = max(1, round(MAX_DELAY_S * opened[0].fps))
        found, views = _place(rig, views, board, max_lag, opened[0], background)
        found.notes += notes
        found.new_lenses = new_lenses
        _add_lens_errors(found)
        metric = first_camera(views) is not None or bool(found.by_background)
        found.scale = "depth" if metric else ""
        if metric and board is not None and found.boards.any():
            found.scale = "board" if not _has_depth(views) else "board and depth"
        check_agreement(found)
        terms = _terms(found.rig, views, board)
        background_m = _refine(found, opened[0], people[0], terms[1])
        if metric:
            compare_scales(found, views, distance, height_m)
        if distance is not None or not metric:
            rescale(found, views, distance, height_m)
        terms = _terms(found.rig, views, board)
        found.residuals = measure_residuals(found.rig, views, *terms, background_m)
        check_agreement(found)
        check_walk(found, views)
        check_gravity(found.rig, opened[0].gravity)
        return found


def _has_depth(views: Views) -> bool:
    return bool(np.isfinite(views.distance[:, :, JOINTS]).any())


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
    master's errors move all others together.
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
        if c:
            found.covariance[c, :, c] += own
            continue
        others = found.rig.master_from_colour[1:, :3, 3]
        by_master = np.concatenate(
            [np.concatenate([np.eye(3, 6), shift_by_pose(pose, other)]) for other in others]
        )
        shared = by_master @ own @ by_master.T
        found.covariance[1:, :, 1:] += shared.reshape(len(others), 6, len(others), 6)


def _terms(
    rig: Rig, views: Views, board: Board | None, placed: Sequence[int] | None = None
) -> tuple[JointTerm, BoardTerm | None]:
    """The terms of the adjustment with all cameras, or with the ``placed`` ones only."""
    placed = range(len(rig)) if placed is None else placed
    views = views.only(np.isin(np.arange(len(rig)), placed)[:, None])
    joints = JointTerm(rig, views, reference_points(rig, views, placed, None)[:, JOINTS])
    if board is None:
        return joints, None
    return joints, BoardTerm(rig, views, board, board_poses(rig, views, placed, board))


def _in_use(terms: tuple[JointTerm, BoardTerm | None]) -> list[Constraint]:
    return [term for term in terms if term is not None and len(term)]


def _place(
    rig: Rig, views: Views, board: Board | None, max_lag: int, frames: Frames, background: bool
) -> tuple[FoundRig, Views]:
    """Place and adjust all cameras, relative to the first of the rig.

    Returns also the views with corrected lags.
    """

    def improve(at: Rig, seen: Views, placed: Sequence[int]) -> Rig:
        terms = _in_use(_terms(at, seen, board, placed))
        return at.moved(adjust(terms, at.master_from_colour, placed[1:], steps=8)[0])

    log.info("placing %d cameras", len(rig))
    placed: list[int] = []
    left: list[Placement] = []
    if not background:
        rig, views, placed, left = place_all(rig, views, board, max_lag, improve)
    by_background: dict[int, frozenset[int]] = {}
    if len(placed) < len(rig):
        log.info("comparing backgrounds")
        unknown = np.full((frames.num_sets, NUM_KEYPOINTS, 3), np.nan)
        backgrounds = [camera_background(frames, c, unknown) for c in range(len(rig))]
        rig, by_background = place_by_background(rig, backgrounds, frames.gravity, placed)
        confirm_by_joints(rig, views, by_background)
        placed = sorted({*placed, *by_background})
    if len(placed) < len(rig):
        raise UserError(describe_unplaced(rig, placed, left))
    rig = rig.moved(invert(rig[0].master_from_colour) @ rig.master_from_colour)
    terms = _terms(rig, views, board)
    free = range(1, len(rig))
    poses, covariance, _ = adjust(_in_use(terms), rig.master_from_colour, free)
    rig = rig.moved(poses)
    found = FoundRig(
        rig=rig,
        covariance=covariance + _shared_errors(rig, views, board),
        residuals=measure_residuals(rig, views, *terms),
        joints=count_shared_joints(views),
        boards=(views.confidence[:, :, CORNERS] > 0).any(2).sum(0),
        lags=views.lags[0],
        scale="",
        by_background=by_background,
        notes=[
            f"{rig.names[c]} is placed by the background that it shares with "
            f"{', '.join(rig.names[w] for w in sorted(witnesses))}"
            for c, witnesses in sorted(by_background.items())
        ],
    )
    return found, views


def _shared_errors(rig: Rig, views: Views, board: Board | None) -> np.ndarray:
    """Covariance (C, 6, C, 6) of errors that many images share and that residuals do not show.

    It is the sum of two jackknives, with an eighth left out at a time: of the joints, since each
    joint errs alike in all images of a camera, and of the time, since joints and corners of one
    image err together.
    """
    poses, everyone = rig.master_from_colour, list(range(len(rig)))
    joints = reference_points(rig, views, everyone, None)[:, JOINTS]
    point, count = np.arange(views.pixels.shape[2]), len(views.times)
    gap = float(np.median(np.diff(views.times))) if count > 1 else BLOCK_S[0]
    block_s = np.clip(count * gap / JACKKNIFE, *BLOCK_S)
    block = (np.arange(count) * gap / block_s).astype(int)
    of_point = np.where(point < NUM_JOINTS, point % JACKKNIFE, -1)  # corners are never left out
    total = np.zeros((6 * len(rig), 6 * len(rig)))
    for group in (of_point, (block % JACKKNIFE)[:, None, None]):
        found = []
        for left_out in np.unique(group[group >= 0]):
            kept = views.only(group != left_out)
            boards = None
            if board is not None:
                boards = BoardTerm(rig, kept, board, board_poses(rig, kept, everyone, board))
            if terms := _in_use((JointTerm(rig, kept, joints), boards)):
                found.append(adjust(terms, poses, everyone[1:], steps=2)[0])
        total += jackknife_covariance(np.array(found), poses)
    return total.reshape(len(rig), 6, len(rig), 6)


def _refine(
    found: FoundRig, frames: Frames, people: PeopleOfImages, boards: BoardTerm | None
) -> dict[tuple[int, int], float]:
    """Refine the poses on depth surfaces, joints and ``boards``, in place.

    Returns the median distance of held-out points of the background by pair, metres. Raises
    UserError if surfaces do not confirm the cameras that were placed by their background.
    """
    background_m: dict[tuple[int, int], float] = {}
    if sum(camera.depth is not None for camera in found.rig) < 2:
        return background_m
    log.info("registering surfaces")
    terms = [boards] if boards else []
    for first in (True, False):  # the second time, people and backgrounds are found at better poses
        refined = refine_on_surfaces(frames.at(found.rig), people, 0, terms)
        if refined is None:
            if first and found.by_background:
                raise UserError(
                    "the cameras' backgrounds do not fit to each other at the poses by which most "
                    "of them agree; let a person walk through the common view, or show a board. "
                    "Nothing was written"
                )
            return background_m
        background_m = refined.background_m
        found.rig = found.rig.moved(refined.poses)
        poses, sigma = found.rig.master_from_colour, DEPTH_SCALE_SIGMA
        found.covariance = add_scale_sigma(refined.covariance, poses, sigma)
        before, after = refined.surfaces_mm
        log.info("surfaces: %.1f to %.1f mm apart", before, after)
    return background_m
