"""Bodies as a skeleton, weights and a few modes: as near as they say to the model's own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from intercap_core.body.model import BodyModel
from intercap_core.output.viewer import skinning
from intercap_core.output.viewer.content import quantised
from intercap_core.output.viewer.page import payload, unpacked

FRAMES = 7


def _moving(model: BodyModel):
    random = torch.Generator().manual_seed(3)

    def draw(like: torch.Tensor, size: float) -> torch.Tensor:
        return size * torch.randn(like.shape, generator=random, dtype=like.dtype)

    zeros = model.zeros(FRAMES)
    betas = draw(zeros.betas[:1], 1.0).expand(FRAMES, -1)
    return replace(
        zeros,
        betas=betas,
        expression=draw(zeros.expression, 0.5),
        global_orient=draw(zeros.global_orient, 0.8),
        body_pose=draw(zeros.body_pose, 0.35),
        left_hand_pose=draw(zeros.left_hand_pose, 0.4),
        jaw_pose=draw(zeros.jaw_pose, 0.1),
        transl=draw(zeros.transl, 1.0),
    )


def _posed(body: skinning.SkinnedBody, t: int) -> np.ndarray:
    """The vertices (V, 3) of frame ``t``, as the viewer computes them."""
    shaped = body.rest + np.tensordot(body.amounts[t], body.modes, 1)
    blended = np.einsum("vk,vkab->vab", body.weights, body.transforms[t][body.joints])
    return np.einsum("vab,vb->va", blended[..., :3], shaped) + blended[..., 3]


def test_skinned_vertices_agree_with_the_model(model: BodyModel) -> None:
    params = _moving(model)
    found = skinning.skinned(model, params)
    with torch.no_grad():
        true = model.forward(params).vertices.double().numpy()
    error = max(np.linalg.norm(_posed(found, t) - true[t], axis=1).max() for t in range(FRAMES))
    # blended transforms stretch what is left out by little
    assert error <= 1.5 * skinning.CLOSE_M and found.error_m <= skinning.CLOSE_M
    assert len(found.modes) < FRAMES


def test_without_modes_the_error_is_larger(
    model: BodyModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(skinning, "_MOST_MODES", 0)
    found = skinning.skinned(model, _moving(model))
    assert found.error_m > 2 * skinning.CLOSE_M and found.modes.shape == (0, model.num_vertices, 3)


def test_weights_are_four_and_sum_to_one(model: BodyModel) -> None:
    found = skinning.skinned(model, _moving(model))
    assert found.joints.shape == found.weights.shape == (model.num_vertices, 4)
    assert found.weights.sum(1) == pytest.approx(1)


def test_a_body_that_stands_still_needs_no_modes(model: BodyModel) -> None:
    still = model.zeros(3)
    assert len(skinning.skinned(model, still).modes) == 0


def test_payloads_are_read_back() -> None:
    random = np.random.default_rng(0)
    arrays = {
        "a": random.standard_normal((3, 2)).astype(np.float32),
        "empty": np.zeros((0, 3), np.uint16),
        "odd": random.integers(0, 255, 7).astype(np.uint8),
        "last": random.integers(-9, 9, (2, 2)).astype(np.int16),
    }
    header, found = unpacked(payload({"name": 'a "b" </script> é'}, arrays))
    assert header == {"name": 'a "b" </script> é'}
    assert list(found) == list(arrays)
    for name, values in arrays.items():
        assert found[name].dtype == values.dtype
        np.testing.assert_array_equal(found[name], values)


def test_quantised_points_are_within_half_a_step() -> None:
    points = np.random.default_rng(1).uniform(-2, 2, (500, 3))
    steps, low, step = quantised(points)
    assert np.abs(np.array(low) + step * steps - points).max() <= step / 2 + 1e-9
    assert step < 1e-4
    assert quantised(np.zeros((0, 3)))[0].shape == (0, 3)
