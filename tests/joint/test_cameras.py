"""Corrections of cameras from rendered captures, at the true bodies."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.model import BodyModel
from intercap_core.body_fit.clouds import person_clouds
from intercap_core.body_fit.observations import read_observations
from intercap_core.body_fit.problem import BodyProblem
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
from tests.helpers.body_capture import master_from_room, ring, write_capture

FPS, CAMERAS, WRONG = 15.0, 4, 2
# Turn, rad, shift and depth bias, metres, that the wrong camera needs.
NEEDED = np.array([0.002, -0.003, 0.002, 0.004, 0.003, -0.005, 0.0])
LOOSE = np.repeat([0.02, 0.02, 0.02], (3, 3, 1)) ** 2


def moving_vectors(model: BodyModel, times: np.ndarray) -> torch.Tensor:
    """Parameter vectors (T, P) of a person who sways through the ring and swings both arms."""
    x = model.zeros(len(times)).vector().double().numpy()
    x[:, 75:120], x[:, 120:165] = model.hand_mean.numpy()
    x[:, 0] = np.pi  # y down, facing the master
    room = master_from_room()
    x[:, 165:168] = room[:3, :3] @ [0, 0, 0.95] + room[:3, 3]
    x[:, 165] += 0.4 * np.sin(4 * times)
    x[:, 167] += 0.2 * np.sin(5 * times + 1)
    for side, joint in ((-1, "left_shoulder"), (1, "right_shoulder")):
        x[:, 3 * JOINT_INDEX[joint] + 2] += side * (0.9 + 0.3 * np.sin(6 * times + side))
    return torch.as_tensor(x, dtype=torch.float32)


def _make_fitter(folder: Path, frames: int) -> Fitter:
    """Render a capture."""
    model = open_body()
    body = model.forward(model.parameters(moving_vectors(model, np.arange(frames) / FPS)))
    inputs = write_capture(
        folder,
        ring(CAMERAS),
        body.vertices.double().numpy(),
        model.faces.numpy(),
        model.keypoints(body).double().numpy(),
    )
    observed = read_observations(inputs.scene, inputs.person)
    clouds = list(person_clouds(inputs.frames, inputs.person, observed, 3000))
    return Fitter(model, observed, clouds, BodyFitSettings(points_per_frame=3000))


def _problem(fitter: Fitter) -> BodyProblem:
    """Problem at the true bodies, with correspondences."""
    settled = Settled(
        torch.zeros(25, 3),
        torch.full((len(COVERINGS),), -3.0),
        fitter.evidence.keypoint_sigma,
        torch.tensor([covering.noise for covering in COVERINGS]),
        fitter.evidence.keypoint_doubt,
    )
    times = np.arange(len(fitter.evidence.observations.times)) / FPS
    problem = fitter.resume(moving_vectors(fitter.model, times), settled)
    fitter.observe(problem)
    return problem


@pytest.fixture(scope="module")
def fitter(tmp_path_factory) -> Fitter:
    """One camera's pose is wrong."""
    fitter = _make_fitter(tmp_path_factory.mktemp("cameras"), 8)
    step = np.zeros((CAMERAS, FREEDOMS))
    step[WRONG] = -NEEDED
    seen = fitter.evidence.observations
    wrong = Cameras(seen.rig, seen.depth_bias).moved(step)
    fitter.evidence.take_cameras(wrong.rig, wrong.depth_bias)
    return fitter


def _camera_evidence(fitter: Fitter, problem: BodyProblem, stiffness: float) -> CameraEvidence:
    """Evidence of the body, whose parameters are held with ``stiffness``."""
    frames, size = len(fitter.evidence.observations.times), FREEDOMS * CAMERAS
    evidence = CameraEvidence(
        BODY,
        np.arange(frames),
        np.tile(stiffness * np.eye(BODY.stop), (frames, 1, 1)),
        np.zeros((frames, BODY.stop)),
        np.zeros((frames, BODY.stop, size)),
        np.zeros((size, size)),
        np.zeros(size),
        1.0,
    )
    add_by_cameras(fitter.evidence, problem, np.arange(frames), evidence)
    return evidence


@pytest.mark.parametrize("source", ["keypoints", "clouds"])
def test_wrong_camera_is_corrected_at_known_bodies(fitter, source: str):
    evidence = fitter.evidence
    start = Cameras(evidence.observations.rig, evidence.observations.depth_bias)
    covariance = np.zeros((CAMERAS, FREEDOMS, CAMERAS, FREEDOMS))
    covariance[WRONG, :, WRONG] = np.diag(LOOSE)
    cameras = CameraFit(start, covariance)
    for _ in range(4):
        problem = _problem(fitter)
        if source == "keypoints":
            problem.rows = None
        else:
            problem.views = None
        cameras.take(
            cameras.solve(
                [_camera_evidence(fitter, problem, stiffness=1e9)], len(evidence.observations.times)
            )
        )
        evidence.take_cameras(cameras.now.rig, cameras.now.depth_bias)
    at_body = evidence.observations.joints[0, 0]
    true = np.linalg.inv(ring(CAMERAS)[WRONG].master_from_colour)
    after, before = (
        np.linalg.norm(step[:3, :3] @ at_body + step[:3, 3] - at_body)
        for step in (rig[WRONG].master_from_colour @ true for rig in (cameras.now.rig, start.rig))
    )
    assert after < 0.5 * before
    fixed = [c for c in range(CAMERAS) if c != WRONG]
    poses, given = cameras.now.rig.master_from_colour, start.rig.master_from_colour
    assert np.array_equal(poses[fixed], given[fixed])
    sigma = np.sqrt(np.diagonal(cameras.covariance[WRONG, :, WRONG]))
    assert (sigma[:6] < np.sqrt(LOOSE[:6])).all()
    evidence.take_cameras(start.rig, start.depth_bias)


def test_cloud_moves_with_its_camera(fitter):
    """A bias moves the points along their rays."""
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
    before, after = (
        np.linalg.norm(points[of_view].double().numpy() - eye, axis=1)
        for points in (cloud.points, other.points)
    )
    assert (after < before).all()
    assert np.median(before - after) == pytest.approx(0.0105, abs=0.001)


def test_camera_without_a_pose_has_no_evidence(fitter):
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
    form = _camera_evidence(fitter, problem, stiffness=1.0)
    evidence.observations = given
    mine = slice(3 * FREEDOMS, 4 * FREEDOMS)
    assert np.isfinite(form.hessian).all() and np.isfinite(form.cross).all()
    assert not form.hessian[mine].any() and not form.pull[mine].any()


def test_prior_and_evidence_share_a_correction():
    """A camera sees an object's place; a pose that no other camera sees follows this camera."""
    prior, precision, frames, off = 0.004, 250.0, 5, 0.01
    cameras = CameraFit(Cameras(ring(1), np.zeros(1)), _covariance(SHIFT, prior))
    jacobian = np.zeros((6, FREEDOMS))
    jacobian[3:, SHIFT] = -np.eye(3)  # the residual is x - d
    weight = precision**2

    def evidence(known: float) -> CameraEvidence:
        """Other evidence, of precision ``known``, is ``off`` from that of the camera."""
        own = np.concatenate([np.zeros(3), np.full(3, off)])
        return CameraEvidence(
            OBJECT,
            np.arange(frames),
            np.tile((weight + known) * np.eye(6), (frames, 1, 1)),
            np.tile(weight * own, (frames, 1)),
            np.tile(weight * jacobian, (frames, 1, 1)),
            frames * weight * jacobian.T @ jacobian,
            frames * weight * jacobian.T @ own,
            1.0,
        )

    free = cameras.solve([evidence(known=0.0)], frames)  # any camera explains a pose that is free
    np.testing.assert_allclose(free.step, 0, atol=1e-9)
    shared = cameras.solve([evidence(known=1e6 * weight)], frames)
    expected = off * frames * weight / (frames * weight + prior**-2)
    np.testing.assert_allclose(shared.step[0, SHIFT], expected, rtol=1e-3)
    np.testing.assert_allclose(shared.step[0, TURN], 0)
    pulled = cameras.solve([replace(evidence(known=0.0), pull=frames * np.ones(FREEDOMS))], frames)
    along = np.tile(pulled.step[0, SHIFT], (5, 1))
    np.testing.assert_allclose(pulled.along[:, OBJECT][:, 3:], along)


def _covariance(part: slice, sigma: float) -> np.ndarray:
    covariance = np.zeros((1, FREEDOMS, 1, FREEDOMS))
    covariance[0, part, 0, part] = np.eye(3) * sigma**2
    return covariance


def _step(covariance: np.ndarray, turn: float = 0.0, shift: float = 0.0) -> CameraStep:
    step = np.zeros((1, FREEDOMS))
    step[0, TURN], step[0, SHIFT] = turn, shift
    return CameraStep(step, np.zeros((1, 1)), covariance)


def test_implausible_correction_resets_all_cameras():
    covariance = _covariance(SHIFT, 0.003)
    cameras = CameraFit(Cameras(ring(1), np.zeros(1)), covariance)
    before = cameras.now.rig.master_from_colour.copy()
    assert not cameras.take(_step(covariance, shift=0.1))
    assert cameras.take(_step(covariance / 4, shift=0.005))
    moved = cameras.now.rig.master_from_colour[:, :3, 3] - before[:, :3, 3]
    np.testing.assert_allclose(moved, 0.005)
    np.testing.assert_array_equal(cameras.covariance, covariance / 4)
    # too far together with the accepted one
    assert not cameras.take(_step(covariance / 9, shift=0.011))
    np.testing.assert_array_equal(cameras.now.rig.master_from_colour, before)
    np.testing.assert_array_equal(cameras.covariance, covariance)
    assert cameras.refused


def test_corrections_are_bounded_together_and_in_size():
    tied = _covariance(TURN, 0.01) + _covariance(SHIFT, 0.01)
    for axis in range(3):  # a turn and a shift that cancel each other
        tied[0, axis, 0, 3 + axis] = tied[0, 3 + axis, 0, axis] = -0.9999 * 0.01**2
    for covariance, step in (
        (tied, {"turn": 0.004, "shift": 0.004}), (_covariance(TURN, 0.02), {"turn": 0.03}),
    ):  # fmt: skip
        cameras = CameraFit(Cameras(ring(1), np.zeros(1)), covariance)
        assert not cameras.take(_step(covariance, **step))
    indefinite = _covariance(TURN, 1.0)
    indefinite[0, 0, 0, 1] = indefinite[0, 1, 0, 0] = 2.0
    with pytest.raises(np.linalg.LinAlgError):
        CameraFit(Cameras(ring(1), np.zeros(1)), indefinite)
