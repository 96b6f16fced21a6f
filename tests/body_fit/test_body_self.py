"""E_P_self: derivatives by finite differences, constructed contacts by winding numbers."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from intercap_core.body_fit.body_constants import SELF_TOLERANCE_M
from torch import Tensor

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.kinematics import vertex_normals
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import BodyParameters
from intercap_core.body_fit import body_self as term
from intercap_core.body_fit.problem import BodyProblem, columns_of
from intercap_core.body_fit.surface import COVERINGS, choose_samples
from intercap_core.body_fit.term_inputs import Targets, keypoint_set
from intercap_core.geometry.solve.levenberg_marquardt import minimise


@pytest.fixture(scope="module")
def contact(model: BodyModel) -> term.SelfContact:
    return term.SelfContact.of(model, choose_samples(model))


def _pose(model: BodyModel, **turns: tuple[float, float, float]) -> BodyParameters:
    """Arms hanging, then the named joints' rotation vectors, degrees."""
    vector = model.zeros().vector().clone()
    joints = {"left_shoulder": (0, 0, -78), "right_shoulder": (0, 0, 78)} | turns
    for name, degrees in joints.items():
        at = 3 * JOINT_INDEX[name]
        vector[0, at : at + 3] = torch.deg2rad(torch.tensor(degrees, dtype=vector.dtype))
    return model.parameters(vector)


# A hand in its thigh, sitting; an arm in the trunk's side; thighs, and two fingers, through
# each other.
CASES: dict[str, dict[str, tuple[float, float, float]]] = {
    "hand in thigh": {"left_hip": (-80, 0, 0), "left_knee": (85, 0, 0),
                      "left_shoulder": (0, 0, -90), "left_elbow": (0, -75, 0)},
    "arm at trunk": {"right_shoulder": (0, 0, 84)},
    "crossed legs": {"left_hip": (-85, 0, -14), "left_knee": (60, 0, 0), "right_hip": (-78, 0, 14),
                     "right_knee": (60, 0, 0)},
    "crossed fingers": {"left_index1": (0, 20, -40), "left_index2": (0, 0, -40),
                        "left_middle1": (0, -20, -40), "left_middle2": (0, 0, -40)},
}  # fmt: skip


def _find(model: BodyModel, contact: term.SelfContact, params: BodyParameters) -> term.Pairs | None:
    vertices = model.forward(params).vertices
    normals = vertex_normals(vertices, model.faces)
    return term.join([term.find(contact, *one) for one in zip(vertices, normals, strict=True)])


def _depth(model: BodyModel, params: BodyParameters, pairs: term.Pairs | None) -> float:
    if pairs is None:
        return 0.0
    points = model.forward(params, vertex_ids=pairs.vertices).vertices
    gap = points[pairs.frame, pairs.inner] - points[pairs.frame, pairs.outer]
    return max(float(-(pairs.normal * gap).sum(1).min()), 0.0)


def _winding(points: Tensor, triangles: Tensor) -> Tensor:
    """How often a closed mesh (F,3,3) is wound around points (N,): van Oosterom, Strackee 1983."""
    a, b, c = (triangles[None, :, k] - points[:, None] for k in range(3))
    la, lb, lc = a.norm(dim=2), b.norm(dim=2), c.norm(dim=2)
    above = (a * torch.linalg.cross(b, c)).sum(2)
    below = la * lb * lc + (a * b).sum(2) * lc + (b * c).sum(2) * la + (c * a).sum(2) * lb
    return torch.atan2(above, below).sum(1) / (2 * np.pi)


def test_nothing_touches_at_rest_or_with_hanging_arms(
    model: BodyModel, contact: term.SelfContact
) -> None:
    for params in (model.zeros(), _pose(model), _pose(model, left_elbow=(0, -90, 0))):
        pairs = _find(model, contact, params)
        assert _depth(model, params, pairs) < SELF_TOLERANCE_M
        if pairs is not None:
            assert float(term.cost(model, params, pairs, torch.tensor([0]))) == 0.0
            columns = torch.arange(165)
            assert term.assemble(model, params, pairs, torch.tensor([0]), columns) is None


@pytest.mark.parametrize("name", CASES)
def test_samples_that_are_found_are_inside_by_winding_number(
    name: str, model: BodyModel, contact: term.SelfContact
) -> None:
    params = _pose(model, **CASES[name])
    vertices = model.forward(params).vertices
    normals = vertex_normals(vertices, model.faces)
    inner, outer, normal = term.find(contact, vertices[0], normals[0])
    depth = -((vertices[0, inner] - vertices[0, outer]) * normal).sum(1)
    deep = inner[depth > SELF_TOLERANCE_M]
    assert len(deep) >= 3
    # just outside one's own skin, the mesh is wound around only what is inside another part
    just_outside = vertices[0, deep] + 1e-3 * normals[0, deep]
    wound = _winding(just_outside, vertices[0][model.faces])
    assert float((wound > 0.5).double().mean()) > 0.9


@pytest.mark.parametrize("name", CASES)
def test_compiled_search_finds_what_the_plain_one_does(
    name: str, model: BodyModel, contact: term.SelfContact
) -> None:
    vertices = model.forward(_pose(model, **CASES[name])).vertices
    normals = vertex_normals(vertices, model.faces)
    plain = term.find_plain(contact, vertices[0], normals[0])
    compiled = term.find_compiled(contact, vertices[0], normals[0])
    assert len(plain[0])
    for one, other in zip(plain, compiled, strict=True):
        assert torch.equal(one, other)


def test_ways_over_the_surface_are_right_as_far_as_asked(model: BodyModel) -> None:
    template, faces = model.template.numpy(), model.faces.numpy()
    part = model.skinning_weights.argmax(1).numpy()
    vertex = choose_samples(model).vertex[::9]
    count = len(vertex)
    every = term._over_the_surface(template, faces, part, vertex, np.full((count, count), 10.0))
    limit = np.random.default_rng(0).uniform(0, 0.4, (count, count))
    limit = limit + limit.T
    found = term._over_the_surface(template, faces, part, vertex, limit)
    within = every <= limit
    assert 0.05 < within.mean() < 0.95
    np.testing.assert_array_equal(found[within], every[within])
    assert (found[~within] > limit[~within]).all()


def test_gradient_is_that_of_the_cost(model: BodyModel, contact: term.SelfContact) -> None:
    cases = [_pose(model, **CASES[name]).vector() for name in ("hand in thigh", "arm at trunk")]
    x = torch.cat([cases[0], _pose(model).vector(), cases[1]])
    pairs = _find(model, contact, model.parameters(x))
    assert pairs is not None
    index, columns = torch.tensor([2, 0]), torch.arange(model.num_parameters)
    found = term.assemble(model, model.parameters(x[index]), pairs, index, columns)
    assert found is not None
    assert found.present.tolist() == [0, 1]
    costs = term.cost(model, model.parameters(x[index]), pairs, index)
    torch.testing.assert_close(found.cost, costs)
    direction = torch.randn(x[index].shape, generator=torch.Generator().manual_seed(0)).double()
    step = 1e-6
    ahead, behind = (
        term.cost(model, model.parameters(x[index] + sign * step * direction), pairs, index)
        for sign in (1, -1)
    )
    slope = (ahead - behind) / (2 * step)
    torch.testing.assert_close((found.gradient * direction).sum(1), slope, rtol=1e-4, atol=1e-3)
    assert torch.linalg.eigvalsh(found.hessian).min() > -1e-6 * found.hessian.abs().max()


@pytest.mark.parametrize("name", CASES)
def test_a_fit_to_keypoints_of_penetrating_limbs_comes_apart(
    name: str, model: BodyModel, contact: term.SelfContact
) -> None:
    """Keypoints with 20 mm of noise that put parts inside each other: with the term, they touch."""
    params = _pose(model, **CASES[name])
    truth = model.keypoints_of(params)[:, :67]
    problem = BodyProblem(
        model, keypoint_set(model, range(67)), choose_samples(model), params.vector().clone(),
        columns_of(model, hands=True, face=False, betas=False), False,
        offsets=torch.zeros(25, 3).double(), u=torch.zeros(len(COVERINGS)).double(),
        targets=Targets(truth, torch.ones(1, 67).double(), 0.02),
    )  # fmt: skip
    before = _depth(model, params, _find(model, contact, params))
    for _ in range(3):
        here = model.parameters(problem.base)
        problem.touching = _find(model, contact, here)
        solution = minimise(problem, problem.own_start(), max_trials=10)
        problem.accept(solution.own, solution.shared)
    here = model.parameters(problem.base)
    after = _depth(model, here, _find(model, contact, here))
    assert before > 0.008
    assert after - SELF_TOLERANCE_M < 0.5 * (before - SELF_TOLERANCE_M)
    moved = (model.keypoints_of(here)[:, :67] - truth).norm(dim=2)
    assert float(moved.median()) < 0.03
