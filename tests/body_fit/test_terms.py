"""The terms of the body's energy: torch against differences, compiled against torch."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from intercap_core.body.loading import load_body_file
from intercap_core.body.model import BodyModel
from intercap_core.body.vposer import PoseGaussian
from intercap_core.body_fit import cloud_term, keypoint_term
from intercap_core.body_fit.prior_term import PriorTerm
from intercap_core.body_fit.problem import BodyProblem, columns_of
from intercap_core.body_fit.surface import COVERINGS, choose_samples
from intercap_core.body_fit.term_inputs import (
    Bodies,
    CloudRows,
    Pairs,
    Targets,
    TermInputs,
    TorchTerm,
    Views,
    keypoint_set,
)
from intercap_core.body_fit.terms import TorchTerms
from intercap_core.geometry.solve.levenberg_marquardt import NormalEquations

FRAMES, CAMERAS, KEYPOINTS = 3, 3, 118


def _random(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def _body(*, blend_shapes: bool) -> BodyModel:
    """The open body, with pose blend shapes of about a millimetre if requested."""
    file = load_body_file(None, 10, 10)
    if blend_shapes:
        random = np.random.default_rng(13)
        file = replace(file, posedirs=random.normal(0, 1e-3, (len(file.template), 3, 486)))
    return BodyModel(file, torch.device("cpu"), torch.get_default_dtype())


def _pairs(model: BodyModel, base: Tensor) -> Pairs:
    """Neighbouring points of the skin, most of them behind a plane through the other."""
    ids = torch.arange(0, model.num_vertices - 12, 97)
    vertices = torch.stack([ids, ids + 12], 1).reshape(-1)
    points = model.forward(model.parameters(base), vertex_ids=vertices).vertices
    gap = (points[:, 0::2] - points[:, 1::2]).reshape(-1, 3)
    normal = 0.5 * gap.norm(dim=1, keepdim=True) * _random(*gap.shape, seed=14) - gap
    inner = 2 * torch.arange(len(ids)).repeat(FRAMES)
    frame = torch.arange(FRAMES).repeat_interleave(len(ids))
    return Pairs(frame, inner, inner + 1, torch.nn.functional.normalize(normal, dim=1), vertices)


def _problem(model: BodyModel) -> BodyProblem:
    """Random bodies and observations, in lenses whose calibration ends inside the image."""
    base = 0.15 * _random(FRAMES, model.num_parameters, seed=0)
    base[:, 167] += 2.5
    samples = choose_samples(model)
    lenses = torch.zeros(CAMERAS, 13)
    lenses[:, :4] = torch.tensor([900.0, 905.0, 640.0, 360.0])
    lenses[:, 4:7] = torch.tensor([0.1, -0.05, 0.001])
    lenses[:, 12] = 0.35
    pose = torch.eye(4).repeat(CAMERAS, 1, 1)
    pose[:, 0, 3] = torch.linspace(-0.4, 0.4, CAMERAS)
    shape = FRAMES, CAMERAS, KEYPOINTS
    observed, confidence = 300 * _random(*shape, 2, seed=1) + 500, _random(*shape, seed=2).abs()
    confidence[0, 1, 5:20], observed[0, 1, 5:20] = 0, torch.nan
    count = len(samples.vertex)
    return BodyProblem(
        model=model, keypoints=keypoint_set(model, range(KEYPOINTS)), samples=samples, base=base,
        columns=columns_of(model, hands=True, face=True, betas=False), one_shape=True,
        offsets=0.02 * _random(25, 3, seed=3),
        u=0.1 * _random(len(COVERINGS), seed=4),
        views=Views(
            observed, confidence, torch.full(shape, 40.0), lenses, pose,
            0.01 * _random(*shape, 3, seed=5),
        ),
        targets=Targets(
            _random(FRAMES, KEYPOINTS, 3, seed=6), _random(FRAMES, KEYPOINTS, seed=7).relu(), 0.3
        ),
        rows=CloudRows(
            _random(FRAMES, count, seed=8),
            torch.nn.functional.normalize(_random(FRAMES, count, 3, seed=9), dim=2),
            200 * _random(FRAMES, count, seed=10).clamp_min(0),
        ),
        pairs=_pairs(model, base), self_weight=1.0, fit_shared=True,
    )  # fmt: skip


@pytest.fixture(scope="module", params=[False, True], ids=["open", "blend shapes"])
def exact(request: pytest.FixtureRequest) -> Iterator[BodyProblem]:
    """A problem in double precision."""
    torch.set_default_dtype(torch.float64)
    yield _problem(_body(blend_shapes=request.param))
    torch.set_default_dtype(torch.float32)


# --- torch ----------------------------------------------------------------------------------------


def _learned(problem: BodyProblem) -> BodyProblem:
    """The problem with a shape of each frame and a learned pose prior."""
    spread = 0.3 * _random(FRAMES, 63, 63, seed=11)
    columns = columns_of(problem.model, hands=False, face=False, betas=True)
    return replace(
        problem, columns=columns, one_shape=False, fit_shared=False, hand_share=0.2,
        pose=PoseGaussian(0.1 * _random(FRAMES, 63, seed=12), spread @ spread.mT),
    )  # fmt: skip


@pytest.mark.parametrize("learned", [False, True])
@pytest.mark.parametrize("number", range(4), ids=["E_J", "E_D", "E_P_self", "priors"])
def test_gradient_of_each_term_is_the_slope_of_its_cost(
    number: int, learned: bool, exact: BodyProblem
) -> None:
    """By pose, shape, keypoint offsets and thickness of clothing."""
    problem = _learned(exact) if learned else exact
    term = TorchTerms(problem.model, problem.samples).terms[number]
    cost, gradient, hessian, ahead, behind = _along(problem, term, step=1e-6)
    torch.testing.assert_close(cost, term.cost(*_evaluation(problem)))
    slope = (ahead - behind) / 2e-6
    torch.testing.assert_close(gradient, slope, rtol=1e-5, atol=1e-3)
    torch.testing.assert_close(hessian, hessian.mT)
    assert torch.linalg.eigvalsh(hessian).min() > -1e-6 * hessian.abs().max()


def _evaluation(problem: BodyProblem) -> tuple[TermInputs, Bodies]:
    own, shared, index = problem.own_start(), problem.shared_start(), torch.arange(FRAMES)
    return problem, problem._bodies(own, shared, index)


def _moved(problem: BodyProblem, bodies: Bodies, way: Tensor, step: float) -> Bodies:
    """The bodies moved along ``way`` (n,) by the columns of the normal equations."""
    columns = problem.layout.equations()
    vectors, offsets = bodies.vectors.clone(), bodies.offsets.clone()
    vectors[:, columns.parameters] += step * way[: len(columns.parameters)]
    thickness = bodies.thickness
    if columns.offsets:
        offsets[:25] += step * way[columns.offsets_at].reshape(25, 3)
        thickness = thickness * (step * way[columns.coverings_at]).exp()
    return bodies._replace(vectors=vectors, offsets=offsets, thickness=thickness)


def _along(problem: BodyProblem, term: TorchTerm, step: float) -> tuple[Tensor, ...]:
    """Cost, derivative along a random way, Hessian; costs ahead and behind."""
    (inputs, bodies), columns = _evaluation(problem), problem.layout.equations()
    size = columns.coverings_at.stop
    sums = NormalEquations(*(torch.zeros(FRAMES, *[size] * axes) for axes in (0, 1, 2)))
    term.add(inputs, bodies, columns, sums)
    way = _random(size, seed=20)
    ahead, behind = (
        term.cost(inputs, _moved(problem, bodies, way, sign * step)) for sign in (1, -1)
    )
    return sums.cost, sums.gradient @ way, sums.hessian, ahead, behind


@pytest.mark.parametrize("exact", [False], indirect=True)  # else they omit some derivatives
def test_gauss_newton_matrices_are_products_of_residual_slopes(exact: BodyProblem) -> None:
    """v^T H v = sum w (dr / dv)^2 along a way v, for E_D and for E_J without blend shapes."""
    model = exact.model
    problem = replace(exact, targets=None)
    keypoints, cloud, *_ = TorchTerms(model, problem.samples).terms
    (_, bodies), step = _evaluation(problem), 1e-6
    way = _random(problem.layout.equations().coverings_at.stop, seed=20)
    moved = [_moved(problem, bodies, way, sign * step) for sign in (1, -1)]
    ids, group = torch.as_tensor(problem.samples.vertex), torch.as_tensor(problem.samples.group)

    def distances(at: Bodies) -> Tensor:
        points = model.forward(model.parameters(at.vectors), vertex_ids=ids).vertices
        return cloud_term.residuals(points, problem.rows, at.thickness, group)

    def pixels(at: Bodies) -> Tensor:
        params = model.parameters(at.vectors)
        points = keypoint_term.evaluate(
            model, params, problem.keypoints, at.offsets, derivatives=False
        ).points
        return keypoint_term.pixel_residuals(points, problem.views) / 40.0

    slope = (distances(moved[0]) - distances(moved[1])) / (2 * step)
    expected = (problem.rows.weight * slope**2).sum(1)
    _, _, hessian, *_ = _along(problem, cloud, step)
    torch.testing.assert_close((hessian @ way) @ way, expected, rtol=1e-6, atol=0)

    slope = (pixels(moved[0]) - pixels(moved[1])).nan_to_num() / (2 * step)
    square = (pixels(bodies).nan_to_num() ** 2).sum(-1)
    weight = problem.views.confidence * (16 / (square + 16)) ** 2
    expected = (weight * (slope**2).sum(-1)).sum((1, 2))
    _, _, hessian, *_ = _along(problem, keypoints, step)
    torch.testing.assert_close((hessian @ way) @ way, expected, rtol=1e-5, atol=0)


def test_keypoints_without_offsets_are_the_models(body64: BodyModel) -> None:
    params = body64.parameters(0.15 * _random(2, body64.num_parameters, seed=0).double())
    chosen, offsets = keypoint_set(body64, range(135)), torch.zeros(135, 3).double()
    found = keypoint_term.evaluate(body64, params, chosen, offsets, derivatives=False)
    torch.testing.assert_close(found.points, body64.keypoints_of(params))


# --- priors ---------------------------------------------------------------------------------------


def _prior_cost(model: BodyModel, x: Tensor, **changes: object) -> Tensor:
    given = {"keypoints": keypoint_set(model, [0]), "one_shape": False} | changes
    bodies = Bodies(x, torch.zeros(0, 3), torch.zeros(0), torch.arange(len(x)))
    return PriorTerm(model).cost(TermInputs(**given), bodies)


def test_prior_of_shared_betas_is_left_to_the_layout(body64: BodyModel) -> None:
    x = torch.zeros(2, body64.num_parameters, dtype=torch.float64)
    x[1, 168:178] = 2.0
    shared, own = (_prior_cost(body64, x, one_shape=flag) for flag in (True, False))
    assert (shared[1] - shared[0]).item() == pytest.approx(0.0)
    assert (own[1] - own[0]).item() == pytest.approx(0.5 * 10 * 4.0)


def test_five_frames_with_a_fifth_of_the_hand_prior_cost_one(body64: BodyModel) -> None:
    x = torch.zeros(2, body64.num_parameters, dtype=torch.float64)
    x[:, 75:165] = torch.cat([body64.hand_mean[0], body64.hand_mean[1]])
    x[1, 75:165] += 0.1 * _random(90, seed=1).double()
    whole, fifth = (_prior_cost(body64, x, hand_share=share) for share in (1.0, 0.2))
    torch.testing.assert_close(whole[0], fifth[0])
    others = sum(rows.energy(weight) for rows, weight in PriorTerm(body64).rows(x)[:3])
    hands = (whole - others)[1] - (whole - others)[0]
    assert hands > 1
    torch.testing.assert_close(5 * ((fifth - others)[1] - (fifth - others)[0]), hands)


# --- compiled -------------------------------------------------------------------------------------


def _variants(problem: BodyProblem) -> dict[str, BodyProblem]:
    body = columns_of(problem.model, hands=False, face=False, betas=False)
    alone = {"one_shape": False, "fit_shared": False}
    return {
        "all": problem,
        "own shape, learned pose": _learned(problem),
        "targets alone": replace(
            problem, columns=body, views=None, rows=None, pairs=None, **alone
        ),
        "fingers of a standing body": replace(
            problem, columns=torch.arange(75, 165), targets=None, rows=None, hand_share=0.2, **alone
        ),
    }  # fmt: skip


def _difference(found: Tensor, expected: Tensor) -> float:
    """Largest difference relative to the largest entry."""
    return float((found - expected).abs().max() / expected.abs().max())


@pytest.mark.parametrize("name", ["all", "own shape, learned pose", "targets alone",
                                  "fingers of a standing body"])  # fmt: skip
def test_compiled_terms_equal_torch_in_some_frames(name: str, exact: BodyProblem) -> None:
    """They agree far beyond float32, so that fits take the same steps."""
    compiled, at = _variants(exact)[name], torch.tensor([2, 1])
    in_torch = replace(compiled, terms=TorchTerms(exact.model, exact.samples))
    own, shared = compiled.own_start()[at], compiled.shared_start()
    found, expected = (each.linearise(own, shared, at) for each in (compiled, in_torch))
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.dtype == torch.float64
        assert _difference(ours, theirs) < 1e-12
    for each in (compiled, in_torch):
        cost = each.cost(own, shared, at)
        torch.testing.assert_close(cost, expected.cost, rtol=1e-12, atol=0)


def test_gradient_of_the_whole_energy_is_its_slope(exact: BodyProblem) -> None:
    """All terms and the priors of shared parameters, through the solver's interface."""
    own, shared, index = exact.own_start(), exact.shared_start(), torch.arange(FRAMES)
    normal, step = exact.linearise(own, shared, index), 1e-6
    torch.testing.assert_close(normal.cost, exact.cost(own, shared, index))
    way = _random(normal.gradient.shape[1], seed=21)
    by_own, by_shared = step * way[: own.shape[1]], step * way[own.shape[1] :]
    ahead = exact.cost(own + by_own, shared + by_shared, index)
    behind = exact.cost(own - by_own, shared - by_shared, index)
    torch.testing.assert_close((ahead - behind) / (2 * step), normal.gradient @ way)


def test_number_of_threads_changes_nothing(exact: BodyProblem) -> None:
    own, shared, index = exact.own_start(), exact.shared_start(), torch.arange(FRAMES)
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2):
            torch.set_num_threads(threads)
            results.append(exact.linearise(own, shared, index))
    finally:
        torch.set_num_threads(before)
    for single, double in zip(*results, strict=True):
        np.testing.assert_array_equal(single.numpy(), double.numpy())
