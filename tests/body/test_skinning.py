from __future__ import annotations

import pytest
import torch

from intercap_core.body.kinematics import skin


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


def test_gradient_equals_finite_differences() -> None:
    points, rotations, offsets, weights = _bones(2, 3, 4)
    inputs = tuple(x.requires_grad_() for x in (points, rotations, offsets))
    assert torch.autograd.gradcheck(lambda *x: skin(*x, weights), inputs)


@pytest.mark.parametrize("kibibytes", [1, 1 << 20])
def test_is_the_weighted_sum_of_bones_in_any_pieces(
    kibibytes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    points, rotations, offsets, weights = _bones(5, 4, 300)
    each = torch.einsum("bjik,bnk->bnji", rotations, points) + offsets[:, None]
    expected = (weights[None, :, :, None] * each).sum(2)
    monkeypatch.setattr("intercap_core.body.kinematics._CACHE_BYTES", kibibytes << 10)
    assert torch.allclose(skin(points, rotations, offsets, weights), expected, atol=1e-14)


def test_no_points_or_no_bodies() -> None:
    for batch, count in ((0, 5), (2, 0)):
        found = skin(*_bones(batch, 4, count))
        assert found.shape == (batch, count, 3)
