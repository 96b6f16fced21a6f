"""Refinement of poses: derivatives, recovery, and what it must not break."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.camera.triangulation import triangulate
from intercap_core.scene.constraints import BodyConstraint, BodyViews, body_views
from intercap_core.scene.registration import (
    MAX_DIRECTION_GAIN,
    MAX_DIRECTION_SHARE,
    STATIC,
    Registration,
    RigEstimate,
    balance_directions,
)
from intercap_core.scene.subject_views import SubjectViews
from intercap_core.scene.surfaces import surface_from_depth
from tests.helpers.synthetic_capture import (
    FURNITURE,
    extrinsics_error,
    perturbed,
    ring,
    room_depth,
    to_millimetres,
)
from tests.helpers.synthetic_people import seen_by, walking

TRUTH, UP = ring()
MIDDLE = apply(invert(UP), np.array([[0, 0, 0.8]]))[0]


def surfaces(seed: int, bias_m: float = 0.0, boxes=FURNITURE, walls=3.6):
    rng = np.random.default_rng(seed)
    bias = rng.normal(0, bias_m, len(TRUTH)) if bias_m else np.zeros(len(TRUTH))
    found = {}
    for c, camera in enumerate(TRUTH):
        depth = room_depth(camera, UP, boxes, walls)
        image = to_millimetres(np.where(depth > 0, depth + bias[c], 0), rng, noise=0.3)
        found[c] = surface_from_depth(image, camera.depth, cell_m=0.03, max_depth_m=5.0)
    return found, bias


def registration_of(rig, found) -> Registration:
    return Registration(rig, {STATIC: [found]}, 0)


def none() -> np.ndarray:
    return np.zeros(len(TRUTH))


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
    found, _ = surfaces(0)
    for c, surface in found.items():
        world = apply(UP @ TRUTH[c].master_from_depth, surface.points)
        on_floor = np.abs(world[:, 2]) < 0.015
        assert on_floor.mean() > 0.3
        normals = surface.normals @ (UP @ TRUTH[c].master_from_depth)[:3, :3].T
        assert np.median(normals[on_floor] @ [0, 0, 1]) > 0.99
        assert ((surface.normals * surface.points).sum(1) < 0).all()


@pytest.mark.parametrize("seed", range(3))
def test_a_furnished_room_brings_perturbed_cameras_back(seed):
    found, _ = surfaces(seed, bias_m=0.002)
    start = perturbed(TRUTH, np.random.default_rng(seed), 0.01, 0.3)
    registration = registration_of(start, found)
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


def test_depth_bias_of_one_camera_is_found():
    found, _ = surfaces(0)
    biased = found[2]
    shifted = replace(biased, points=biased.points + 0.006 * biased.rays)
    registration = registration_of(TRUTH, {**found, 2: shifted})
    refined = registration.solve(RigEstimate.start(TRUTH)).estimate
    others = np.delete(refined.bias, 2)
    assert refined.bias[2] - others.mean() > 0.003
    error = extrinsics_error(TRUTH.moved(refined.poses), TRUTH, MIDDLE)
    assert error.max() < 0.005


def test_body_constrains_rigs_above_a_bare_floor():
    found, _ = surfaces(1, boxes=np.zeros((0, 2, 3)), walls=None)
    start = perturbed(TRUTH, np.random.default_rng(3), 0.01, 0.3)
    registration = registration_of(start, found)
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
    body(poses, none())
    residual, by_point, _, by_pose = body._linearised(poses, none())
    step = 1e-6
    for axis in range(6):
        moved = poses.copy()
        if axis < 3:
            turn = Rotation.from_rotvec(step * np.eye(3)[axis]).as_matrix()
            moved[:, :3, :3] = turn @ moved[:, :3, :3]
        else:
            moved[:, axis - 3, 3] += step
        numeric = (body._linearised(moved, none())[0] - residual) / step
        np.testing.assert_allclose(by_pose[..., axis], numeric, rtol=1e-3, atol=0.05)
    body._points = body._points + np.array([step, 0, 0])
    numeric = (body._linearised(poses, none())[0] - residual) / step
    np.testing.assert_allclose(by_point[..., 0], numeric, rtol=1e-3, atol=0.05)


def test_moving_all_cameras_together_has_no_body_cost():
    views = views_of(2, 0.0)
    matrix, gradient = BodyConstraint(views, TRUTH)(TRUTH.master_from_colour, none())
    together = np.zeros((6, 6, 3))
    together[:, 3:] = np.eye(3)  # every camera translated alike
    motion = together.reshape(36, 3)
    matrix = matrix.reshape(36, 36)
    np.testing.assert_allclose(matrix @ motion, 0, atol=1e-3 * np.abs(matrix).max())
    assert np.abs(gradient).max() < 1e-3 * np.abs(matrix).max() * 1e-3


def test_triangulated_points_agree_with_the_constraints_own():
    views = views_of(3, 1.0)
    body = BodyConstraint(views, TRUTH)
    body(TRUTH.master_from_colour, none())
    found = triangulate(views.pixels, views.weights, TRUTH, max_error_px=20)
    np.testing.assert_allclose(body._points, found.points, atol=0.002)


def test_cameras_without_overlap_keep_their_poses():
    found, _ = surfaces(0)
    start = perturbed(TRUTH, np.random.default_rng(1), 0.01, 0.3)
    only = registration_of(start, {3: found[3]})
    refined = only.solve(RigEstimate.start(start)).estimate
    np.testing.assert_array_equal(refined.poses, start.master_from_colour)
    assert not only.residuals(refined, STATIC)


def test_bias_is_found_with_fixed_poses():
    found, bias = surfaces(0, bias_m=0.004)
    held = registration_of(TRUTH, found).solve(RigEstimate.start(TRUTH), free_poses=False)
    np.testing.assert_array_equal(held.estimate.poses, TRUTH.master_from_colour)
    assert held.last_step_m == 0
    left = held.estimate.bias - bias
    assert np.std(left) < 0.5 * np.std(bias)


def test_two_views_count_only_where_the_rig_has_no_more():
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


VERTICAL, ACROSS, AHEAD = np.eye(3)[[2, 0, 1]]


def _normals(counts: dict[tuple[float, ...], int]) -> np.ndarray:
    normals = np.repeat([np.array(n) for n in counts], list(counts.values()), axis=0)
    normals = normals + np.random.default_rng(1).normal(0, 0.03, normals.shape)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def test_a_floor_has_at_most_its_share_and_the_sum_stays() -> None:
    normals = _normals({tuple(VERTICAL): 900, tuple(ACROSS): 60, tuple(AHEAD): 40})
    weight = np.random.default_rng(2).uniform(0.5, 1, 1000)
    found = balance_directions(weight, normals)
    assert found.sum() == pytest.approx(weight.sum())
    assert found[:900].sum() / found.sum() == pytest.approx(MAX_DIRECTION_SHARE)
    # what lies one way keeps its own proportions
    assert np.ptp(found[:900] / weight[:900]) < 1e-12 and np.ptp(found[900:] / weight[900:]) < 1e-12


def test_specks_gain_no_more_than_the_limit() -> None:
    normals = _normals({tuple(VERTICAL): 995, tuple(ACROSS): 5})
    found = balance_directions(np.ones(1000), normals)
    np.testing.assert_allclose(found[995:], MAX_DIRECTION_GAIN)
    assert found.sum() == pytest.approx(1000)


def test_balanced_weights_are_unchanged() -> None:
    weight = np.random.default_rng(3).uniform(0, 1, 300)
    mixed = _normals({tuple(VERTICAL): 100, tuple(ACROSS): 100, tuple(AHEAD): 100})
    np.testing.assert_array_equal(balance_directions(weight, mixed), weight)
    np.testing.assert_array_equal(
        balance_directions(weight, _normals({tuple(VERTICAL): 300})), weight
    )
    np.testing.assert_array_equal(balance_directions(np.zeros(300), mixed), np.zeros(300))
