from __future__ import annotations

from pathlib import Path

import pytest
import torch

from intercap_core.body.kinematics import skin
from intercap_core.body.model import BodyModel

from .conftest import random_vector


def _bones(batch: int, joints: int, points: int) -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(5)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    weights = random(points, joints).softmax(1)
    return (
        random(batch, points, 3),
        random(batch, joints, 3, 3),
        random(batch, joints, 3),
        weights,
    )


def test_is_the_weighted_sum_of_what_each_bone_does() -> None:
    points, rotations, offsets, weights = _bones(3, 4, 7)
    each = torch.einsum("bjik,bnk->bnji", rotations, points) + offsets[:, None]
    expected = (weights[None, :, :, None] * each).sum(2)
    assert torch.allclose(skin(points, rotations, offsets, weights), expected, atol=1e-14)


def test_the_gradient_is_that_of_finite_differences() -> None:
    points, rotations, offsets, weights = _bones(2, 3, 4)
    inputs = tuple(x.requires_grad_() for x in (points, rotations, offsets))
    assert torch.autograd.gradcheck(lambda *x: skin(*x, weights), inputs)


@pytest.mark.parametrize("kibibytes", [1, 1 << 20])
def test_pieces_do_not_show(kibibytes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    points, rotations, offsets, weights = _bones(5, 4, 300)
    whole = skin(points, rotations, offsets, weights)
    monkeypatch.setattr("intercap_core.body.kinematics._CACHE_BYTES", kibibytes << 10)
    assert torch.allclose(skin(points, rotations, offsets, weights), whole, atol=1e-14)


def test_no_points_and_no_bodies() -> None:
    for batch, count in ((0, 5), (2, 0)):
        found = skin(*_bones(batch, 4, count))
        assert found.shape == (batch, count, 3)


def test_the_models_gradient_is_the_peer_librarys(full_file: Path) -> None:
    from body_models.smplx.torch import SMPLX

    model, peer = BodyModel.load(full_file), SMPLX(model_path=full_file, flat_hand_mean=True)
    vector = random_vector(3, model.num_parameters, 8, torch.float32)
    pull = torch.randn(3, model.num_vertices, 3, generator=torch.Generator().manual_seed(1))
    gradients = []
    for ours in (True, False):
        x = vector.clone().requires_grad_()
        params = model.parameters(x)
        turns = params.full_pose()
        if ours:
            vertices = model.forward(params).vertices
        else:
            vertices = peer.forward_vertices(
                pelvis_rotation=turns[:, 0], body_pose=turns[:, 1:22], head_pose=turns[:, 22:25],
                hand_pose=turns[:, 25:], global_translation=params.transl, shape=params.betas,
                expression=params.expression,
            )  # fmt: skip
        (vertices * pull).sum().backward()
        gradients.append(x.grad)
    largest = gradients[1].abs().max()
    assert (gradients[0] - gradients[1]).abs().max() < 1e-5 * largest
