"""E_J: derivatives against finite differences, offsets, sums over views."""

from __future__ import annotations

import torch
from torch import Tensor

from intercap_core.body.model import BodyModel
from intercap_core.body_fit import body_keypoints as term
from tests.helpers.bodies import random_normal

K = 135


def _vector(model: BodyModel, batch: int = 2) -> Tensor:
    x = 0.15 * random_normal(batch, model.num_parameters)
    x[:, 165:168] += torch.tensor([0.0, 0.0, 2.5], dtype=torch.float64)
    return x


def test_offset_keypoints_follow_their_bones(model: BodyModel) -> None:
    """Derivatives of displaced keypoints by every parameter match central differences."""
    carried = term.keypoint_set(model, range(K))
    offsets = 0.02 * random_normal(K, 3, seed=1)
    x = _vector(model)
    found = term.evaluate(model, model.parameters(x), carried, offsets, derivatives=True)
    direction = random_normal(*x.shape, seed=2)
    step = 1e-6
    ahead, back = (
        term.evaluate(
            model, model.parameters(x + s * step * direction), carried, offsets, derivatives=False
        ).points
        for s in (1, -1)
    )
    assert found.derivatives is not None
    along = (found.derivatives @ direction[:, None, :, None])[..., 0]
    torch.testing.assert_close(along, (ahead - back) / (2 * step), atol=1e-7, rtol=1e-6)


def test_no_offset_gives_the_model_s_keypoints(model: BodyModel) -> None:
    params = model.parameters(_vector(model))
    found = term.evaluate(
        model,
        params,
        term.keypoint_set(model, range(K)),
        torch.zeros(K, 3).double(),
        derivatives=False,
    )
    torch.testing.assert_close(found.points, model.keypoints_of(params))


def _views(cameras: int = 3) -> tuple[Tensor, ...]:
    lenses = torch.zeros(cameras, 13, dtype=torch.float64)
    lenses[:, :4] = torch.tensor([900.0, 905.0, 640.0, 360.0], dtype=torch.float64)
    lenses[:, 4:6] = torch.tensor([0.1, -0.05], dtype=torch.float64)
    lenses[:, 12] = 1.7
    pose = torch.eye(4, dtype=torch.float64).repeat(cameras, 1, 1)
    pose[:, 0, 3] = torch.linspace(-0.4, 0.4, cameras, dtype=torch.float64)
    observed = 300 * random_normal(2, cameras, K, 2, seed=3) + 500
    confidence = torch.rand(
        2, cameras, K, dtype=torch.float64, generator=torch.Generator().manual_seed(4)
    )
    confidence[0, 1, 5:20] = 0
    observed[0, 1, 5:20] = torch.nan
    sigma = torch.full((2, cameras, K), 40.0, dtype=torch.float64)
    return observed, confidence, sigma, lenses, pose


def test_gradient_of_the_whole_term(model: BodyModel) -> None:
    """By pose, shape and offsets, through projection, robust weight and sums over views."""
    carried = term.keypoint_set(model, range(K))
    offsets = 0.02 * random_normal(K, 3, seed=1)
    views, x = _views(), _vector(model)
    shift = 0.01 * random_normal(2, 3, K, 3, seed=8)

    def cost(x: Tensor, offsets: Tensor) -> Tensor:
        found = term.evaluate(model, model.parameters(x), carried, offsets, derivatives=False)
        return term.reprojection(found.points, *views, scale=4.0, shift=shift).cost

    found = term.evaluate(model, model.parameters(x), carried, offsets, derivatives=True)
    result = term.reprojection(found.points, *views, scale=4.0, shift=shift)
    gradient, hessian = term.assemble(result, found)
    by_offset, cross, block = term.assemble_offsets(result, found, 25)
    torch.testing.assert_close(hessian, hessian.transpose(1, 2), atol=1e-6, rtol=1e-6)
    assert bool((torch.linalg.eigvalsh(block) > -1e-6).all())
    assert cross.shape == (2, model.num_parameters, 75)

    step = 1e-6
    direction = random_normal(*x.shape, seed=5)
    slope = (cost(x + step * direction, offsets) - cost(x - step * direction, offsets)) / (2 * step)
    torch.testing.assert_close((gradient * direction).sum(1), slope, rtol=1e-5, atol=1e-4)
    move = torch.zeros(K, 3, dtype=torch.float64)
    move[:25] = random_normal(25, 3, seed=6)
    slope = (cost(x, offsets + step * move) - cost(x, offsets - step * move)) / (2 * step)
    torch.testing.assert_close(by_offset @ move[:25].reshape(-1), slope, rtol=1e-5, atol=1e-4)


def test_triangulated_targets(model: BodyModel) -> None:
    points, targets = random_normal(2, K, 3), random_normal(2, K, 3, seed=9)
    confidence = torch.ones(2, K, dtype=torch.float64)
    confidence[:, 3] = 0
    targets[:, 3] = torch.nan
    result = term.triangulated(points, targets, confidence, sigma=0.5, scale=4.0)
    step, direction = 1e-6, random_normal(2, K, 3, seed=10)
    up, down = (
        term.triangulated(points + s * step * direction, targets, confidence, sigma=0.5, scale=4.0)
        for s in (1, -1)
    )
    slope = (up.cost - down.cost) / (2 * step)
    torch.testing.assert_close((result.gradient * direction).sum((1, 2)), slope)
