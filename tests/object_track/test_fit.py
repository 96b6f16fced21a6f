"""Fits and likelihoods of single frames of a capture whose truth is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from intercap_core.entries import ObjectEntry
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import Renderer
from intercap_core.object_track.fit import MotionPrior, assess_all, fit_pose
from intercap_core.object_track.likelihood import LABEL_LOG_RATIO, LOG_MISSED, outline_cost
from intercap_core.object_track.reduced_mask import ReducedMask
from intercap_core.object_track.view import DepthImage, FitContext
from tests.geometry.rigid.conftest import catalogue
from tests.helpers.object_capture import ObjectCapture
from tests.object_track.scenes import disturb, mesh_of, views_of


def error(mesh, pose, truth) -> tuple[float, float]:
    """Millimetres and degrees."""
    shift = np.linalg.norm(pose[:3, 3] - truth[:3, 3]) * 1000
    return float(shift), float(mesh.symmetry.rotation_error_deg(pose[:3, :3], truth[:3, :3]))


@pytest.mark.parametrize(("seed", "background"), [(0, True), (1, True), (2, False)])
def test_a_fit_recovers_from_6_cm_and_20_degrees(context, capture, views, seed, background):
    start = disturb(capture.poses[0], seed, 0.06, 20)
    fit = fit_pose(replace(context, background_term=background), views, start)
    visible = [report.visible_px for report in fit.views]
    assert min(visible) < 0.8 * max(visible), "the post hides the object from some camera"
    millimetres, degrees = error(context.mesh, fit.pose, capture.poses[0])
    assert millimetres < 1.5 and degrees < 0.4
    assert fit.mean_overlap > 0.9 and fit.support == len(views)
    (truth,) = assess_all(context, views, capture.poses[:1])
    assert fit.log_ratio > truth.log_ratio - 2
    # the fit reports the likelihood of its pose, up to the last step after its last renderings
    (again,) = assess_all(context, views, fit.pose[None])
    assert again.log_ratio == pytest.approx(fit.log_ratio, abs=1.0)


def test_a_fit_does_not_depend_on_threads(context, capture, views):
    start = disturb(capture.poses[0], 5, 0.03, 10)
    one, three = (
        fit_pose(replace(context, renderer=Renderer(threads)), views, start) for threads in (1, 3)
    )
    assert three.pose.tobytes() == one.pose.tobytes() and three.views == one.views
    assert three.covariance.tobytes() == one.covariance.tobytes()


def test_poses_are_assessed_alike_together_and_alone(context, capture, views):
    poses = np.array([disturb(capture.poses[0], seed, 0.05, 15) for seed in range(3)])
    for pose, fit in zip(poses, assess_all(context, views, poses), strict=True):
        (alone,) = assess_all(context, views, pose[None])
        assert fit.log_ratio == alone.log_ratio and len(fit.views) == len(views)


def test_true_candidates_are_chosen_and_covariance_grows_with_fewer_views(context, capture, views):
    fit = fit_pose(context, views, capture.poses[0])
    for c, report in enumerate(fit.views):  # whatever the label
        _, _, candidates = capture.image(0, c)
        assert candidates[report.candidate][1] in ("suitcase", "bed") and report.overlap > 0.8
    several = fit.covariance
    single = fit_pose(context, views[:1], capture.poses[0]).covariance
    assert np.allclose(several, several.T) and np.linalg.eigvalsh(several).min() > 0
    assert np.trace(single) > 2 * np.trace(several)


def test_the_prior_keeps_the_unobserved_spin_of_a_bottle():
    bottle = mesh_of("bottle")
    capture = ObjectCapture.make(bottle, 1, label="bottle")
    spin = capture.poses[0].copy()
    spin[:3, :3] = spin[:3, :3] @ Rotation.from_euler("z", 70, degrees=True).as_matrix()
    start = disturb(spin, 1, 0.02, 5)
    fit = fit_pose(FitContext(bottle), views_of(capture, 0), start, prior=MotionPrior(spin))
    plain = Rotation.from_matrix(spin[:3, :3].T @ fit.pose[:3, :3]).as_rotvec(degrees=True)
    assert abs(plain[2]) < 6 and np.abs(plain[:2]).max() < 4
    axis = fit.pose[:3, 2]
    assert np.degrees(np.sqrt(axis @ fit.covariance[:3, :3] @ axis)) > 10
    assert error(bottle, fit.pose, capture.poses[0])[0] < 4


def test_a_mesh_with_a_hole_is_fitted(context, capture, views, tmp_path):
    closed = ObjectMesh.load(catalogue()["suitcase"])
    below = closed.vertices[closed.faces].mean(1)[:, 2] < closed.vertices[:, 2].min() + 0.03
    path = tmp_path / "open.ply"
    trimesh.Trimesh(closed.vertices, closed.faces[~below], process=False).export(path)
    opened = ObjectMesh.load(ObjectEntry(name="suitcase", mesh=path)).simplified(600)
    assert closed.watertight and not opened.watertight
    start = capture.poses[0].copy()
    start[:3, 3] += [0.02, -0.02, 0.02]
    fit = fit_pose(replace(context, mesh=opened), views, start)
    millimetres, degrees = error(closed, fit.pose, capture.poses[0])
    assert millimetres < 10 and degrees < 2


def ratios(context, views, poses) -> np.ndarray:
    return np.array([fit.log_ratio for fit in assess_all(context, views, poses)])


@pytest.fixture(scope="module")
def unlabelled(context) -> FitContext:
    return replace(context, labels=())


def moved(pose: np.ndarray, metres: float = 0.0, degrees: float = 0.0) -> np.ndarray:
    result = pose.copy()
    result[:3, :3] = pose[:3, :3] @ Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    result[0, 3] += metres
    return result


def test_likelihood_falls_with_the_error(unlabelled, capture, views):
    true = capture.poses[0]
    by_shift = ratios(
        unlabelled, views, np.array([moved(true, m) for m in (0, 0.01, 0.03, 0.1, 0.6)])
    )
    by_turn = ratios(unlabelled, views, np.array([moved(true, 0, d) for d in (0, 5, 15, 40)]))
    assert (np.diff(by_shift[:4]) < 0).all() and (np.diff(by_turn) < 0).all()
    assert by_shift[0] > 30 and by_shift[3:].max() < 0


def test_likelihood_is_the_sum_over_views(unlabelled, capture, views):
    pose = capture.poses[:1]
    alone = [ratios(unlabelled, [view], pose)[0] for view in views]
    assert ratios(unlabelled, views, pose)[0] == pytest.approx(sum(alone))


def test_unobserved_poses_have_no_likelihood(unlabelled, capture, views):
    """Behind every camera, or with neither detector nor depth."""
    behind = moved(capture.poses[0], 40.0)
    blind = [replace(view, depth=None, candidates=(), detected=False) for view in views]
    assert ratios(unlabelled, views, behind[None]) == pytest.approx(0, abs=1e-9)
    assert ratios(unlabelled, blind, capture.poses[:1]) == pytest.approx(0, abs=1e-9)


def farther(depth: DepthImage) -> DepthImage:
    """The image with depths that are 0.5 m larger."""
    return replace(depth, bias_m=depth.bias_m - 0.5)


def test_depth_of_the_empty_room_is_no_evidence_outside_masks(unlabelled, capture, views):
    pose = capture.poses[:1]
    unseen = [replace(view, candidates=()) for view in views]
    fits = ratios(unlabelled, unseen, pose)[0]
    room = [replace(view, background=view.depth) for view in unseen]
    assert fits > 10 and ratios(unlabelled, room, pose)[0] <= 0
    in_mask = [replace(view, background=view.depth) for view in views]
    assert ratios(unlabelled, in_mask, pose)[0] > 0.9 * ratios(unlabelled, views, pose)[0]
    before_wall = [replace(view, background=farther(view.depth)) for view in unseen]
    assert ratios(unlabelled, before_wall, pose)[0] == pytest.approx(fits)


@pytest.mark.parametrize(("ahead_m", "is_room"), [(1.5, True), (0.3, True), (1.5, False)])
def test_only_furniture_more_than_a_diameter_ahead_may_hide_the_object(
    unlabelled, capture, views, ahead_m, is_room
):
    pose, diameter = capture.poses[0], capture.mesh.diameter
    assert 0.3 < diameter < 1.0
    hidden = []
    for view in views:
        centre = view.geometry.camera.depth_from_master @ [*capture.mesh.centre_at(pose), 1]
        ahead_mm = np.uint16(round(1e3 * (centre[2] - ahead_m)))
        depth = DepthImage(np.full(view.depth.shape, ahead_mm), 0.0)
        background = depth if is_room else view.background
        hidden.append(replace(view, depth=depth, background=background, candidates=()))
    ratio = ratios(unlabelled, hidden, pose[None])[0]
    assert ratio == pytest.approx(0, abs=0.1) if is_room and ahead_m > diameter else ratio < -10


def test_a_missed_object_costs_the_detectors_miss_rate(unlabelled, capture, views):
    unnamed = [replace(view, depth=None, candidates=()) for view in views]
    (fit,) = assess_all(unlabelled, unnamed, capture.poses[:1])
    assert all(LOG_MISSED < view.log_ratio < 0 for view in fit.views)
    everywhere = [ReducedMask(0, 0, np.ones(view.geometry.lens.rays.shape[:2], bool))
                  for view in unnamed]  # fmt: skip
    hidden = [replace(view, person=mask) for view, mask in zip(unnamed, everywhere, strict=True)]
    assert ratios(unlabelled, hidden, capture.poses[:1])[0] == pytest.approx(0)


def test_labels_change_the_likelihood_within_bounds(unlabelled, capture, views):
    suitcases = [tuple(replace(k, label="suitcase") for k in view.candidates) for view in views]
    named = [
        replace(view, depth=None, candidates=own)
        for view, own in zip(views, suitcases, strict=True)
    ]
    right, wrong = (
        ratios(replace(unlabelled, labels=(label,)), named, capture.poses[:1])[0]
        for label in ("suitcase", "cup")
    )
    assert 0 < wrong < right <= wrong + 2 * LABEL_LOG_RATIO * len(views) + 1e-9


def test_outline_costs_by_hand():
    nobody = np.zeros((0, 0), bool)

    def cost(mask, at, person=nobody):
        drawn = np.zeros((20, 20), np.int32)
        corner = (50, 50)
        return outline_cost(drawn, corner, (mask, *at), (person, *corner), 200, 200, 1.0, 4.5)

    square = np.ones((20, 20), bool)
    assert cost(square, (50, 50)) == (0.0, 152)
    # shifted by two: the sides along the shift keep their distance 0, the others are 2 away
    shifted, count = cost(square, (52, 50))
    assert count == 152 and 0.4 < shifted < 1.3
    assert cost(np.ones((2, 2), bool), (90, 90))[0] == 4.5  # nowhere near
    # a person next to the mask ends its outline there
    half, covered = square.copy(), np.zeros((20, 20), bool)
    half[:, 10:], covered[:, 10:] = False, True
    agreed, fewer = cost(half, (50, 50), covered)
    assert agreed == 0.0 and 0 < fewer < 100
