"""Corrections of cameras: what body and object say of them, and what they settle on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from intercap_core.body_fit.observations import person_clouds, read_observations
from intercap_core.body_fit.schedule import Fitter, Settled
from intercap_core.body_fit.surface import COVERINGS
from intercap_core.config import BodyFitSettings
from intercap_core.joint.cameras import (
    BIAS,
    FREEDOMS,
    SHIFT,
    TURN,
    CameraEvidence,
    CameraFit,
    Cameras,
    CameraStep,
)
from intercap_core.joint.state import BODY, OBJECT
from intercap_core.joint.terms.body_data import add_by_cameras
from tests.helpers.bodies import open_body
from tests.helpers.body_capture import ring, write_capture
from tests.joint.test_sightings import moving_vectors

FRAMES, CAMERAS, WRONG = 8, 4, 2
# Turn, rad, shift and depth bias, metres, that the wrong camera needs.
NEEDED = np.array([0.002, -0.003, 0.002, 0.004, 0.003, -0.005, 0.0])
LOOSE = np.repeat([0.02, 0.02, 0.02], (3, 3, 1)) ** 2


@pytest.fixture(scope="module")
def fitter(tmp_path_factory) -> Fitter:
    """At the true bodies; one camera's pose is given wrongly."""
    model = open_body()
    times = np.arange(FRAMES) / 15
    body = model.forward(model.parameters(moving_vectors(model, times)))
    inputs = write_capture(
        tmp_path_factory.mktemp("cameras"),
        ring(CAMERAS),
        np.repeat(body.vertices.double().numpy()[:, None], CAMERAS, 1),
        model.faces.numpy(),
        np.repeat(model.keypoints(body).double().numpy()[:, None], CAMERAS, 1),
    )
    observed = read_observations(inputs.scene, inputs.person)
    step = np.zeros((CAMERAS, FREEDOMS))
    step[WRONG] = -NEEDED
    wrong = Cameras(observed.rig, observed.depth_bias).moved(step)
    clouds = person_clouds(inputs.frames, observed, 3000, model.device)
    fitter = Fitter(model, observed, clouds, BodyFitSettings(points_per_frame=3000))
    fitter.evidence.take_cameras(wrong.rig, wrong.depth_bias)
    return fitter


def _problem(fitter: Fitter):
    settled = Settled(
        torch.zeros(25, 3),
        torch.full((len(COVERINGS),), -3.0),
        fitter.evidence.keypoint_sigma,
        torch.tensor([covering.noise for covering in COVERINGS]),
        fitter.evidence.keypoint_doubt,
    )
    vectors = moving_vectors(fitter.model, np.arange(FRAMES) / 15)
    problem = fitter.resume(vectors, settled)
    fitter.observe(problem)
    return problem


def _seen_from(fitter: Fitter, problem, held: float) -> CameraEvidence:
    size = FREEDOMS * CAMERAS
    seen = CameraEvidence(
        BODY,
        np.tile(held * np.eye(BODY.stop), (FRAMES, 1, 1)),
        np.zeros((FRAMES, BODY.stop)),
        np.zeros((FRAMES, BODY.stop, size)),
        np.zeros((size, size)),
        np.zeros(size),
        1.0,
    )
    add_by_cameras(fitter.evidence, problem, np.ones(FRAMES, bool), seen)
    return seen


@pytest.mark.parametrize("only", ["keypoints", "clouds"])
def test_beside_known_bodies_a_wrong_camera_is_put_right(fitter: Fitter, only: str) -> None:
    evidence = fitter.evidence
    start = Cameras(evidence.observations.rig, evidence.observations.depth_bias)
    covariance = np.zeros((CAMERAS, FREEDOMS, CAMERAS, FREEDOMS))
    covariance[WRONG, :, WRONG] = np.diag(LOOSE)
    cameras = CameraFit(start, covariance)
    for _ in range(4):
        problem = _problem(fitter)
        if only == "keypoints":
            problem.rows = None
        else:
            problem.views = None
        cameras.take(cameras.solve([_seen_from(fitter, problem, held=1e9)]))
        evidence.take_cameras(cameras.now.rig, cameras.now.depth_bias)
    found, true = cameras.now.rig[WRONG], ring(CAMERAS)[WRONG]
    apart = found.master_from_colour @ np.linalg.inv(true.master_from_colour)
    at_body = evidence.observations.joints[0, 0]
    before = start.rig[WRONG].master_from_colour @ np.linalg.inv(true.master_from_colour)
    off, was = (np.linalg.norm(m[:3, :3] @ at_body + m[:3, 3] - at_body) for m in (apart, before))
    assert off < 0.5 * was
    others = [c for c in range(CAMERAS) if c != WRONG]
    for c in others:  # held ones stay to the last digit
        assert np.array_equal(
            cameras.now.rig[c].master_from_colour, start.rig[c].master_from_colour
        )
    sigma = np.sqrt(np.diagonal(cameras.covariance[WRONG, :, WRONG]))
    assert (sigma[:6] < np.sqrt(LOOSE[:6])).all()
    evidence.take_cameras(start.rig, start.depth_bias)


def test_what_a_view_saw_moves_with_its_camera(fitter: Fitter) -> None:
    """Points of a cloud follow their camera's motion; a bias moves them along their rays."""
    evidence = fitter.evidence
    cloud, seen = evidence.clouds[0], evidence.observations
    step = np.zeros((CAMERAS, FREEDOMS))
    step[1, SHIFT] = [0.01, 0.02, 0.03]
    moved = Cameras(seen.rig, seen.depth_bias).moved(step)
    other = cloud.through(moved.rig, moved.depth_bias, seen.rig, seen.depth_bias)
    change = (other.points - cloud.points).double().numpy()
    of_view = cloud.view.numpy() == 1
    np.testing.assert_allclose(
        change[of_view], np.tile(step[1, SHIFT], (of_view.sum(), 1)), atol=2e-6
    )
    assert np.abs(change[~of_view]).max() < 2e-6
    step[:] = 0
    step[1, BIAS] = 0.01
    nearer = Cameras(seen.rig, seen.depth_bias).moved(step)
    other = cloud.through(nearer.rig, nearer.depth_bias, seen.rig, seen.depth_bias)
    eye = seen.rig[1].master_from_depth[:3, 3]
    away = np.linalg.norm(cloud.points[of_view].double().numpy() - eye, axis=1)
    now = np.linalg.norm(other.points[of_view].double().numpy() - eye, axis=1)
    assert (now < away).all() and np.median(away - now) == pytest.approx(0.0105, abs=0.001)


def test_poses_go_along_and_the_prior_holds() -> None:
    """One camera sees an object's place: what it says is shared by prior and evidence, and the pose
    that no one else sees follows the camera."""
    rig = ring(1)
    prior, precision, frames, off = 0.004, 250.0, 5, 0.01
    covariance = np.zeros((1, FREEDOMS, 1, FREEDOMS))
    covariance[0, SHIFT, 0, SHIFT] = np.eye(3) * prior**2
    cameras = CameraFit(Cameras(rig, np.zeros(1)), covariance)
    jacobian = np.zeros((6, FREEDOMS))
    jacobian[3:, SHIFT] = -np.eye(3)  # the residual is x - d
    weight = precision**2

    def sights(known: float) -> CameraEvidence:
        """The pose is also known from elsewhere to be ``off`` from what the camera says."""
        own = np.concatenate([np.zeros(3), np.full(3, off)])
        return CameraEvidence(
            OBJECT,
            np.tile((weight + known) * np.eye(6), (frames, 1, 1)),
            np.tile(weight * own, (frames, 1)),
            np.tile(weight * jacobian, (frames, 1, 1)),
            frames * weight * jacobian.T @ jacobian,
            frames * weight * jacobian.T @ own,
            1.0,
        )

    nothing = cameras.solve([sights(known=0.0)])  # any camera explains a pose that is free
    np.testing.assert_allclose(nothing.step, 0, atol=1e-9)
    found = cameras.solve([sights(known=1e6 * weight)])
    expected = off * frames * weight / (frames * weight + prior**-2)
    np.testing.assert_allclose(found.step[0, SHIFT], expected, rtol=1e-3)
    np.testing.assert_allclose(found.step[0, TURN], 0)
    free = cameras.solve([replace(sights(known=0.0), pull=frames * np.ones(FREEDOMS))])
    np.testing.assert_allclose(free.along[:, OBJECT][:, 3:], np.tile(free.step[0, SHIFT], (5, 1)))


def _free(part: slice, sigma: float) -> np.ndarray:
    covariance = np.zeros((1, FREEDOMS, 1, FREEDOMS))
    covariance[0, part, 0, part] = np.eye(3) * sigma**2
    return covariance


def _step(covariance: np.ndarray, **parts: float) -> CameraStep:
    step = np.zeros((1, FREEDOMS))
    for name, value in parts.items():
        step[0, {"turn": TURN, "shift": SHIFT}[name]] = value
    return CameraStep(step, np.zeros((1, 1)), covariance)


def test_what_goes_far_beyond_the_scene_s_covariance_is_not_taken() -> None:
    covariance = _free(SHIFT, 0.003)
    cameras = CameraFit(Cameras(ring(1), np.zeros(1)), covariance)
    before = cameras.now.rig.master_from_colour.copy()
    assert not cameras.take(_step(covariance, shift=0.1))
    assert cameras.take(_step(covariance / 4, shift=0.005))
    moved = cameras.now.rig.master_from_colour[:, :3, 3] - before[:, :3, 3]
    np.testing.assert_allclose(moved, 0.005)
    np.testing.assert_array_equal(cameras.covariance, covariance / 4)
    # with what was taken before it is too far: all go back
    assert not cameras.take(_step(covariance / 9, shift=0.011))
    np.testing.assert_array_equal(cameras.now.rig.master_from_colour, before)
    np.testing.assert_array_equal(cameras.covariance, covariance)
    assert cameras.refused


def test_small_parts_may_be_too_much_together_or_far_away() -> None:
    tied = _free(TURN, 0.01) + _free(SHIFT, 0.01)
    for axis in range(3):  # a turn and a shift that hide each other
        tied[0, axis, 0, 3 + axis] = tied[0, 3 + axis, 0, axis] = -0.9999 * 0.01**2
    cameras = CameraFit(Cameras(ring(1), np.zeros(1)), tied)
    assert not cameras.take(_step(tied, turn=0.004, shift=0.004))
    loose = _free(TURN, 0.02)
    cameras = CameraFit(Cameras(ring(1), np.zeros(1)), loose)
    assert not cameras.take(_step(loose, turn=0.03))
    indefinite = np.zeros_like(loose)
    indefinite[0, :, 0] = np.eye(FREEDOMS)
    indefinite[0, 0, 0, 1] = indefinite[0, 1, 0, 0] = 2.0
    with pytest.raises(np.linalg.LinAlgError):
        CameraFit(Cameras(ring(1), np.zeros(1)), indefinite)


def test_a_camera_without_a_pose_says_nothing(fitter: Fitter) -> None:
    evidence = fitter.evidence
    given = evidence.observations
    poses = given.rig.master_from_colour.copy()
    poses[3] = np.nan
    confidence = given.confidence.copy()
    confidence[:, 3] = 0
    problem = _problem(fitter)
    problem.views = replace(
        problem.views,
        colour_from_master=torch.as_tensor(given.rig.moved(poses).colour_from_master).float(),
        confidence=torch.as_tensor(confidence[:, :, problem.keypoints.index.numpy()]).float(),
    )
    evidence.by_view.points[:, 3] = 0
    evidence.observations = replace(given, rig=given.rig.moved(poses), confidence=confidence)
    seen = _seen_from(fitter, problem, held=1.0)
    evidence.observations = given
    mine = slice(3 * FREEDOMS, 4 * FREEDOMS)
    assert np.isfinite(seen.hessian).all() and np.isfinite(seen.cross).all()
    assert not seen.hessian[mine].any() and not seen.pull[mine].any()
