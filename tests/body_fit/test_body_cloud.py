"""E_D: derivatives against finite differences, matching by position and orientation, samples."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from intercap_core.body.kinematics import vertex_normals
from intercap_core.body.model import BodyModel
from intercap_core.body_fit import body_cloud as term
from intercap_core.body_fit.surface import COVERINGS, Samples, Surface, choose_samples
from tests.helpers.bodies import open_body, random_normal


@pytest.fixture(scope="module")
def samples(model: BodyModel) -> Samples:
    return choose_samples(model)


def test_gradient_by_pose_shape_and_covering(model: BodyModel, samples: Samples) -> None:
    ids, group = torch.as_tensor(samples.vertex), torch.as_tensor(samples.group)
    x = 0.1 * random_normal(2, model.num_parameters)
    u = 0.3 * random_normal(len(COVERINGS), seed=1)
    rest = torch.tensor([c.thickness for c in COVERINGS], dtype=torch.float64)
    count = len(samples.vertex)
    rows = term.CloudRows(
        target=random_normal(2, count, seed=2),
        normal=torch.nn.functional.normalize(random_normal(2, count, 3, seed=3), dim=2),
        weight=random_normal(2, count, seed=4).abs(),
        distance=torch.zeros(2, count, dtype=torch.float64),
    )
    linear = model.linearise(model.parameters(x), vertex_ids=ids)
    by = linear.along(rows.normal[:, :, None])[:, :, 0]
    found = term.assemble(linear.vertices, by, by, rows, rest * u.exp(), group)

    def cost(x: Tensor, u: Tensor) -> Tensor:
        points = model.forward(model.parameters(x), vertex_ids=ids).vertices
        return term.cost(points, rows, rest * u.exp(), group)

    torch.testing.assert_close(found.cost, cost(x, u))
    step, direction, turn = 1e-6, random_normal(*x.shape, seed=5), random_normal(len(u), seed=6)
    slope = (cost(x + step * direction, u) - cost(x - step * direction, u)) / (2 * step)
    torch.testing.assert_close((found.gradient * direction).sum(1), slope, rtol=1e-6, atol=1e-5)
    slope = (cost(x, u + step * turn) - cost(x, u - step * turn)) / (2 * step)
    torch.testing.assert_close(found.gradient_u @ turn, slope, rtol=1e-6, atol=1e-5)


def test_cross_block_is_the_gauss_newton_product(model: BodyModel, samples: Samples) -> None:
    group = torch.as_tensor(samples.group)
    count = len(group)
    thickness = torch.linspace(0.001, 0.01, len(COVERINGS), dtype=torch.float64)
    by, points = random_normal(1, count, 4), random_normal(1, count, 3, seed=1)
    rows = term.CloudRows(
        random_normal(1, count, seed=2), random_normal(1, count, 3, seed=3),
        random_normal(1, count, seed=4).abs(), torch.zeros(1, count).double(),
    )  # fmt: skip
    found = term.assemble(points, by, by, rows, thickness, group)
    pick = torch.zeros(count, len(thickness), dtype=torch.float64)
    pick[torch.arange(count), group] = thickness[group]
    j = torch.cat([-by[0], -pick], 1)
    dense = j.T @ (rows.weight[0, :, None] * j)
    torch.testing.assert_close(found.hessian[0], dense[:4, :4])
    torch.testing.assert_close(found.cross[0], dense[:4, 4:])
    torch.testing.assert_close(found.hessian_u[0], dense[4:, 4:])


def test_points_lifted_off_the_skin_are_measured(model: BodyModel, samples: Samples) -> None:
    """Points on normals of outer vertices come back with their height, from either side."""
    params = model.zeros()
    vertices = model.forward(params).vertices
    normals = vertex_normals(vertices, model.faces)[0]
    ids = torch.as_tensor(samples.vertex[~samples.hand])[::3]
    for height in (0.012, -0.006):
        found = term.match(
            vertices[0, ids] + height * normals[ids], normals[ids], vertices[0], normals,
            torch.as_tensor(samples.vertex), torch.as_tensor(samples.patch), 0.05,
        )  # fmt: skip
        error = (found.distance - height).abs()
        assert found.valid.float().mean() > 0.97
        assert error[found.valid].median() < 1e-6
        assert error[found.valid].quantile(0.95) < 0.002


def test_a_surface_that_looks_the_other_way_is_not_met(model: BodyModel, samples: Samples) -> None:
    vertices = model.forward(model.zeros()).vertices
    normals = vertex_normals(vertices, model.faces)[0]
    chest = torch.as_tensor(model.regions["chest"])[::20]
    found = term.match(
        vertices[0, chest], -normals[chest], vertices[0], normals,
        torch.as_tensor(samples.vertex), torch.as_tensor(samples.patch), 0.05,
    )  # fmt: skip
    assert not bool(found.valid.any())


def test_gathering_resists_outliers() -> None:
    found = term.Matches(
        torch.tensor([0, 0, 0, 0, 0, 2]),
        torch.tensor([0.010, 0.011, 0.009, 0.010, 0.045, 0.004]),
        torch.tensor([True, True, True, True, True, False]),
    )
    mean, total = term.gather(found, torch.ones(6), torch.full((3,), 0.01), 3, huber=0.005)
    assert mean[0].item() == pytest.approx(0.01, abs=0.005)
    assert total[0] < 4.5
    assert total[1] == 0 and total[2] == 0


def test_samples_cover_the_outer_skin(model: BodyModel, samples: Samples) -> None:
    template = model.template.numpy()
    low = template[samples.vertex].min(0)
    assert np.allclose(low, template.min(0), atol=0.05)
    assert len(np.unique(samples.vertex)) == len(samples.vertex)
    assert (samples.patch[:, 0] == samples.vertex).all()
    tongue_and_eyes = np.isin(model.skinning_weights.argmax(1).numpy(), (23, 24))
    assert not tongue_and_eyes[samples.vertex].any()


def _posed_bodies() -> tuple[BodyModel, Samples, Tensor]:
    """Four bodies (4,P) in single precision, bent anyhow, two metres before the camera."""
    model = open_body()
    x = model.zeros(4).vector().clone()
    x[:, :165] += 0.3 * random_normal(4, 165).float()
    x[:, 167] = 2.0
    return model, choose_samples(model), x


def test_surface_poses_what_samples_need() -> None:
    model, samples, x = _posed_bodies()
    surface = Surface.around_samples(model, samples)
    found, normals = surface.posed(model.parameters(x))
    vertices = model.forward(model.parameters(x)).vertices
    needed = np.union1d(surface.sample, surface.patch)
    assert (surface.ids[surface.sample] == samples.vertex).all()
    assert (surface.ids[surface.patch] == samples.patch).all()
    torch.testing.assert_close(found, vertices[:, surface.ids])
    true = vertex_normals(vertices, model.faces)[:, surface.ids]
    torch.testing.assert_close(normals[:, needed], true[:, needed], rtol=0, atol=2e-6)


def test_compiled_matches_are_the_plain_ones() -> None:
    """Points within a hand's breadth of the skin, their normals astray."""
    model, samples, x = _posed_bodies()
    surface = Surface.around_samples(model, samples)
    posed = surface.posed(model.parameters(x))
    sample, patch = torch.as_tensor(surface.sample), torch.as_tensor(surface.patch)
    generator = torch.Generator().manual_seed(1)
    for vertices, normals in zip(*posed, strict=True):
        at = torch.randint(0, len(vertices), (600,), generator=generator)
        points = vertices[at] + 0.02 * torch.randn(600, 3, generator=generator)
        looks = normals[at] + 0.3 * torch.randn(600, 3, generator=generator)
        looks = torch.nn.functional.normalize(looks, dim=1)
        plain = term.match(points, looks, vertices, normals, sample, patch, 0.05)
        found = term.match_compiled(points, looks, vertices, normals, surface, 0.05)
        assert 0.4 < plain.valid.float().mean() < 0.95
        same = plain.sample == found.sample  # but for two that are equally near
        assert same.float().mean() > 0.995
        assert torch.equal(plain.valid[same], found.valid[same])
        torch.testing.assert_close(plain.distance[same], found.distance[same], rtol=0, atol=1e-6)
