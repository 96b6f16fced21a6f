"""Bundle adjustment: normal equations, convergence and covariance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from intercap_core.calibrate.adjust import (
    CORNER_PX,
    CORNERS_OF_IMAGE,
    DISTANCE_M,
    INSET_M,
    JOINT_PX,
    BoardTerm,
    JointTerm,
    adjust,
    jackknife_covariance,
)
from intercap_core.calibrate.evidence import CORNERS, NUM_JOINTS
from intercap_core.calibrate.found_rig import FoundRig, Residuals
from intercap_core.calibrate.scale import fix_scale
from intercap_core.formats.calibration.boards import parse_board
from intercap_core.geometry.camera.rig import Rig, ring_centre
from intercap_core.geometry.camera.transforms import apply, apply_step, invert, step_between
from intercap_core.geometry.solve.robust import geman_mcclure_weight
from intercap_core.scene.constraints import KEYPOINT_ERROR_TIME_S, ROBUST_SIGMA
from tests.calibrate.synthetic_views import FPS, board_poses_around, views_of_walker, with_board
from tests.helpers.synthetic_capture import extrinsics_error, perturbed

BOARD = parse_board("checkerboard:3x4:0.1")
STEP = 1e-6


def derivatives(residuals: Callable[[np.ndarray], np.ndarray], size: int) -> np.ndarray:
    """Central differences (R, size) of residuals (R,) at zero."""
    units = STEP * np.eye(size)
    return np.stack([(residuals(u) - residuals(-u)) / (2 * STEP) for u in units], -1)


def reduced(matrix: np.ndarray, vector: np.ndarray, kept: int) -> tuple[np.ndarray, np.ndarray]:
    """Schur complement of the first ``kept`` unknowns."""
    solved = np.linalg.solve(
        matrix[kept:, kept:], np.column_stack([matrix[kept:, :kept], vector[kept:]])
    )
    cross = matrix[:kept, kept:]
    return matrix[:kept, :kept] - cross @ solved[:, :-1], vector[:kept] - cross @ solved[:, -1]


def assert_equal_systems(
    found: tuple[np.ndarray, np.ndarray], expected: tuple[np.ndarray, np.ndarray]
) -> None:
    size = len(expected[1])
    scale = np.abs(expected[0]).max()
    np.testing.assert_allclose(found[0].reshape(size, size) / scale, expected[0] / scale, atol=1e-4)
    slope = np.abs(expected[1]).max()
    np.testing.assert_allclose(found[1].ravel() / slope, expected[1] / slope, atol=1e-3)


def robust_pixels(
    rig: Rig, poses: np.ndarray, points: np.ndarray, seen: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (N, C, 2), pixels of a 1080p image, 0 = not seen; and their lengths (N, C)."""
    found = np.stack(
        [c.colour.project(apply(invert(p), points)) for c, p in zip(rig, poses, strict=True)], 1
    )
    scale = np.array([camera.colour.height / 1080 for camera in rig])[:, None]
    residual = np.nan_to_num((found - seen) / scale)
    return residual, np.linalg.norm(residual, axis=-1)


def pixel_weights(size: np.ndarray, seen: np.ndarray, least: float) -> np.ndarray:
    known = np.isfinite(seen[..., 0])
    sigma = max(least, float(np.median(size[known])) / 1.177)
    return np.where(known, geman_mcclure_weight(size**2, ROBUST_SIGMA * sigma) / sigma**2, 0.0)


def test_normal_equations_of_joints_agree_with_a_dense_system() -> None:
    rig, joints, views = views_of_walker(3, 3, noise_px=4.0, depth=True)
    views.pixels[0, 1, 3:9], views.confidence[0, 1, 3:9] = np.nan, 0.0
    views.distance[:, 2], views.distance[1] = np.nan, np.nan
    term = JointTerm(rig, views, joints)
    poses = perturbed(rig, np.random.default_rng(3), 0.02, 0.5).master_from_colour
    system = term(poses, np.zeros(3))

    count = len(term)
    assert count == 3 * NUM_JOINTS
    t, k = np.divmod(np.arange(count), NUM_JOINTS)
    seen, distance = views.pixels[t, :, k], views.distance[t, :, k]
    share = 1 / FPS / KEYPOINT_ERROR_TIME_S * views.confidence[t, :, k]

    def residuals(step: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        pose, inset, point = np.split(step, [18, 18 + NUM_JOINTS])
        moved, points = apply_step(poses, pose.reshape(3, 6)), term.points + point.reshape(-1, 3)
        insets = term.insets + inset
        pixel, _ = robust_pixels(rig, moved, points, seen)
        away = np.linalg.norm(points[:, None] - moved[:, :3, 3], axis=-1)
        return pixel, np.nan_to_num(away - distance - insets[k][:, None]), insets

    def flat(step: np.ndarray) -> np.ndarray:
        return np.concatenate([values.ravel() for values in residuals(step)])

    size = 18 + NUM_JOINTS + 3 * count
    pixel, far, _ = residuals(np.zeros(size))
    in_px = share * pixel_weights(np.linalg.norm(pixel, axis=-1), seen, JOINT_PX)
    in_m = share * geman_mcclure_weight(far**2, ROBUST_SIGMA * DISTANCE_M) / DISTANCE_M**2
    in_m[~np.isfinite(distance)] = 0.0
    weight = np.concatenate(
        [np.repeat(in_px.ravel(), 2), in_m.ravel(), np.full(NUM_JOINTS, INSET_M**-2)]
    )
    jacobian = derivatives(flat, size)
    weighted = jacobian.T * weight
    assert_equal_systems(system, reduced(weighted @ jacobian, weighted @ flat(np.zeros(size)), 18))


def test_normal_equations_of_boards_agree_with_a_dense_system() -> None:
    rig, _, views = views_of_walker(3, 2)
    centre = np.array([0, 0.2, 2.6])
    boards = board_poses_around(centre, 2)
    views = with_board(views, rig, BOARD, boards, noise_px=1.0)
    assert np.isfinite(views.pixels[:, :, CORNERS, 0]).any((0, 2)).all()
    term = BoardTerm(rig, views, BOARD, boards)
    assert len(term) == 2
    poses = perturbed(rig, np.random.default_rng(4), 0.01, 0.3).master_from_colour
    system = term(poses, np.zeros(3))
    at = term.boards.copy()
    seen = np.moveaxis(views.pixels[:, :, CORNERS], 1, 2).reshape(-1, 3, 2)

    def flat(step: np.ndarray) -> np.ndarray:
        moved = apply_step(poses, step[:18].reshape(3, 6))
        places = apply_step(at, step[18:].reshape(2, 6))
        points = np.concatenate([apply(place, BOARD.corners) for place in places])
        return robust_pixels(rig, moved, points, seen)[0].ravel()

    residual = flat(np.zeros(30)).reshape(-1, 3, 2)
    share = min(1.0, CORNERS_OF_IMAGE / len(BOARD.corners))
    in_px = share * pixel_weights(np.linalg.norm(residual, axis=-1), seen, CORNER_PX)
    jacobian = derivatives(flat, 30)
    weighted = jacobian.T * np.repeat(in_px.ravel(), 2)
    assert_equal_systems(system, reduced(weighted @ jacobian, weighted @ residual.ravel(), 18))


@pytest.mark.parametrize("depth", [False, True])
def test_the_gradient_is_zero_at_the_truth(depth: bool) -> None:
    rig, joints, views = views_of_walker(3, 10, depth=depth)
    matrix, gradient = JointTerm(rig, views, joints)(rig.master_from_colour, np.zeros(3))
    assert np.abs(gradient).max() < 1e-6 * np.abs(matrix).max()


@pytest.mark.parametrize("evidence", ["joints", "joints and depth", "boards"])
def test_poses_converge_from_a_perturbed_start(evidence: str) -> None:
    rig, joints, views = views_of_walker(4, 20, depth=evidence == "joints and depth")
    centre = joints.mean((0, 1))
    if evidence == "boards":
        boards = board_poses_around(centre, 20)
        views = with_board(views, rig, BOARD, boards)
        term = BoardTerm(rig, views, BOARD, boards)
    else:
        term = JointTerm(rig, views, joints)
    start = perturbed(rig, np.random.default_rng(5), 0.03, 1.0)
    poses, covariance, settled = adjust([term], start.master_from_colour, [1, 2, 3])
    if evidence == "joints":  # their scale is unknown
        baseline = np.linalg.norm(rig.master_from_colour[1, :3, 3])
        poses[:, :3, 3] *= baseline / np.linalg.norm(poses[1, :3, 3])
    assert settled
    assert extrinsics_error(rig.moved(poses), rig, centre).max() < 1e-3
    assert not covariance[0].any() and not covariance[:, :, 0].any()
    assert (np.linalg.eigvalsh(covariance[1:, :, 1:].reshape(18, 18)) > 0).all()


def test_errors_of_poses_are_as_large_as_their_covariance_says() -> None:
    """Over recordings with independent errors, the squared errors over their variance average 1."""
    ratios = []
    for seed in range(12):
        rig, joints, views = views_of_walker(3, 12, noise_px=JOINT_PX, depth=True, seed=seed)
        times = np.arange(12) * KEYPOINT_ERROR_TIME_S  # far enough apart to err independently
        views = replace(views, times=times, confidence=np.sign(views.confidence))
        term = JointTerm(rig, views, joints)
        poses, covariance, _ = adjust([term], rig.master_from_colour, [1, 2])
        off = (poses - rig.master_from_colour)[1:, :3, 3].ravel()
        ratios.append(np.mean(off**2 / np.diagonal(covariance[1:, 3:, 1:, 3:].reshape(6, 6))))
    assert 0.4 < np.mean(ratios) < 2.0


def test_jackknife_of_a_mean_is_the_variance_of_groups_over_their_number() -> None:
    """A pose that is the mean of 8 steps; 2.365 is Student's 97.5 % quantile of 7 degrees."""
    steps = 1e-3 * np.random.default_rng(0).normal(size=(8, 2, 6))
    poses = np.tile(np.eye(4), (2, 1, 1))
    without = (steps.sum(0) - steps) / 7
    found = jackknife_covariance(apply_step(poses, without), poses)
    expected = (2.365 / 1.960) ** 2 * np.cov(steps.reshape(8, 12), rowvar=False) / 8
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-12)
    assert not jackknife_covariance(apply_step(poses, without[:1]), poses).any()


def test_poses_of_a_stated_distance_err_as_their_scaled_steps_do() -> None:
    rig, _, _ = views_of_walker(4, 2)
    poses = rig.master_from_colour
    step = 1e-5 * np.random.default_rng(0).normal(size=(4, 6))
    step[0] = 0

    def length(at: np.ndarray) -> float:
        return float(np.linalg.norm(at[1, :3, 3] - at[3, :3, 3]))

    scaled = apply_step(poses, step)
    scaled[:, :3, 3] *= length(poses) / length(scaled)
    expected = step_between(poses, scaled).ravel()
    found = fix_scale(np.outer(step, step).reshape(4, 6, 4, 6), poses, length)
    np.testing.assert_allclose(found.reshape(24, 24), np.outer(expected, expected), atol=1e-13)


def test_the_estimated_error_is_the_mean_displacement_of_sampled_poses() -> None:
    rig, _, _ = views_of_walker(2, 2)
    poses, random = rig.master_from_colour, np.random.default_rng(0)
    root = 1e-3 * random.normal(size=(6, 6))
    covariance = np.zeros((2, 6, 2, 6))
    covariance[1, :, 1] = root @ root.T
    nothing = np.full(2, np.nan)
    residuals = Residuals(nothing, nothing, [], np.zeros((0, 25, 3)))
    found = FoundRig(rig, covariance, residuals, *[nothing] * 3, "")
    corners = np.array(list(product((-1.0, 1.0), repeat=3))) / np.sqrt(3)  # their covariance
    cube = ring_centre(rig) + corners
    steps = random.normal(size=(4000, 6)) @ root.T
    moved = apply_step(np.broadcast_to(poses[1], (4000, 4, 4)), steps) @ invert(poses[1])
    square = [((apply(pose, cube) - cube) ** 2).sum(1).mean() for pose in moved]
    assert found.sigma_m(1) == pytest.approx(np.sqrt(np.mean(square)), rel=0.05)


def test_the_estimated_error_of_a_pair_is_that_between_two_cameras() -> None:
    """Errors that both cameras share do not displace one relative to the other."""
    rig, _, _ = views_of_walker(3, 2)
    poses, random = rig.master_from_colour, np.random.default_rng(0)
    root = 1e-3 * random.normal(size=(12, 12))
    covariance = np.zeros((3, 6, 3, 6))
    covariance[1:, :, 1:] = (root @ root.T).reshape(2, 6, 2, 6)
    nothing = np.full(3, np.nan)
    residuals = Residuals(nothing, nothing, [], np.zeros((0, 25, 3)))
    found = FoundRig(rig, covariance, residuals, *[nothing] * 3, "")
    corners = np.array(list(product((-1.0, 1.0), repeat=3))) / np.sqrt(3)  # their covariance
    cube = ring_centre(rig) + corners
    steps = (random.normal(size=(4000, 12)) @ root.T).reshape(-1, 2, 6)
    moved = apply_step(np.broadcast_to(poses[1:], (4000, 2, 4, 4)), steps) @ invert(poses[1:])
    apart = [((apply(a, cube) - apply(b, cube)) ** 2).sum(1).mean() for a, b in moved]
    assert found.pair_sigma_m(1, 2) == pytest.approx(np.sqrt(np.mean(apart)), rel=0.05)
    assert found.pair_sigma_m(0, 1) == found.sigma_m(1)
