from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from intercap_core.body.contour import contour_rows
from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.keypoints import CONTOUR
from intercap_core.body.model import BodyModel

from .conftest import random_vector

FRONT = np.diag([1.0, -1, -1])  # a camera that looks at the face of a body at rest


def _cameras(*from_rest: np.ndarray) -> torch.Tensor:
    """Cameras in front of a body that is turned by these rotations."""
    return torch.as_tensor(np.stack([FRONT @ r for r in from_rest]))


def _turn(*angles_deg: float, axes: str = "y") -> np.ndarray:
    return Rotation.from_euler(axes, angles_deg, degrees=True).as_matrix()


def _row_of(rotation: np.ndarray) -> int:
    """The table's row as smplx finds it from the neck chain's rotation, cameras y up."""
    size = np.hypot(rotation[0, 0], rotation[1, 0])
    y = int(np.round(min(-np.degrees(np.arctan2(-rotation[2, 0], size)), 39)))
    if y < -39:
        return 78
    return 39 - y if y < 0 else y


@pytest.mark.parametrize(
    "yaw, row", [(0, 0), (-10, 10), (10, 49), (-39, 39), (39, 78), (-80, 39), (80, 78), (-0.4, 0)]
)
def test_the_row_is_the_turn_of_the_head_in_degrees(yaw: float, row: int) -> None:
    rest = torch.eye(3, dtype=torch.float64)[None]
    assert contour_rows(rest, _cameras(_turn(yaw))) == row
    assert contour_rows(torch.as_tensor(_turn(yaw))[None], _cameras(np.eye(3))) == row


def test_the_row_is_that_of_smplx() -> None:
    turns = Rotation.random(200, random_state=1).as_matrix()
    found = contour_rows(torch.as_tensor(turns), _cameras(np.eye(3)))[:, 0]
    assert found.tolist() == [_row_of(r) for r in turns]


def test_nodding_and_tilting_change_nothing() -> None:
    turns = [_turn(nod, 20, tilt, axes="xyz") for nod in (-30, 0, 30) for tilt in (-40, 0, 40)]
    rows = contour_rows(torch.as_tensor(np.stack(turns)), _cameras(np.eye(3)))
    assert (rows == 59).all()


def test_neck_and_head_turn_the_face_wherever_the_body_stands(body64: BodyModel) -> None:
    params = body64.zeros()
    for joint, yaw in (("neck", 0.15), ("head", 0.2), ("spine3", -0.1)):
        params.body_pose[0, 3 * JOINT_INDEX[joint] - 2] = yaw
    row = body64.contour_rows(params, _cameras(np.eye(3)))
    assert row == 39 + round(np.degrees(0.25))
    world = _turn(30, -50, 70, axes="xyz")
    params.global_orient = torch.as_tensor(Rotation.from_matrix(world).as_rotvec())[None]
    assert body64.contour_rows(params, _cameras(world.T)) == row


def test_seen_from_the_front_it_is_the_static_one(body64: BodyModel) -> None:
    params = body64.parameters(random_vector(2, body64.num_parameters, 4, torch.float64))
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    params.global_orient, params.body_pose = torch.zeros(2, 3), 0 * params.body_pose
    poses[:, :3, :3] = _cameras(np.eye(3), _turn(25))
    found = body64.keypoints_by_view(params, poses)
    known = body64.keypoints_of(params)
    assert torch.equal(found[:, 0], known)
    assert torch.equal(found[:, 1, : CONTOUR.start], known[:, : CONTOUR.start])
    assert not torch.allclose(found[:, 1, CONTOUR], known[:, CONTOUR], atol=5e-3)


@pytest.mark.parametrize("yaw", [10.0, 20, 30, 39])
def test_turned_it_is_the_outline_of_the_cheek_that_turns_away(
    yaw: float, body64: BodyModel
) -> None:
    """Farther out, in the image, than the frontal line, but for the spacing of the vertices that it
    is made of; mirrored heads have mirrored lines."""
    params = body64.zeros()
    cameras = _cameras(_turn(yaw), _turn(-yaw))
    still = body64.keypoints_of(params)[0, CONTOUR]
    left, right = body64.keypoints_by_view(params, cameras)[0, :, CONTOUR]
    mirror = torch.tensor([-1.0, 1, 1], dtype=torch.float64)
    assert (left.flip(0) * mirror - right).norm(dim=1).max() < 0.008
    cheek = slice(10, 16)  # of the person's left, that the first camera sees turn away
    outward = (left @ cameras[0].T)[cheek, 0] - (still @ cameras[0].T)[cheek, 0]
    assert outward.min() > -0.006 and outward.mean() > -1e-3 and outward.max() > 1e-4 * yaw


def test_derivatives_equal_autograd(body64: BodyModel) -> None:
    vector = random_vector(2, body64.num_parameters, 3, torch.float64)
    cameras = torch.as_tensor(Rotation.random(3, random_state=2).as_matrix())
    points, derivatives = body64.contour_jacobian(body64.parameters(vector), cameras)

    def lines(v: torch.Tensor) -> torch.Tensor:
        return body64.keypoints_by_view(body64.parameters(v[None]), cameras)[0, :, CONTOUR]

    for at in range(2):
        expected = torch.autograd.functional.jacobian(lines, vector[at])
        assert torch.allclose(points[at], lines(vector[at]), atol=1e-12)
        assert (derivatives[at] - expected).abs().max() < 1e-10
