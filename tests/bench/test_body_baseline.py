"""The paper's recipe on keypoints and points of a body that is known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from bench.body_baseline import STAGES, Energy, FrameFit, Free, fit_by_lbfgs
from bench.body_clip import BodyClip
from intercap_core.body.model import BodyModel
from intercap_core.body.normals import vertex_normals
from intercap_core.body.parameters import TRANSL
from intercap_core.body_fit.observations import Observations, PersonCloud
from intercap_core.config import BodyFitSettings
from intercap_core.evaluation.proximity import Sight
from intercap_core.geometry.camera import projection
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.rigid.surface_tree import SurfaceTree
from tests.helpers.bodies import open_body
from tests.helpers.synthetic_capture import ring

FRAMES, POINTS = 2, 300


def bodies(model: BodyModel) -> Tensor:
    """Upright before the ring's cameras, arms down, one frame a step on."""
    vector = model.zeros(FRAMES).vector().clone()
    vector[:, 75:120], vector[:, 120:165] = model.hand_mean
    vector[:, 0] = np.pi  # cameras look with y down
    vector[:, 50], vector[:, 53] = -0.9, 0.9
    vector[:, TRANSL.stop] = 0.8
    return vector


@pytest.fixture(scope="module")
def truth() -> tuple[BodyClip, Tensor]:
    model = open_body()
    rig, up_from_master = ring(3)
    vectors = bodies(model)
    target = apply(invert(up_from_master), np.array([0.0, 0.0, 0.9]))
    centre = model.forward(model.parameters(vectors)).vertices.mean((0, 1))
    vectors[:, TRANSL] += torch.as_tensor(target, dtype=torch.float32) - centre
    vectors[1, TRANSL.start] += 0.03
    params = model.parameters(vectors)
    output = model.forward(params)
    keypoints = model.keypoints(output).double().numpy()
    seen = keypoints[:, None] @ rig.colour_from_master[:, :3, :3].transpose(0, 2, 1)
    seen = seen + rig.colour_from_master[:, None, :3, 3]
    pixels = projection.project(seen, rig.colour_parameters[:, None])
    confidence = np.ones(pixels.shape[:-1])
    observations = Observations(
        "known", rig, pixels, confidence, keypoints, np.full((FRAMES, 135), 3),
        [b""] * FRAMES * len(rig), np.zeros((FRAMES, len(rig))), [b""] * FRAMES * len(rig),
        [None] * len(rig), np.zeros(len(rig)),
        np.zeros((FRAMES, len(rig)), int), np.zeros(len(rig)), np.arange(FRAMES) / 15,
    )  # fmt: skip
    normals = vertex_normals(output.vertices, model.faces)
    clouds: list[PersonCloud | None] = []
    for vertices, normal in zip(output.vertices, normals, strict=True):
        views = [_seen(vertices, normal, model, camera) for camera in rig]
        ids, view = np.concatenate(views), np.repeat(np.arange(len(rig)), POINTS)
        clouds.append(
            PersonCloud(vertices[ids], normal[ids], torch.ones(len(ids)), torch.as_tensor(view))
        )
    clip = BodyClip(model, observations, clouds, BodyFitSettings(), output.vertices.numpy())
    return clip, vectors


def _seen(vertices: Tensor, normals: Tensor, model: BodyModel, camera: Camera) -> np.ndarray:
    points = vertices.double().numpy()
    sight = Sight([SurfaceTree(points, model.faces.numpy()).shaped(points)])
    ids = np.flatnonzero(sight.seen(points, normals.double().numpy(), [camera]))
    return ids[np.linspace(0, len(ids) - 1, POINTS).astype(int)]


def test_the_free_parameters_are_the_body(truth: tuple[BodyClip, Tensor]) -> None:
    clip, vectors = truth
    free = Free(clip.model)
    x = free.of(vectors[0])
    x[69:93] = torch.linspace(-1, 1, 24)
    full = free.full(x)
    assert torch.allclose(free.of(full[0]), x, atol=1e-5)
    assert torch.equal(full[0, :69], vectors[0, :69])
    assert torch.equal(full[0, TRANSL.start :], vectors[0, TRANSL.start :])


def test_the_data_cost_the_true_body_nothing(truth: tuple[BodyClip, Tensor]) -> None:
    clip, vectors = truth
    energy = Energy(clip.model, clip.seen, 0, clip.clouds[0])
    energy.enter(STAGES[-1], vectors[:1])
    output = clip.model.forward(clip.model.parameters(vectors[:1]))
    assert energy._reprojection(clip.model.keypoints(output)[0]) < 0.1
    there_only = energy._depth(output.vertices[0])
    moved = energy._depth(output.vertices[0] + torch.tensor([0.02, 0.0, 0.0]))
    assert there_only < 0.5 * moved


def test_the_recipe_finds_the_body_and_never_gets_worse(truth: tuple[BodyClip, Tensor]) -> None:
    clip, vectors = truth
    start = vectors[1].clone()
    start[3:66] += 0.05 * torch.randn(63, generator=torch.Generator().manual_seed(0))
    start[TRANSL.start] += 0.04
    fit = fit_by_lbfgs(clip.model, clip.seen, 1, clip.clouds[1], start, STAGES[-1:], rounds=3)
    before, after = clip.errors(torch.stack([start, fit.end]), np.array([1, 1]))
    assert before > 30 and after < 12
    assert (np.diff(fit.energy[fit.best]) <= 0).all() and (np.diff(fit.seconds) > 0).all()


def test_the_best_is_the_stages_own() -> None:
    energy, stage = np.array([5.0, 3.0, 4.0, 9.0, 8.0]), np.array([0, 0, 0, 1, 1])
    fit = FrameFit(torch.arange(5.0)[:, None], energy, stage, np.arange(5.0))
    assert fit.best.tolist() == [0, 1, 1, 3, 4]
    assert fit.end == 4


def test_a_part_of_a_clip_is_its_frames(truth: tuple[BodyClip, Tensor]) -> None:
    clip, vectors = truth
    part = clip.part(slice(1, 2))
    assert len(part) == 1 and len(part.seen.masks) == len(clip.seen.rig)
    assert np.array_equal(part.seen.keypoints[0], clip.seen.keypoints[1])
    assert part.errors(vectors[1:], np.array([0]))[0] < 1e-3
