"""Frames that leave the motion of their neighbours."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import TRANSL
from intercap_core.body.vposer import PoseGaussian
from intercap_core.body_fit import body_keypoints, body_samples
from intercap_core.body_fit.problem import BodyProblem, columns_of
from intercap_core.body_fit.recover import jumps, recover
from intercap_core.body_fit.term_inputs import Views
from tests.helpers.body_capture import master_from_room, ring

TIMES = np.arange(40) / 15


def _swinging() -> np.ndarray:
    """(40,2,3): a hand that walks at 1.5 m/s and swings at up to 2 m/s, and a pelvis that walks."""
    joints = np.zeros((len(TIMES), 2, 3))
    joints[:, :, 0] = 1.5 * TIMES[:, None]
    joints[:, 0, 1] = 0.3 * np.sin(2 * np.pi * TIMES)
    return joints


def test_people_do_not_jump():
    assert not jumps(_swinging(), TIMES).any()


def test_an_arm_elsewhere_for_three_frames_jumps():
    joints = _swinging()
    joints[20:23, 0, 2] += 0.4
    found = jumps(joints, TIMES)
    assert (found[20:23, 0] > 0.35).all()
    found[20:23, 0] = 0
    assert not found.any()


def test_gaps_and_ends_say_nothing():
    joints = _swinging()
    joints[[0, -1], 0, 2] += 1.0
    joints[20, 0, 2] += 1.0
    alone = np.r_[TIMES[:20], TIMES[20] + 1, TIMES[21:] + 2]
    found = jumps(joints, alone)
    assert not found[[0, 20, -1]].any()


@pytest.mark.parametrize("learned", [False, True])
def test_a_body_in_another_minimum_is_fitted_again_from_between_its_neighbours(learned: bool):
    """An arm stretched backwards in one frame of twenty comes back; the others stay as they are."""
    model = BodyModel.load(dtype=torch.float64)
    count, odd = 20, 13
    truth = model.zeros(count).vector().double()
    shoulder = 3 * JOINT_INDEX["right_shoulder"]
    truth[:, shoulder + 1] = torch.linspace(0.2, 1.2, count)
    truth[:, TRANSL.start] = torch.linspace(0, 0.6, count)
    rig = ring(4)
    pose, lenses = torch.tensor(rig.colour_from_master), torch.tensor(rig.colour_parameters)
    room = torch.as_tensor(master_from_room())
    still = model.forward(model.zeros(), vertex_ids=np.array([0])).joints[0, 0]
    upright = Rotation.from_matrix(room[:3, :3].numpy()) * Rotation.from_euler("x", 90, True)
    truth[:, :3] = torch.as_tensor(upright.as_rotvec())
    truth[:, TRANSL] += room[:3, :3] @ torch.tensor([0.0, 0.1, 0.95]).double() + room[:3, 3] - still
    points = model.keypoints_of(model.parameters(truth))
    shape = (count, 4, 135)
    seen = body_keypoints.pixel_residuals(points, torch.zeros(*shape, 2).double(), lenses, pose)
    start = truth.clone()
    start[odd, shoulder + 1] -= 2.5
    problem = BodyProblem(
        model, body_keypoints.keypoint_set(model, range(135)), body_samples.choose_samples(model),
        start, columns_of(model, hands=False, face=False, betas=False), True,
        offsets=start.new_zeros(25, 3), u=start.new_zeros(len(body_samples.COVERINGS)),
        views=Views(seen, torch.ones(shape).double(), torch.full(shape, 3.0).double(), lenses,
                    pose),
    )  # fmt: skip
    if learned:  # sure of every frame's own pose: another frame's would show
        sure = 1e6 * torch.eye(63).double().expand(count, 63, 63)
        problem.pose = PoseGaussian(truth[:, 3:66].clone(), sure)
    changed = recover(problem, np.arange(count) / 15)
    assert np.flatnonzero(changed).tolist() == [odd]
    off = (model.keypoints_of(model.parameters(problem.base)) - points).norm(dim=-1).amax(1)
    assert off[odd] < 0.02  # of 135 points; the arm was 1 m off
    assert torch.equal(problem.base[torch.arange(count) != odd], truth[torch.arange(count) != odd])
    if learned:
        assert (problem.base - truth)[odd, 3:66].abs().max() < 0.01
