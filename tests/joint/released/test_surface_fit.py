"""A body laid on a surface: its energy's gradient, and surfaces that it can take exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from intercap_core.body.loading import load_body_file
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import NUM_POSE, TRANSL
from intercap_core.formats.released import Skin
from intercap_core.joint.released.surface_fit import _Planes, _Problem, fit_surfaces
from tests.helpers.bodies import random_normal

PLAIN, CORRECTED = False, True  # with pose blend shapes, as licensed files have them


def _model(corrected: bool, dtype: torch.dtype) -> BodyModel:
    file = load_body_file(None, 10, 10)
    if corrected:
        size = (*file.template.shape, 486)
        file = replace(file, posedirs=np.random.default_rng(3).normal(0, 2e-4, size))
    return BodyModel(file, torch.device("cpu"), dtype)


def _vectors(model: BodyModel, count: int, dtype: torch.dtype) -> torch.Tensor:
    """Persons (N, P) of one shape with bent limbs, half a turn from the T-pose's up."""
    vectors = model.zeros(count).vector()
    vectors[:, :NUM_POSE] = 0.1 * random_normal(count, NUM_POSE, seed=1).to(dtype)
    vectors[:, 66:75] = 0.0  # jaw and eyes
    vectors[:, 0] += np.pi
    vectors[:, TRANSL] = torch.tensor([0.1, 0.2, 2.4], dtype=dtype)
    vectors[:, TRANSL.stop : TRANSL.stop + 10] = 0.7 * random_normal(10, seed=2).to(dtype)
    return vectors


@pytest.mark.parametrize("corrected", [PLAIN, CORRECTED])
def test_the_gradient_is_that_of_the_cost(corrected: bool):
    model = _model(corrected, torch.float64)
    base = _vectors(model, 2, torch.float64)
    columns = torch.tensor([i for i in range(TRANSL.stop) if not 66 <= i < 75])
    ids = np.arange(0, model.num_vertices, 97)
    sizes = (2, len(ids), 2)
    normal = torch.nn.functional.normalize(random_normal(*sizes, 3, seed=4), dim=3)
    planes = _Planes(normal, random_normal(*sizes, seed=5), random_normal(*sizes, seed=6).abs())
    own, shared = base[:, columns], base[0, TRANSL.stop : TRANSL.stop + 10]
    about = own + 0.1 * random_normal(*own.shape, seed=7)
    stiffness = random_normal(len(columns), seed=8).abs()
    shape = slice(TRANSL.stop, TRANSL.stop + 10)
    problem = _Problem(model, ids, columns, shape, base, about, stiffness, planes)
    every = torch.arange(2)
    found = problem.linearise(own, shared, every)
    assert found.cost == pytest.approx(problem.cost(own, shared, every))
    step = 1e-6
    way = random_normal(2, len(columns), seed=9)
    ahead, back = (problem.cost(own + sign * step * way, shared, every) for sign in (1, -1))
    by_own = (found.gradient[:, : len(columns)] * way).sum(1)
    assert by_own.numpy() == pytest.approx(((ahead - back) / (2 * step)).numpy(), rel=1e-6)
    way = random_normal(10, seed=10)
    ahead, back = (problem.cost(own, shared + sign * step * way, every) for sign in (1, -1))
    by_shape = (found.gradient[:, len(columns) :] * way).sum(1)
    assert by_shape.numpy() == pytest.approx(((ahead - back) / (2 * step)).numpy(), rel=1e-6)


@pytest.mark.parametrize("corrected", [PLAIN, CORRECTED])
def test_a_surface_of_the_body_itself_is_found_again(corrected: bool):
    model = _model(corrected, torch.float32)
    true = _vectors(model, 2, torch.float32)
    with torch.no_grad():
        posed = model.forward(model.parameters(true))
    faces = model.faces.numpy().astype(np.int32)
    skins = [Skin(vertices, faces) for vertices in posed.vertices.numpy()]
    off = 0.05 * random_normal(2, 55, 3, seed=3).numpy()
    rotations = true[:, :NUM_POSE].reshape(2, 55, 3).numpy() + off
    rotations[:, 22:25] = 0.0
    found = fit_surfaces(model, skins, rotations)
    assert found.distance[:, 0].max() < 0.0006 and found.distance[:, 1].max() < 0.002
    with torch.no_grad():
        joints = model.forward(model.parameters(found.vectors)).joints
    assert (joints - posed.joints).norm(dim=2).max() < 0.012
    shape = found.vectors[:, TRANSL.stop : TRANSL.stop + 10]
    assert torch.equal(shape[0], shape[1])
