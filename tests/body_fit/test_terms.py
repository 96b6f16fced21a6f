"""The compiled terms of the body's energy against their plain form, and against differences."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from intercap_core.body.kinematics import vertex_normals
from intercap_core.body.loading import load_body_file
from intercap_core.body.model import BodyModel
from intercap_core.body.vposer import PoseGaussian
from intercap_core.body_fit import body_cloud, body_keypoints, body_samples, body_self
from intercap_core.body_fit.problem import BodyProblem, columns_of
from intercap_core.body_fit.term_inputs import Targets, Views
from intercap_core.body_fit.terms import TorchTerms

FRAMES, CAMERAS, KEYPOINTS = 5, 3, 118
ROUNDING = 5e-6  # float32; depths of millimetres are differences of positions metres away


def _random(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def _body(*, blend_shapes: bool) -> BodyModel:
    """The open body, with pose blend shapes of a millimetre or so if wanted."""
    file = load_body_file(None, 10, 10)
    if blend_shapes:
        random = np.random.default_rng(13)
        file = replace(file, posedirs=random.normal(0, 1e-3, (len(file.template), 3, 486)))
    return BodyModel(file, torch.device("cpu"), torch.get_default_dtype())


@pytest.fixture(scope="module", params=[False, True], ids=["open", "blend shapes"])
def model(request: pytest.FixtureRequest) -> BodyModel:
    return _body(blend_shapes=request.param)


@pytest.fixture(scope="module")
def problem(model: BodyModel) -> BodyProblem:
    return _problem(model)


def _problem(model: BodyModel) -> BodyProblem:
    """Bodies with arms in their sides, seen by lenses whose calibration ends inside the image."""
    base = 0.15 * _random(FRAMES, model.num_parameters, seed=0)
    base[:, 167] += 2.5
    base[:, [50, 53]] -= torch.tensor([1.0, 1.1])
    samples = body_samples.choose_samples(model)
    vertices = model.forward(model.parameters(base)).vertices
    normals = vertex_normals(vertices, model.faces)
    contact = body_self.SelfContact.of(model, samples)
    pairs = body_self.join(
        [body_self.find(contact, *one) for one in zip(vertices, normals, strict=True)]
    )
    assert pairs is not None
    lenses = torch.zeros(CAMERAS, 13)
    lenses[:, :4] = torch.tensor([900.0, 905.0, 640.0, 360.0])
    lenses[:, 4:7] = torch.tensor([0.1, -0.05, 0.001])
    lenses[:, 12] = 0.35
    pose = torch.eye(4).repeat(CAMERAS, 1, 1)
    pose[:, 0, 3] = torch.linspace(-0.4, 0.4, CAMERAS)
    seen = FRAMES, CAMERAS, KEYPOINTS
    observed, confidence = 300 * _random(*seen, 2, seed=1) + 500, _random(*seen, seed=2).abs()
    confidence[0, 1, 5:20], observed[0, 1, 5:20] = 0, torch.nan
    count = len(samples.vertex)
    return BodyProblem(
        model, body_keypoints.keypoint_set(model, range(KEYPOINTS)), samples, base,
        columns_of(model, hands=True, face=True, betas=False), True,
        offsets=0.02 * _random(25, 3, seed=3),
        u=0.1 * _random(len(body_samples.COVERINGS), seed=4),
        views=Views(
            observed, confidence, torch.full(seen, 40.0), lenses, pose,
            0.01 * _random(*seen, 3, seed=5),
        ),
        targets=Targets(
            _random(FRAMES, KEYPOINTS, 3, seed=6), _random(FRAMES, KEYPOINTS, seed=7).relu(), 0.3
        ),
        rows=body_cloud.CloudRows(
            _random(FRAMES, count, seed=8),
            torch.nn.functional.normalize(_random(FRAMES, count, 3, seed=9), dim=2),
            200 * _random(FRAMES, count, seed=10).clamp_min(0), torch.zeros(FRAMES, count),
        ),
        touching=pairs, self_weight=1.0, fit_shared=True,
    )  # fmt: skip


def _variants(problem: BodyProblem) -> dict[str, BodyProblem]:
    model = problem.model
    spread = 0.3 * _random(FRAMES, 63, 63, seed=11)
    body = columns_of(model, hands=False, face=False, betas=False)
    alone = {"one_shape": False, "fit_shared": False}
    return {
        "all": problem,
        "own shape, learned pose": replace(
            problem, columns=columns_of(model, hands=False, face=False, betas=True), **alone,
            pose=PoseGaussian(0.1 * _random(FRAMES, 63, seed=12), spread @ spread.mT),
        ),
        "targets alone": replace(
            problem, columns=body, views=None, rows=None, touching=None, **alone
        ),
        "fingers of a standing body": replace(
            problem, columns=torch.arange(75, 165), targets=None, rows=None, hand_share=0.2, **alone
        ),
    }  # fmt: skip


def _difference(one: Tensor, other: Tensor) -> float:
    """Largest difference relative to the largest entry."""
    return float((one - other).abs().max() / other.abs().max())


@pytest.mark.parametrize("name", ["all", "own shape, learned pose", "targets alone",
                                  "fingers of a standing body"])  # fmt: skip
@pytest.mark.parametrize("index", [[0, 1, 2, 3, 4], [3, 1]], ids=["every frame", "some"])
def test_equal_to_the_torch_terms(name: str, index: list[int], problem: BodyProblem) -> None:
    compiled, at = _variants(problem)[name], torch.tensor(index)
    in_torch = replace(compiled, terms=TorchTerms(problem.model, problem.samples))
    own, shared = compiled.own_start()[at], compiled.shared_start()
    found, expected = (each.linearise(own, shared, at) for each in (compiled, in_torch))
    for ours, theirs in zip(found, expected, strict=True):
        assert _difference(ours, theirs) < ROUNDING
    for each in (compiled, in_torch):
        cost = each.cost(own, shared, at)
        torch.testing.assert_close(cost, expected.cost, rtol=ROUNDING, atol=0)


def test_threads_change_nothing(problem: BodyProblem) -> None:
    own, shared, index = problem.own_start(), problem.shared_start(), torch.arange(FRAMES)
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(problem.linearise(own, shared, index))
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        for one, two in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(one.numpy(), two.numpy())


@pytest.fixture
def in_double() -> Iterator[None]:
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.mark.usefixtures("in_double")
@pytest.mark.parametrize("blend_shapes", [False, True], ids=["open", "blend shapes"])
def test_the_same_normal_equations_in_double(blend_shapes: bool) -> None:
    """Compiled and torch terms agree far beyond what float32 could tell: they take the same
    steps."""
    model = _body(blend_shapes=blend_shapes)
    compiled = _problem(model)
    in_torch = replace(compiled, terms=TorchTerms(model, compiled.samples))
    own, shared, index = compiled.own_start(), compiled.shared_start(), torch.arange(FRAMES)
    found, expected = (each.linearise(own, shared, index) for each in (compiled, in_torch))
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.dtype == torch.float64
        assert _difference(ours, theirs) < 1e-12


@pytest.mark.usefixtures("in_double")
def test_gradient_is_the_slope_of_the_cost_with_blend_shapes() -> None:
    problem = _problem(_body(blend_shapes=True))
    own, shared, index = problem.own_start()[:1], problem.shared_start(), torch.zeros(1).long()
    gradient, step = problem.linearise(own, shared, index).gradient[0], 1e-6
    for seed in range(6):
        way = _random(len(gradient), seed=20 + seed)
        by_own, by_shared = step * way[: own.shape[1]], step * way[own.shape[1] :]
        ahead = problem.cost(own + by_own, shared + by_shared, index)
        behind = problem.cost(own - by_own, shared - by_shared, index)
        torch.testing.assert_close((ahead - behind)[0] / (2 * step), gradient @ way)
