"""Samples of the skin, the posed surface around them, and matches of points to it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from intercap_core.body.model import BodyModel
from intercap_core.body_fit import matching
from intercap_core.body_fit.surface import Samples, SkinSurface, choose_samples
from tests.helpers.bodies import posed_normals, random_normal


@pytest.fixture(scope="module")
def samples(body: BodyModel) -> Samples:
    return choose_samples(body)


@pytest.fixture(scope="module")
def surface(body: BodyModel, samples: Samples) -> SkinSurface:
    return SkinSurface.around_samples(body, samples)


def test_samples_cover_the_outer_skin(body: BodyModel, samples: Samples) -> None:
    template = body.template.numpy()
    low = template[samples.vertex].min(0)
    assert np.allclose(low, template.min(0), atol=0.05)
    assert len(np.unique(samples.vertex)) == len(samples.vertex)
    assert (samples.patch[:, 0] == samples.vertex).all()
    tongue_and_eyes = np.isin(body.skinning_weights.argmax(1).numpy(), (23, 24))
    assert not tongue_and_eyes[samples.vertex].any()


def test_surface_poses_what_samples_need(
    body: BodyModel, samples: Samples, surface: SkinSurface
) -> None:
    x = body.zeros(2).vector().clone()
    x[:, :165] += 0.3 * random_normal(2, 165).float()
    found, normals = surface.posed(body.parameters(x))
    vertices, true = posed_normals(body, body.parameters(x))
    needed = np.union1d(surface.sample, surface.patch)
    assert (surface.ids[surface.sample] == samples.vertex).all()
    assert (surface.ids[surface.patch] == samples.patch).all()
    torch.testing.assert_close(found, vertices[:, surface.ids])
    true = true[:, surface.ids]
    torch.testing.assert_close(normals[:, needed], true[:, needed], rtol=0, atol=2e-6)


def test_points_off_the_skin_are_measured(
    body: BodyModel, surface: SkinSurface, samples: Samples
) -> None:
    """Points on normals of outer vertices are matched at their height, from either side."""
    vertices, normals = (values[0] for values in surface.posed(body.zeros()))
    ids = torch.as_tensor(surface.sample[~samples.hand])[::3]
    for height in (0.012, -0.006):
        points = vertices[ids] + height * normals[ids]
        found = matching.match_points(points, normals[ids], vertices, normals, surface, 0.05)
        error = (found.distance - height).abs()
        assert found.valid.float().mean() > 0.97
        assert error[found.valid].median() < 1e-6
        assert error[found.valid].quantile(0.95) < 0.002
    chest = np.isin(surface.ids, body.regions["chest"][::20])
    back = matching.match_points(vertices[chest], -normals[chest], vertices, normals, surface, 0.05)
    assert len(back.valid) > 10 and not bool(back.valid.any())


def test_matches_are_nearest_in_position_and_direction(
    body: BodyModel, surface: SkinSurface
) -> None:
    x = body.zeros().vector().clone()
    x[:, :165] += 0.3 * random_normal(1, 165).float()
    vertices, normals = (values[0] for values in surface.posed(body.parameters(x)))
    generator = torch.Generator().manual_seed(1)
    at = torch.randint(0, len(vertices), (600,), generator=generator)
    points = vertices[at] + 0.02 * torch.randn(600, 3, generator=generator)
    looks = normals[at] + 0.3 * torch.randn(600, 3, generator=generator)
    looks = torch.nn.functional.normalize(looks, dim=1)
    found = matching.match_points(points, looks, vertices, normals, surface, 0.05)
    skin = torch.cat([vertices, 0.06 * normals], 1)
    sample = torch.cdist(torch.cat([points, 0.06 * looks], 1), skin[surface.sample]).argmin(1)
    same = sample == found.sample  # except for two equally near samples
    assert same.float().mean() > 0.995
    patch = torch.as_tensor(surface.patch)[sample]
    nearest = (points[:, None] - vertices[patch]).norm(dim=2).argmin(1)
    vertex = patch[torch.arange(600), nearest]
    gap, normal = points - vertices[vertex], normals[vertex]
    height = (gap * normal).sum(1)
    torch.testing.assert_close(height[same], found.distance[same], rtol=0, atol=1e-6)
    valid = ((normal * looks).sum(1) > 0.3) & (height.abs() < 0.05)
    valid &= (gap - height[:, None] * normal).norm(dim=1) < 0.03
    assert 0.4 < valid.float().mean() < 0.95
    assert torch.equal(valid[same], found.valid[same])


def test_averages_resist_outliers() -> None:
    found = matching.Matches(
        torch.tensor([0, 0, 0, 0, 0, 2]),
        torch.tensor([0.010, 0.011, 0.009, 0.010, 0.045, 0.004]),
        torch.tensor([True, True, True, True, True, False]),
    )
    mean, total = matching.average(found, torch.ones(6), torch.full((3,), 0.01), huber=0.005)
    assert mean[0].item() == pytest.approx(0.01, abs=0.005)
    assert total[0] < 4.5
    assert total[1] == 0 and total[2] == 0
