"""The compiled terms of the body's energy against autograd, and the whole against differences."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from bench.body_energy import BodyEnergy, Rows
from intercap_core.body.jacobian import shaped_points
from intercap_core.body.kinematics import rotation_from_axis_angle
from intercap_core.body.loading import load_body_file
from intercap_core.body.model import BodyModel
from intercap_core.body.selection import Limbs
from intercap_core.body.vposer import PoseGaussian
from intercap_core.body_fit import keypoint_term
from intercap_core.body_fit.prior_term import CompiledPriors, prior_rows
from intercap_core.body_fit.problem import BodyProblem, columns_of
from intercap_core.body_fit.surface import COVERINGS, choose_samples
from intercap_core.body_fit.term_inputs import (
    Batch,
    Bodies,
    CloudRows,
    Pairs,
    Targets,
    TermInputs,
    Views,
    keypoint_set,
)
from intercap_core.geometry.solve.levenberg_marquardt import NormalEquations
from intercap_core.geometry.solve.robust import geman_mcclure_weight

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


# --- against torch --------------------------------------------------------------------------------


def _learned(problem: BodyProblem) -> BodyProblem:
    """The problem with a shape of each frame and a learned pose prior."""
    spread = 0.3 * _random(FRAMES, 63, 63, seed=11)
    columns = columns_of(problem.model, hands=False, face=False, betas=True)
    return replace(
        problem, columns=columns, one_shape=False, fit_shared=False, hand_share=0.2,
        pose=PoseGaussian(0.1 * _random(FRAMES, 63, seed=12), spread @ spread.mT),
    )  # fmt: skip


def test_keypoints_without_offsets_are_the_models(body64: BodyModel) -> None:
    params = body64.parameters(0.15 * _random(2, body64.num_parameters, seed=0).double())
    chosen, offsets = keypoint_set(body64, range(135)), torch.zeros(135, 3).double()
    found = keypoint_term.evaluate(body64, params, chosen, offsets, derivatives=False)
    torch.testing.assert_close(found.points, body64.keypoints_of(params))


# --- priors ---------------------------------------------------------------------------------------


def _prior_cost(model: BodyModel, x: Tensor, **changes: object) -> Tensor:
    given = {"keypoints": keypoint_set(model, [0]), "one_shape": False} | changes
    bodies = Bodies(x, torch.zeros(0, 3), torch.zeros(0), torch.arange(len(x)))
    cost = np.zeros(len(x))
    term = CompiledPriors(model).prepare(TermInputs(**given), bodies, derivatives=False)
    term.add_cost(Batch(slice(None), x.numpy(), np.arange(len(x)), skeleton=None), cost)
    return torch.from_numpy(cost)


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
    others = sum(
        0.5 * (weight * rows.residuals).square().sum(1)
        for rows, weight in prior_rows(body64, x, body_pose=True)[:3]
    )
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


def _moved(problem: BodyProblem, bodies: Bodies, step: Tensor) -> Bodies:
    """The bodies moved by ``step`` (b, n) along the columns of the normal equations."""
    columns, count = problem.layout.equations(), len(step)
    n = len(columns.parameters)
    offsets = bodies.offsets.expand(count, -1, -1)
    thickness = bodies.thickness.expand(count, -1)
    if columns.offsets:
        moved = step[:, columns.offsets_at].reshape(count, -1, 3)
        offsets = torch.cat(
            [offsets[:, : columns.offsets] + moved, offsets[:, columns.offsets :]], 1
        )
        thickness = thickness * step[:, columns.coverings_at].exp()
    vectors = bodies.vectors.index_add(1, columns.parameters, step[:, :n])
    return bodies._replace(vectors=vectors, offsets=offsets, thickness=thickness)


class OwnLimbs(BodyEnergy):
    """The energy with the derivatives of pose blend shapes that Gauss-Newton matrices contain.

    E_J and E_D have those by the joints of a point's own limb, E_P_self has none.
    """

    def keypoints(self, vectors: Tensor) -> Tensor:
        chosen = self.problem.keypoints
        return self._by_limb(
            chosen.limbs,
            lambda own: chosen.matrix @ self._points(vectors, chosen.vertices, own, True),
        )

    def samples(self, vectors: Tensor) -> Tensor:
        ids = self.problem.samples.vertex
        limbs = self.problem.model.select(ids).limbs
        return self._by_limb(limbs, lambda own: self._points(vectors, ids, own, False))

    def paired(self, vectors: Tensor) -> Tensor:
        assert self.problem.pairs is not None
        return self._points(vectors, self.problem.pairs.vertices, np.zeros(55, bool), False)

    def _by_limb(self, limbs: Limbs, points_of: Callable[[np.ndarray], Tensor]) -> Tensor:
        """The points of each limb, evaluated with the joints (55,) bool that move it."""
        each = zip(limbs.starts[:-1], limbs.starts[1:], limbs.moved_by, strict=True)
        parts = [points_of(own)[:, limbs.order[first:last]] for first, last, own in each]
        return torch.cat(parts, 1)[:, np.argsort(limbs.order)]

    def _points(
        self, vectors: Tensor, ids: Tensor | np.ndarray, own: np.ndarray, joints: bool
    ) -> Tensor:
        """Vertices, and joints if requested; blend shapes have derivatives by ``own`` joints."""
        model = self.problem.model
        selection, params = model.select(ids, joints=joints), model.parameters(vectors)
        _, posed, axis_angle = model._rest(selection, params)
        local = rotation_from_axis_angle(axis_angle)
        local = torch.where(torch.as_tensor(own)[:, None, None], local, local.detach())
        shape = torch.cat([params.betas, params.expression], 1)
        rest = shaped_points(selection, shape, local)
        rotation = torch.einsum("nj,bjcd->bncd", selection.weights, posed.rotations)
        return (rotation @ rest[..., None])[..., 0] + selection.weights @ posed.offsets


def _gauss_newton(rows: Rows, step: Tensor, way: Tensor) -> Tensor:
    """J^T W J way (b, n) of residuals that depend on ``step`` (b, n)."""
    outward = torch.zeros_like(rows.residual, requires_grad=True)
    (pulled,) = torch.autograd.grad(rows.residual, step, outward, create_graph=True)
    (slopes,) = torch.autograd.grad(pulled, outward, way.expand_as(step), retain_graph=True)
    square = (rows.residual.detach() ** 2).sum(1)
    weight = rows.weight
    if rows.scale is not None:
        weight = weight * geman_mcclure_weight(square, rows.scale)
    weighted = weight[:, None] * slopes
    return torch.autograd.grad(rows.residual, step, weighted, retain_graph=True)[0]


@pytest.mark.parametrize("name", ["all", "own shape, learned pose", "targets alone",
                                  "fingers of a standing body"])  # fmt: skip
def test_compiled_terms_equal_torch_in_some_frames(name: str, exact: BodyProblem) -> None:
    """Gradient and Gauss-Newton matrix are those of autograd, far beyond float32."""
    problem, at = _variants(exact)[name], torch.tensor([2, 1])
    own, shared = problem.own_start()[at], problem.shared_start()
    found = problem.linearise(own, shared, at)
    assert found.hessian.dtype == torch.float64
    bodies = problem._bodies(own, shared, at)
    step = torch.zeros_like(found.gradient, requires_grad=True)
    cost = BodyEnergy(problem).cost(_moved(problem, bodies, step))
    (gradient,) = torch.autograd.grad(cost.sum(), step)
    expected = NormalEquations(cost.detach(), gradient, torch.zeros_like(found.hessian))
    problem.layout.add_prior(shared, expected)
    torch.testing.assert_close(found.cost, expected.cost, rtol=1e-12, atol=0)
    torch.testing.assert_close(problem.cost(own, shared, at), expected.cost, rtol=1e-12, atol=0)
    assert _difference(found.gradient, expected.gradient) < 1e-12
    every = list(OwnLimbs(problem).rows(_moved(problem, bodies, step)))
    for seed in (20, 21):  # any wrong entry changes the product with a random vector
        way = _random(step.shape[1], seed=seed)
        product = expected.hessian @ way + sum(_gauss_newton(rows, step, way) for rows in every)
        assert _difference(found.hessian @ way, product) < 1e-12
    torch.testing.assert_close(found.hessian, found.hessian.mT)


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


def test_number_of_threads_changes_nothing(
    exact: BodyProblem, monkeypatch: pytest.MonkeyPatch
) -> None:
    own, shared, index = exact.own_start(), exact.shared_start(), torch.arange(FRAMES)
    results = []
    for threads in (1, 2):
        monkeypatch.setenv("INTERCAP_THREADS", str(threads))
        results.append(exact.linearise(own, shared, index))
    for single, double in zip(*results, strict=True):
        np.testing.assert_array_equal(single.numpy(), double.numpy())
