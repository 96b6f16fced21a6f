from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from intercap_core.body.joints import PARENTS
from intercap_core.body.kinematics import left_jacobian, rotation_from_axis_angle
from intercap_core.body.model import BodyModel

from .conftest import random_vector

# Points of trunk, head, jaw, eyes, feet, hands and fingers
ALL_OVER = torch.tensor([0, 50, 3000, 5000, 5060, 8563, 9316, 11519, 13357, 13429])


def _by_autograd(model: BodyModel, vector: torch.Tensor, pulls: torch.Tensor) -> torch.Tensor:
    """Derivatives (R,B,P) along random directions (R,N,3) of all points together."""
    free = vector.clone().requires_grad_()
    out = model.forward(model.parameters(free), vertex_ids=ALL_OVER)
    points = torch.cat([out.vertices, out.joints], 1)
    slopes = (
        torch.autograd.grad((points * pull).sum(), free, retain_graph=True)[0] for pull in pulls
    )
    return torch.stack(list(slopes))


def _by_formula(model: BodyModel, vector: torch.Tensor, ids: torch.Tensor | None) -> torch.Tensor:
    return model.linearise(model.parameters(vector), vertex_ids=ids, joints=True).full()


@pytest.mark.parametrize("full", [False, True])
def test_equals_autograd(full: bool, body64: BodyModel, full_file: Path) -> None:
    """Of the open body, and of a file with blend shapes, 300 shapes and 100 expressions.

    Angles near zero, at zero, and near pi are included.
    """
    options = {"num_betas": 300, "num_expression": 100}
    model = BodyModel.load(full_file, dtype=torch.float64, **options) if full else body64
    vector = random_vector(3, model.num_parameters, 7, torch.float64)
    vector[:, 168:] *= 0.2
    vector[0, 3:6], vector[0, 6:9] = 0, 1e-6
    vector[1, 0:3] = torch.tensor([math.pi - 1e-4, 0, 0])
    vector[1, 54:57] = torch.tensor([1.0, -2.0, 2.1]) * (3.14159 / math.sqrt(9.41))
    ours = _by_formula(model, vector, ALL_OVER)
    pulls = torch.nn.functional.normalize(random_vector(3, 195, 13, torch.float64)).unflatten(
        1, (65, 3)
    )
    along = torch.einsum("rnc,bncp->rbp", pulls, ours)
    difference = (along - _by_autograd(model, vector, pulls)).abs()
    assert difference.max() < 1e-10
    assert difference[:, 2].max() < 1e-12  # usual angles
    linear = model.linearise(model.parameters(vector), vertex_ids=ALL_OVER, joints=True)
    out = model.forward(model.parameters(vector), vertex_ids=ALL_OVER)
    assert torch.allclose(linear.vertices, out.vertices, atol=1e-12)
    assert torch.allclose(linear.joints, out.joints, atol=1e-12)
    if full:
        assert (ours[..., 165:].abs().amax((0, 1, 2)) > 1e-6).all()  # no parameter is ignored
        single = BodyModel.load(full_file, **options)
        rounded = _by_formula(single, vector[2:].float(), ALL_OVER)
        assert rounded.dtype == torch.float32
        exact = _by_formula(model, vector[2:].float().double(), ALL_OVER)
        assert (rounded - exact).abs().max() < 5e-6


def test_every_parameter_moves_skin_and_leaf_joints_no_joint(body: BodyModel) -> None:
    vector = random_vector(2, body.num_parameters, 12, torch.float32)
    weights = body.skinning_weights
    ids = torch.unique(torch.where(weights.amax(0) > 0, weights.argmax(0), 0))
    moved = _by_formula(body, vector, ids).abs()
    assert (moved[:, : len(ids)].amax((0, 1, 2)) > 1e-6).all()
    still = (moved[:, len(ids) :].amax((0, 1, 2))[:178] < 1e-6).nonzero()
    ends = {3 * joint + axis for joint in range(55) if joint not in PARENTS for axis in range(3)}
    assert {int(i) for i in still} == ends


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.0099, 0.0101, 1.0, 3.0, math.pi, 4.0])
def test_left_jacobian_turns_small_changes_into_world_turns(angle: float) -> None:
    axis = torch.tensor([0.6, -0.48, 0.64], dtype=torch.float64)
    theta = angle * axis
    jacobian = torch.autograd.functional.jacobian(rotation_from_axis_angle, theta)
    rotation = rotation_from_axis_angle(theta)
    assert torch.allclose(rotation @ rotation.T, torch.eye(3, dtype=theta.dtype), atol=1e-10)
    turn = torch.einsum("ijc,kj->cik", jacobian, rotation)  # skew of the turn, for each component
    expected = torch.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]])
    assert torch.allclose(left_jacobian(theta), expected, atol=1e-9)


@pytest.mark.parametrize("pose_blend_shapes", [False, True])
def test_normal_equations_are_those_of_the_dense_rows(
    pose_blend_shapes: bool, body64: BodyModel, full_file: Path
) -> None:
    model = BodyModel.load(full_file, dtype=torch.float64) if pose_blend_shapes else body64
    params = model.parameters(random_vector(2, model.num_parameters, 9, torch.float64))
    ids = torch.arange(0, model.num_vertices, 393)
    linear = model.linearise(params, vertex_ids=ids, joints=True)
    generator = torch.Generator().manual_seed(0)
    shape = (2, linear.points.shape[1], 2)
    directions = torch.randn(*shape, 3, generator=generator, dtype=torch.float64)
    weights = torch.rand(shape, generator=generator, dtype=torch.float64)
    residuals = torch.randn(shape, generator=generator, dtype=torch.float64)
    hessian, gradient = linear.normal_equations(directions, weights, residuals)
    rows = linear.along(directions)
    expected = torch.einsum("bnrc,bncp->bnrp", directions, linear.full())
    assert torch.allclose(rows, expected, atol=1e-12)
    weighted = rows * weights[..., None]
    expected = torch.einsum("bnrp,bnrq->bpq", weighted, rows)
    assert torch.allclose(hessian, expected, atol=1e-9)
    assert torch.allclose(gradient, (weighted * residuals[..., None]).sum((1, 2)), atol=1e-9)
