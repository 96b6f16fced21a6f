"""Whether the numbers of a body file make a person, where its arrays are all of the right shape."""

from __future__ import annotations

import torch
from torch import Tensor

from intercap_core.body.model import BodyModel
from intercap_core.errors import UserError

_WIDEST_M = 3.0  # arm span and depth
_SKIN_M2 = (0.3, 6.0)  # clothes, hair and a newborn included
_FARTHEST_JOINT_M = 0.05  # beyond the box around the skin
_JOINTS_SPAN = 0.5  # of the skin's width and height
_MOVE_M = (1e-4, 1.0)  # of the vertex farthest moved by one unit of a shape or expression component
_HINT = "take the file as published, or none for the open body"


def check_body(model: BodyModel) -> None:
    """Raise UserError where no person can be fitted with the model, naming what is off."""
    template, joints = model.template, model.forward(model.zeros()).joints[0]
    low, high = template.amin(0), template.amax(0)
    beyond = torch.maximum(low - joints, joints - high).amax()
    area = _area(template, model.faces)
    span = ((joints.amax(0) - joints.amin(0)) / (high - low))[:2].amin()
    weights = model.skinning_weights
    lengths = model.hand_components.norm(dim=2)
    moves = _largest_move(model)
    problems = (
        (high - low).amax() > _WIDEST_M,
        f"a body {float((high - low).amax()):.3g} m wide, expected at most {_WIDEST_M:g} m",
    ), (
        not _SKIN_M2[0] < area < _SKIN_M2[1],
        f"{area:.3g} m2 of skin, expected {_SKIN_M2[0]:g} to {_SKIN_M2[1]:g}",
    ), (
        beyond > _FARTHEST_JOINT_M,
        f"a joint {float(beyond):.3g} m outside of its skin (J_regressor)",
    ), (
        not span > _JOINTS_SPAN,
        f"joints over {float(span):.0%} of its skin's width or height, expected at least "
        f"{_JOINTS_SPAN:.0%} (J_regressor)",
    ), (
        weights.amin() < -1e-3,
        f"a skinning weight of {float(weights.amin()):.3g}, expected none below 0 (weights)",
    ), (
        not _MOVE_M[0] < moves < _MOVE_M[1],
        f"shape components that move the skin by up to {moves:.3g} m a unit, expected "
        f"{_MOVE_M[0]:g} to {_MOVE_M[1]:g} m (shapedirs)",
    ), (
        lengths.amin() < 0.5 or lengths.amax() > 2,
        f"hand components of length {float(lengths.amin()):.3g} to {float(lengths.amax()):.3g}, "
        "expected 1 (hands_components)",
    ), (
        model.hand_deviation.amin() <= 0,
        "a hand component that never varies (hands_deviation or hands_coeffs)",
    ), (
        abs(model.keypoint_map.weights.sum(1)[model.keypoint_map.joint < 0] - 1).max() > 0.01,
        "landmarks whose corners do not add up to 1 (lmk_bary_coords)",
    )  # fmt: skip
    for wrong, words in problems:
        if wrong:
            raise UserError(f"Body file {model.path} has {words}: {_HINT}.")


def _area(points: Tensor, faces: Tensor) -> float:
    """Square metres of skin."""
    a, b, c = (points[faces[:, i]] for i in range(3))
    return 0.5 * float(torch.linalg.cross(b - a, c - a).norm(dim=1).sum())


def _largest_move(model: BodyModel) -> float:
    """Metres by which one unit of any shape or expression component moves a vertex at most."""
    components = model.num_betas + model.num_expression
    vector = model.zeros(components).vector()
    vector[:, -components:] = torch.eye(components, dtype=vector.dtype, device=vector.device)
    moved = model.forward(model.parameters(vector)).vertices - model.template
    return float(moved.norm(dim=2).amax())
