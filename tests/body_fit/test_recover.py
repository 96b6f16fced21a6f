"""Start of the fit, noise of keypoints by confidence, and frames that leave their neighbours."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import TRANSL
from intercap_core.body.vposer import PoseGaussian
from intercap_core.body_fit.keypoint_term import fit_confidence_exponent
from intercap_core.body_fit.observations import TRUNK_KEYPOINTS, Observations
from intercap_core.body_fit.problem import BodyProblem, columns_of
from intercap_core.body_fit.recover import measure_jumps, recover
from intercap_core.body_fit.start import interpolate_unknown, place_trunk
from intercap_core.body_fit.surface import COVERINGS, choose_samples
from intercap_core.body_fit.term_inputs import keypoint_set
from tests.helpers.body_capture import exact_views, master_from_room, ring

TIMES = np.arange(40) / 15


# --- start ----------------------------------------------------------------------------------------

TURN = Rotation.from_rotvec(np.outer(TIMES[:12], [0, 1.0, 0.5]))


def _turning() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rest keypoints (135,3), their pelvis (3,), and keypoints (12,135,3) of a turning person."""
    rest = np.random.default_rng(0).normal(0, 0.3, (135, 3))
    pelvis = np.array([0.0, -0.3, 0.0])
    turned = np.stack([turn.apply(rest - pelvis) for turn in TURN])
    return rest, pelvis, turned + pelvis + TIMES[:12, None, None] * [1.0, 0, 0]


def test_frames_without_a_trunk_start_between_the_others() -> None:
    rest, pelvis, joints = _turning()
    joints[4:7, TRUNK_KEYPOINTS[:4]] = np.nan
    placed = place_trunk(rest, joints, pelvis)
    assert np.isnan(placed[4:7]).all()
    found = interpolate_unknown(placed, TIMES[:12])
    apart = Rotation.from_rotvec(found[:, :3]).inv() * TURN
    assert apart.magnitude().max() < 1e-6
    np.testing.assert_allclose(found[:, 3:], TIMES[:12, None] * [1.0, 0, 0], atol=1e-9)


def test_frames_near_placed_frames_are_usable_with_six_keypoints() -> None:
    _, _, joints = _turning()
    rig, frames, times = ring(2), 12, TIMES[:12].copy()
    joints[4, TRUNK_KEYPOINTS[:4]] = np.nan  # seen from the side
    joints[5, 5:] = np.nan  # only head and one arm
    joints[11, TRUNK_KEYPOINTS[:4]] = np.nan
    times[11] += 2.0  # no placed frame nearby
    observations = Observations(
        "test", rig, np.zeros((frames, 2, 135, 2)), np.zeros((frames, 2, 135)), joints,
        np.ones((frames, 135), int), [None, None], np.zeros(2), np.zeros((frames, 2), int),
        np.zeros(2), times,
    )  # fmt: skip
    assert np.flatnonzero(~observations.placed).tolist() == [4, 5, 11]
    assert np.flatnonzero(~observations.usable).tolist() == [5, 11]
    nobody = dataclasses.replace(observations, joints=np.full_like(joints, np.nan))
    assert not nobody.usable.any()


# --- confidence -----------------------------------------------------------------------------------


def _errors(power: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Confidences (4000,) and errors that grow with a power of them, 10 % outliers."""
    random = torch.Generator().manual_seed(0)
    confidence = 0.2 + 0.75 * torch.rand(4000, generator=random)
    error = 0.005 * confidence**-power * torch.randn(4000, generator=random).abs()
    error[::10] = 0.3
    return confidence, error


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0, 1.7])
def test_confidence_exponent_is_found_among_outliers(power: float) -> None:
    assert fit_confidence_exponent(*_errors(power)) == pytest.approx(power, abs=0.15)


def test_confidence_exponent_is_zero_without_evidence() -> None:
    confidence, error = _errors(1.0)
    assert fit_confidence_exponent(torch.full_like(error, 0.9), error) == 0
    assert fit_confidence_exponent(*(x[:100] for x in _errors(1.0))) == 0
    assert fit_confidence_exponent(1.2 - confidence, error) == 0  # never falls with confidence


# --- jumps ----------------------------------------------------------------------------------------


def _swinging() -> np.ndarray:
    """(40,2,3): a hand that walks at 1.5 m/s and swings at up to 2 m/s, and a pelvis that walks."""
    joints = np.zeros((len(TIMES), 2, 3))
    joints[:, :, 0] = 1.5 * TIMES[:, None]
    joints[:, 0, 1] = 0.3 * np.sin(2 * np.pi * TIMES)
    return joints


def test_only_an_arm_elsewhere_for_three_frames_jumps() -> None:
    joints = _swinging()
    assert not measure_jumps(joints, TIMES).any()
    joints[20:23, 0, 2] += 0.4
    found = measure_jumps(joints, TIMES)
    assert (found[20:23, 0] > 0.35).all()
    found[20:23, 0] = 0
    assert not found.any()


def test_frames_at_gaps_and_ends_have_no_jumps() -> None:
    joints = _swinging()
    joints[[0, -1], 0, 2] += 1.0
    joints[20, 0, 2] += 1.0
    alone = np.r_[TIMES[:20], TIMES[20] + 1, TIMES[21:] + 2]
    assert not measure_jumps(joints, alone)[[0, 20, -1]].any()


def test_a_body_in_another_minimum_is_refitted(body: BodyModel) -> None:
    """An arm stretched backwards in one frame of nine comes back; the others do not change.

    The learned pose prior knows every frame's own pose: another frame's would show.
    """
    model, count, odd = body, 9, 5
    truth = model.zeros(count).vector().clone()
    shoulder = 3 * JOINT_INDEX["right_shoulder"]
    truth[:, shoulder + 1] = torch.linspace(0.2, 0.6, count)
    truth[:, TRANSL.start] = torch.linspace(0, 0.27, count)
    room = torch.as_tensor(master_from_room()).float()
    still = model.forward(model.zeros(), vertex_ids=np.array([0])).joints[0, 0]
    upright = Rotation.from_matrix(room[:3, :3].numpy()) * Rotation.from_euler("x", 90, True)
    truth[:, :3] = torch.as_tensor(upright.as_rotvec())
    truth[:, TRANSL] += room[:3, :3] @ torch.tensor([0.0, 0.1, 0.95]) + room[:3, 3] - still
    points = model.keypoints_of(model.parameters(truth))
    start = truth.clone()
    start[odd, shoulder + 1] -= 2.5
    problem = BodyProblem(
        model=model, keypoints=keypoint_set(model, range(135)), samples=choose_samples(model),
        base=start, columns=columns_of(model, hands=False, face=False, betas=False), one_shape=True,
        offsets=start.new_zeros(25, 3), u=start.new_zeros(len(COVERINGS)),
        views=exact_views(points.double(), ring(4), sigma=3.0),
    )  # fmt: skip
    for learned in (False, True):
        problem.base = start.clone()
        if learned:
            sure = 1e6 * torch.eye(63).expand(count, 63, 63)
            problem.pose = PoseGaussian(truth[:, 3:66].clone(), sure)
        improved = recover(problem, np.arange(count) / 15)
        assert np.flatnonzero(improved).tolist() == [odd]
        off = (model.keypoints_of(model.parameters(problem.base)) - points).norm(dim=-1).amax(1)
        assert off[odd] < 0.02  # of 135 points; the arm was 1 m off
        others = torch.arange(count) != odd
        assert torch.equal(problem.base[others], truth[others])
        fast = problem.base.clone()
        assert not recover(problem, np.arange(count) / 15).any()
        assert torch.equal(problem.base, fast)
        if learned:
            assert (problem.base - truth)[odd, 3:66].abs().max() < 0.01
