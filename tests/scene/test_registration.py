"""Registration of a rig: on surfaces, a body, a common floor, and moving surfaces."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.camera.triangulation import triangulate
from intercap_core.scene.background import camera_background
from intercap_core.scene.constraints import BodyConstraint, BodyViews, FloorConstraint, body_views
from intercap_core.scene.ground import fit_ground
from intercap_core.scene.registration import (
    MOVING,
    STATIC,
    Registration,
    RigEstimate,
)
from intercap_core.scene.subject_views import SubjectViews
from intercap_core.scene.surfaces import (
    MAX_DIRECTION_GAIN,
    MAX_DIRECTION_SHARE,
    DepthSurface,
    NearestPoints,
    balance_directions,
    moving_surfaces,
    surface_from_depth,
)
from intercap_core.scene.up import rough_up
from tests.helpers.synthetic_capture import (
    FURNITURE,
    extrinsics_error,
    perturbed,
    ring,
    room_depth,
    to_millimetres,
    write_frames,
)
from tests.helpers.synthetic_people import seen_by, walking

TRUTH, UP = ring()
MIDDLE = apply(invert(UP), np.array([[0, 0, 0.8]]))[0]


NONE = np.zeros(len(TRUTH))


@cache
def room(furnished: bool) -> list[np.ndarray]:
    boxes, walls = (FURNITURE, 3.6) if furnished else (np.zeros((0, 2, 3)), None)
    return [room_depth(camera, UP, boxes, walls) for camera in TRUTH]


@cache
def surfaces(seed: int, bias_m: float = 0.0, furnished: bool = True):
    """Surfaces by camera, and the biases (C,) of their depth."""
    rng = np.random.default_rng(seed)
    bias = rng.normal(0, bias_m, len(TRUTH)) if bias_m else NONE
    result = {}
    for c, depth in enumerate(room(furnished)):
        image = to_millimetres(np.where(depth > 0, depth + bias[c], 0), rng, noise=0.3)
        result[c] = surface_from_depth(image, TRUTH[c].depth, cell_m=0.03, max_depth_m=5.0)
    return result, bias


def registration_of(rig, seen) -> Registration:
    return Registration(rig, {STATIC: [seen]}, 0)


def views_of(seed: int, noise_px: float) -> BodyViews:
    rng = np.random.default_rng(seed)
    body = walking(10, np.array([-0.5, -0.4]), np.array([0.1, 0.08]), 0.1)[:, :25]
    whole = np.zeros((10, 135, 3))
    whole[:, :25] = body
    keypoints = seen_by(whole, TRUTH, UP)[:, :, :25]
    pixels = np.swapaxes(keypoints[..., :2], 1, 2).reshape(-1, 6, 2)
    pixels = pixels + rng.normal(0, noise_px, pixels.shape)
    points = apply(invert(UP), body.reshape(-1, 3))
    unit = np.arange(len(points))
    return BodyViews(pixels, np.ones(pixels.shape[:2]), points, np.zeros(points.shape), unit)


def test_surfaces_lie_on_the_room_and_face_the_camera():
    for c, surface in surfaces(0)[0].items():
        world = apply(UP @ TRUTH[c].master_from_depth, surface.points)
        on_floor = np.abs(world[:, 2]) < 0.015
        assert on_floor.mean() > 0.3
        normals = surface.normals @ (UP @ TRUTH[c].master_from_depth)[:3, :3].T
        assert np.median(normals[on_floor] @ [0, 0, 1]) > 0.99
        assert ((surface.normals * surface.points).sum(1) < 0).all()


def test_normals_are_cross_products_of_central_differences():
    lens = TRUTH[0].depth
    depth = to_millimetres(room(True)[0], np.random.default_rng(0), noise=0.3)
    step = max(1, round(0.008 * lens.fx))
    grid = (
        np.dstack([lens.rays, np.ones(depth.shape, np.float32)])
        * (depth * np.float32(1e-3))[..., None]
    )
    middle = grid[step:-step, step:-step]
    left, right = grid[step:-step, : -2 * step], grid[step:-step, 2 * step :]
    up, down = grid[: -2 * step, step:-step], grid[2 * step :, step:-step]
    flat = np.ones(middle.shape[:2], bool)
    for one, other in ((left, right), (up, down)):
        flat &= (
            np.abs((one + other)[..., 2] / 2 - middle[..., 2]) <= np.float32(0.008) * middle[..., 2]
        )
    for side in (middle, left, right, up, down):
        flat &= (side[..., 2] > 0) & (side[..., 2] <= 5.0)
    normals = np.cross(down - up, right - left)[flat]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = middle[flat]
    towards = -(normals * points).sum(1) / np.linalg.norm(points, axis=1) >= 0.26
    # cells are so small that no two points share one
    surface = surface_from_depth(depth, lens, cell_m=1e-4, max_depth_m=5.0)
    order, expected = np.lexsort(surface.points.T), np.lexsort(points[towards].T)
    np.testing.assert_allclose(surface.points[order], points[towards][expected], atol=1e-6)
    np.testing.assert_allclose(surface.normals[order], normals[towards][expected], atol=1e-5)


def test_nearest_points_are_those_of_all_pairs():
    rng = np.random.default_rng(0)
    points, sought = rng.uniform(-1, 1, (400, 3)), rng.uniform(-1.5, 1.5, (300, 3))
    layer, own = rng.integers(0, 3, len(points)), rng.integers(-1, 5, len(sought))
    away = np.linalg.norm(sought[:, None] - points, axis=-1)
    away[own[:, None] != layer] = np.inf
    expected = np.where(away.min(1) < 0.3, away.argmin(1), -1)
    assert 0 < (expected < 0).sum() < len(sought)
    np.testing.assert_array_equal(NearestPoints(points, layer, 0.3).query(sought, own), expected)
    alone = NearestPoints(points[:1], 0, 0.3)
    offset_points = points[:1] + np.array([[0.2, 0, 0], [0.4, 0, 0]])
    np.testing.assert_array_equal(alone.query(offset_points, 0), [0, -1])


@pytest.mark.parametrize("seed", range(3))
def test_furnished_room_corrects_perturbed_cameras(seed):
    seen, _ = surfaces(seed, bias_m=0.002)
    start = perturbed(TRUTH, np.random.default_rng(seed), 0.01, 0.3)
    registration = registration_of(start, seen)
    refined = registration.solve(RigEstimate.start(start)).estimate
    before = extrinsics_error(start, TRUTH, MIDDLE)
    after = extrinsics_error(start.moved(refined.poses), TRUTH, MIDDLE)
    assert after[1:].mean() < 0.006 < 0.01 < before[1:].mean()
    assert after.max() < 0.012
    np.testing.assert_array_equal(refined.poses[0], start.master_from_colour[0])
    medians = [
        np.mean(list(registration.median_residuals(at, STATIC).values()))
        for at in (RigEstimate.start(start), refined)
    ]
    assert medians[1] < 0.5 * medians[0]


def test_depth_bias_of_one_camera_is_estimated():
    seen, _ = surfaces(0)
    shifted = replace(seen[2], points=seen[2].points + 0.006 * seen[2].rays)
    registration = registration_of(TRUTH, {**seen, 2: shifted})
    refined = registration.solve(RigEstimate.start(TRUTH)).estimate
    others = np.delete(refined.bias, 2)
    assert refined.bias[2] - others.mean() > 0.003
    error = extrinsics_error(TRUTH.moved(refined.poses), TRUTH, MIDDLE)
    assert error.max() < 0.005


def test_body_constrains_rigs_above_a_bare_floor():
    start = perturbed(TRUTH, np.random.default_rng(3), 0.01, 0.3)
    registration = registration_of(start, surfaces(1, furnished=False)[0])
    alone = registration.solve(RigEstimate.start(start)).estimate
    body = BodyConstraint(views_of(0, 3.0), TRUTH)
    together = registration.solve(RigEstimate.start(start), [body]).estimate
    errors = [
        extrinsics_error(start.moved(e.poses), TRUTH, MIDDLE)[1:].mean() for e in (alone, together)
    ]
    assert errors[1] < 0.008 and errors[1] < 0.6 * errors[0]


def test_body_equations_are_the_derivatives_of_the_reprojection():
    views = views_of(1, 2.0)
    poses = perturbed(TRUTH, np.random.default_rng(0), 0.005, 0.2).master_from_colour
    body = BodyConstraint(views, TRUTH)
    body(poses, NONE)
    residual, by_point, _, by_pose = body._linearised(poses, NONE)
    step = 1e-6
    for axis in range(6):
        moved = poses.copy()
        if axis < 3:
            turn = Rotation.from_rotvec(step * np.eye(3)[axis]).as_matrix()
            moved[:, :3, :3] = turn @ moved[:, :3, :3]
        else:
            moved[:, axis - 3, 3] += step
        numeric = (body._linearised(moved, NONE)[0] - residual) / step
        np.testing.assert_allclose(by_pose[..., axis], numeric, rtol=1e-3, atol=0.05)
    body._points = body._points + np.array([step, 0, 0])
    numeric = (body._linearised(poses, NONE)[0] - residual) / step
    np.testing.assert_allclose(by_point[..., 0], numeric, rtol=1e-3, atol=0.05)


def test_moving_all_cameras_together_has_no_body_cost():
    views = views_of(2, 0.0)
    matrix, gradient = BodyConstraint(views, TRUTH)(TRUTH.master_from_colour, NONE)
    together = np.zeros((6, 6, 3))
    together[:, 3:] = np.eye(3)  # every camera translated alike
    motion = together.reshape(36, 3)
    matrix = matrix.reshape(36, 36)
    np.testing.assert_allclose(matrix @ motion, 0, atol=1e-3 * np.abs(matrix).max())
    assert np.abs(gradient).max() < 1e-3 * np.abs(matrix).max() * 1e-3


def test_points_of_the_body_term_are_triangulated():
    views = views_of(3, 1.0)
    body = BodyConstraint(views, TRUTH)
    body(TRUTH.master_from_colour, NONE)
    points = triangulate(views.pixels, views.weights, TRUTH, max_error_px=20).points
    np.testing.assert_allclose(body._points, points, atol=0.002)


def test_cameras_without_overlap_keep_their_poses():
    start = perturbed(TRUTH, np.random.default_rng(1), 0.01, 0.3)
    only = registration_of(start, {3: surfaces(0)[0][3]})
    refined = only.solve(RigEstimate.start(start)).estimate
    np.testing.assert_array_equal(refined.poses, start.master_from_colour)
    assert not only.residuals(refined, STATIC)


def test_bias_is_estimated_with_fixed_poses():
    seen, bias = surfaces(0, bias_m=0.004)
    solved = registration_of(TRUTH, seen).solve(RigEstimate.start(TRUTH), free_poses=False)
    np.testing.assert_array_equal(solved.estimate.poses, TRUTH.master_from_colour)
    assert solved.last_step_m == 0
    assert np.std(solved.estimate.bias - bias) < 0.5 * np.std(bias)


def test_two_views_count_only_in_rigs_of_two():
    def points(cameras: int) -> BodyViews:
        shape = (20, cameras, 135)
        seen_by_two = np.where(np.arange(cameras)[:, None] < 2, 1.0, 0.0) * np.ones(shape)
        subject = SubjectViews(
            np.repeat(seen_by_two[..., None], 3, axis=3),
            seen_by_two > 0,
            np.ones((20, 135, 3)),
            np.full((20, 135), 2),
        )
        return body_views(subject, np.arange(20) / 15)

    assert len(points(3).points) == 0
    pair = points(2)
    assert len(pair.points) == 20 * 25
    seen, unseen = pair.halves()
    assert len(seen.points) + len(unseen.points) == len(pair.points)
    assert not set(seen.unit) & set(unseen.unit)


def normals(*counts: int) -> np.ndarray:
    """Noisy unit normals: ``counts`` along z, x and y."""
    directions = np.repeat(np.eye(3)[[2, 0, 1]][: len(counts)], counts, axis=0)
    directions = directions + np.random.default_rng(1).normal(0, 0.03, directions.shape)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_floor_keeps_at_most_its_share_of_the_weight() -> None:
    weight = np.random.default_rng(2).uniform(0.5, 1, 1000)
    balanced = balance_directions(weight, normals(900, 60, 40))
    assert balanced.sum() == pytest.approx(weight.sum())
    assert balanced[:900].sum() / balanced.sum() == pytest.approx(MAX_DIRECTION_SHARE)
    gain = balanced / weight  # the same for all points of a direction
    assert np.ptp(gain[:900]) < 1e-12 and np.ptp(gain[900:]) < 1e-12
    few = balance_directions(np.ones(1000), normals(995, 5))
    np.testing.assert_allclose(few[995:], MAX_DIRECTION_GAIN)
    assert few.sum() == pytest.approx(1000)


@pytest.mark.parametrize(("counts", "scale"), [((100, 100, 100), 1), ((300,), 1), ((300,), 0)])
def test_balanced_weights_are_unchanged(counts, scale) -> None:
    weight = scale * np.random.default_rng(3).uniform(0, 1, 300)
    np.testing.assert_array_equal(balance_directions(weight, normals(*counts)), weight)


# --- a common floor ------------------------------------------------------------------------------

BY_CAMERAS = rough_up(TRUTH, np.full((6, 3), np.nan))


@pytest.fixture(scope="module")
def patches() -> dict[int, DepthSurface]:
    """Each camera's own sixth of a bare floor: no two cameras share any of it."""
    result = {}
    for c, surface in surfaces(0, furnished=False)[0].items():
        world = apply(UP @ TRUTH[c].master_from_depth, surface.points)
        sector = np.arctan2(world[:, 1], world[:, 0]) - 2 * np.pi * c / 6
        off = np.abs((sector + np.pi) % (2 * np.pi) - np.pi)
        own = (off < np.radians(22)) & (np.hypot(*world.T[:2]) > 0.4)
        result[c] = surface.subset(np.flatnonzero(own))
    return result


def floor_of(rig, patches) -> FloorConstraint | None:
    points = [apply(rig[c].master_from_depth, s.points) for c, s in patches.items()]
    normals = [s.normals @ rig[c].master_from_depth[:3, :3].T for c, s in patches.items()]
    cloud = np.concatenate(points), np.concatenate(normals)
    ground = fit_ground(*cloud, rig, BY_CAMERAS, tolerance_m=0.03, cell_m=0.03)
    return FloorConstraint.of(rig, patches, ground)


def test_common_floor_corrects_height_and_tilt_without_overlap(patches):
    start = perturbed(TRUTH, np.random.default_rng(2), 0.01, 0.3)
    registration = registration_of(start, patches)
    assert not registration.residuals(RigEstimate.start(start), STATIC)
    refined = registration.solve(RigEstimate.start(start), [floor_of(start, patches)]).estimate

    def errors(poses: np.ndarray) -> tuple[float, float]:
        heights, tilts = [], []
        for pose, true in zip(poses[1:], TRUTH.master_from_colour[1:], strict=True):
            moved = UP @ pose @ np.linalg.inv(true) @ np.linalg.inv(UP)
            middle = apply(UP @ true, np.array([[0.0, 0, 2.5]]))
            heights.append(abs((apply(moved, middle) - middle)[0, 2]))
            tilts.append(np.degrees(np.arccos(min(1.0, moved[2, 2]))))
        return float(np.mean(heights)), float(np.mean(tilts))

    before, after = errors(start.master_from_colour), errors(refined.poses)
    assert after[0] < 0.5 * before[0] and after[1] < 0.6 * before[1]


def test_floor_equations_are_those_of_the_best_plane(patches):
    start = perturbed(TRUTH, np.random.default_rng(3), 0.003, 0.05)
    floor, poses = floor_of(start, patches), start.master_from_colour
    matrix, gradient = floor(poses, NONE)
    flat = matrix.reshape(36, 36)
    np.testing.assert_allclose(flat, flat.T, atol=1e-6 * np.abs(flat).max())
    assert np.linalg.eigvalsh(flat).min() > -1e-6 * np.abs(flat).max()
    # turning or moving all cameras together has no cost
    together = np.zeros((6, 6, 6))
    for axis in range(3):
        together[:, axis, axis] = together[:, 3 + axis, 3 + axis] = 1
        together[:, 3:, axis] = np.cross(np.eye(3)[axis], poses[:, :3, 3])
    assert np.abs(flat @ together.reshape(36, 6)).max() < 2e-2 * np.abs(flat).max()
    # a step against the gradient brings the floors together
    step = -1e-3 * gradient / np.abs(gradient).max()
    moved = poses.copy()
    moved[:, :3, :3] = Rotation.from_rotvec(step[:, :3]).as_matrix() @ moved[:, :3, :3]
    moved[:, :3, 3] += step[:, 3:]
    assert np.linalg.norm(floor(moved, NONE)[1]) < np.linalg.norm(gradient)


def test_floor_seen_by_one_camera_is_no_constraint(patches):
    assert floor_of(TRUTH, {0: patches[0]}) is None


# --- moving surfaces -----------------------------------------------------------------------------

FPS, T = 15.0, 10
VELOCITY = np.array([0.7, -0.5, 0.2])
OFFSET = np.array([0.0, 0.006, -0.007, 0.004, 0.008, -0.003])


def box_at(seconds: float) -> np.ndarray:
    """A crate (1, 2, 3) on its way through the room; it turns back after a third of a second."""
    way = seconds if seconds < 1 / 3 else 2 / 3 - seconds
    middle, half = np.array([-0.1, 0.1, 0.9]) + VELOCITY * way, np.array([0.25, 0.3, 0.35])
    return np.stack([middle - half, middle + half])[None]


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    rng = np.random.default_rng(0)
    depths = []
    for c, camera in enumerate(TRUTH):
        boxes = [np.concatenate([FURNITURE, box_at(t / FPS + OFFSET[c])]) for t in range(T)]
        clean = [room_depth(camera, UP, own) for own in boxes]
        depths.append(np.stack([to_millimetres(depth, rng, noise=0.5) for depth in clean]))
    path = tmp_path_factory.mktemp("moving") / "frames.h5"
    write_frames(path, TRUTH, num_sets=T, depths=depths)
    image_of, nobody = np.tile(np.arange(T)[:, None], 6), np.full((T, 135, 3), np.nan)
    with Frames.open(path) as frames:
        backgrounds = [camera_background(frames, c, nobody) for c in range(6)]
        return moving_surfaces(frames, TRUTH, image_of, backgrounds)


def test_speed_is_that_of_the_crate_along_its_faces(moving):
    for c, surface in moving[1].items():  # before it turns back
        pose = UP @ TRUTH[c].master_from_depth
        expected = (surface.normals @ pose[:3, :3].T) @ VELOCITY
        assert np.median(np.abs(surface.speed - expected)) < 0.05
        world = apply(pose, surface.points)
        low, high = box_at(2 / FPS)[0]
        assert ((world > low - 0.05) & (world < high + 0.05)).all(1).mean() > 0.9


def test_moving_surfaces_determine_time_offsets(moving):
    registration = Registration(TRUTH, {MOVING: moving}, 0)
    solved = registration.solve(RigEstimate.start(TRUTH), free_poses=False)
    error = np.abs(solved.estimate.offset - OFFSET)
    assert error.max() < 0.002 and error.mean() < 0.001
    sigma = np.sqrt(np.diagonal(solved.covariance[:, 7, :, 7]))
    assert (error[1:] < 4 * sigma[1:]).all()
