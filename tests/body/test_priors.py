from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from intercap_core.body import priors
from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.model import BodyModel
from intercap_core.body.priors import LIMITS_DEG, REST_SPREAD_DEG

from .conftest import hand_pose, random_vector

Rows = priors.DiagonalRows | priors.LinearRows


def _hand(model: BodyModel, side: int) -> Callable[[Tensor], Rows]:
    own = (model.hand_mean, model.hand_components, model.hand_deviation)
    return lambda v: priors.hand_pose(v, *own, side=side)


@pytest.mark.parametrize("name", ["limits", "bending", "rest", "left", "right"])
def test_rows_have_the_derivatives_of_their_residuals(name: str, body64: BodyModel) -> None:
    """Slopes and Jacobians against autograd of the residuals."""
    terms = {
        "limits": priors.joint_limits,
        "bending": priors.bending,
        "rest": priors.rest_pose,
        "left": _hand(body64, 0),
        "right": _hand(body64, 1),
    }
    term, size = terms[name], body64.num_parameters
    vector = random_vector(2, size, 11, torch.float64) * 3
    rows = term(vector)
    for b in range(2):
        expected = torch.autograd.functional.jacobian(
            lambda v: term(v[None]).residuals[0], vector[b]
        )
        found = torch.zeros_like(expected)
        if isinstance(rows, priors.DiagonalRows):
            found[torch.arange(len(rows.columns)), rows.columns] = rows.slopes[b]
        else:
            found[:, rows.columns] = rows.jacobian
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)


def test_limits_are_mirrored_and_contain_the_rest_poses() -> None:
    limits = np.array(LIMITS_DEG)
    rest = np.array(REST_SPREAD_DEG)
    assert (limits[..., 0] <= 0).all() and (limits[..., 1] >= 0).all()
    assert (rest[:25, :, 0] > limits[:25, :, 0]).all()
    assert (rest[:25, :, 0] < limits[:25, :, 1]).all()
    for name, left in JOINT_INDEX.items():
        if name.startswith("left_"):
            right = JOINT_INDEX["right_" + name[5:]]
            assert (limits[left, 1:] == -limits[right, 1:, ::-1]).all()
            assert (limits[left, 0] == limits[right, 0]).all()


def test_limits_cost_only_impossible_poses() -> None:
    vector = torch.zeros(5, 188)
    vector[1, [3 * 18 + 1, 3 * 19 + 1]] = torch.tensor([-2.3, 2.3])  # both elbows closed
    vector[2, [3, 6, 12, 15]] = torch.tensor([-1.6, -1.6, 1.7, 1.7])  # sitting
    vector[3, [3 * 16 + 2, 3 * 17 + 2]] = torch.tensor([-1.3, 1.3])  # arms hang
    vector[4, 12] = -0.5  # the knee bends forward
    cost = (priors.joint_limits(vector).residuals ** 2).sum(1)
    assert (cost[:4] == 0).all()
    assert cost[4] > 0.1
    bend = (priors.bending(vector).residuals ** 2).sum(1)
    assert bend[1] < bend[0] < bend[4]


def test_likely_hands_are_within_limits(body64: BodyModel) -> None:
    vector = torch.zeros(200, body64.num_parameters, dtype=torch.float64)
    generator = torch.Generator().manual_seed(1)
    for side, at in ((0, slice(75, 120)), (1, slice(120, 165))):
        code = torch.randn(200, 45, generator=generator, dtype=torch.float64)
        code = code.clamp(-1.5, 1.5) * body64.hand_deviation[side]
        vector[:, at] = hand_pose(body64, code, side)
    rows = _hand(body64, 0)(vector)
    assert rows.residuals.abs().max() < 1.5 + 1e-5
    assert priors.joint_limits(vector).residuals.abs().median() == 0
    assert torch.deg2rad(torch.tensor(12.0)) > priors.joint_limits(vector).residuals.abs().mean()
